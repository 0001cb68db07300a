"""One seed of `active_touch`: warm start, reinforced policies, controls, and their trajectories on test objects."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.active.headroom import Beliefs
from experiments.active.plans import (
    Answer,
    LookUps,
    Played,
    at_random,
    look_up,
    play,
    same_for_all,
    same_for_question,
    until_sure,
)
from experiments.active.policies import answerer, explore, imitate, part_of, reinforce, single_beliefs, warm_up
from experiments.active.saved import publish, require_published
from experiments.active.world import TouchWorld
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.study.policies import fault_of
from touchr1_jax.models.active_policy import ActivePolicy, build_active_policy
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.models.saved_policy import PolicyError
from touchr1_jax.rl.config import GRPOConfig, Norm, Paper
from touchr1_jax.rl.touch_reward import Prices
from touchr1_jax.training.exploration import NO_CHOICE, check_exploration, drop_out, touch_batch_of
from touchr1_jax.training.optimizer import OptimizerConfig
from touchr1_jax.training.train_sft import SFTConfig
from touchr1_jax.types import Params
from touchr1_jax.validation import unused

EVERY_TOUCH = "every_touch"  # the control that makes every contact; of the first seed alone

RULES = ("random", "best_press", "best_fixed", "by_question")
"""Plans by rule, with which policies are compared."""

EQUAL = "at_equal_seconds"
"""Ends the names of plans by rule that take as much time as the policy of several contacts."""

MISSING = "missing"
"""Ends the names of outcomes where sensors and motions drop out."""

TOUCHES = Paper(beta=0.02, kl="exact", gamma=0.0, constrained=True, enumerated=Norm.STD, learn_conclusion=False)
"""Learns touches alone, from the probability of the right answer; the answers stay those of the warm start."""


def check_warm_start(config: SFTConfig) -> None:
    """Refuse settings of SFT that a warm start on random touches does not read; `ValueError` names them."""
    unused(config, "warm", questions=1, pack=0, curriculum=0.0, conclusion_weight=1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arm:
    """A reinforced policy: most contacts, price of a second and of harm in units of a right answer."""

    budget: int
    second: float = 0.0
    harm: float = 0.0

    @property
    def prices(self) -> Prices:
        """As the step takes them."""
        return Prices(second=jnp.float32(self.second), harm=jnp.float32(self.harm))


@dataclasses.dataclass(frozen=True, kw_only=True)
class LearnerConfig:
    """Training of the policies.

    Args:
      decoder: sizes; the vocabulary comes from the language.
      warm: warm start on touches drawn at random.
      grpo: a step of reinforcement; its length follows from the budget.  By default it learns touches alone, from the
        probability of the right answer; a KL to the warm start keeps the answers, a light one touches apart.
      steps: of reinforcement with several contacts.
      single_steps: of reinforcement with one contact, each of which costs a third as much.
      dropout: probability that a sensor or a motion drops out of a prompt with one contact, and of a test object.
      several_dropout: the same of a prompt with several contacts, which teaches to touch again otherwise.
      kept: choices of each question among which look-ups search for several contacts.
      thresholds: probabilities of the likeliest level at which the controls by threshold stop.
    """

    decoder: DecoderConfig = DecoderConfig(vocab_size=0)
    warm: SFTConfig = SFTConfig(
        steps=900,
        batch_size=128,
        questions=1,
        micro_contacts=32,
        optimizer=OptimizerConfig(learning_rate=1e-5, lr_scale=100.0, weight_decay=0.05),
    )
    grpo: GRPOConfig = GRPOConfig(
        prompts=40,
        group=12,
        micro_prompts=10,
        lr_scale=2000.0,
        algorithm=TOUCHES,
    )
    steps: int = 120
    single_steps: int = 200
    dropout: float = 0.1
    several_dropout: float = 0.4
    kept: int = 12
    thresholds: tuple[float, ...] = (0.5, 0.6, 0.7, 0.8, 0.9)

    def __post_init__(self) -> None:
        check_warm_start(self.warm)
        for name in ("dropout", "several_dropout"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigurationError(f"{name} is {getattr(self, name)}: must lie in 0 ≤ {name} < 1; lower it")


@dataclasses.dataclass(frozen=True, kw_only=True)
class SeedPolicy:
    """The warm-started policy of one seed, its beliefs, and what was looked up in them."""

    policy: ActivePolicy
    params: Params
    answer: Answer
    val: Beliefs
    look: LookUps


def make_policy(world: TouchWorld, config: LearnerConfig) -> ActivePolicy:
    """The policy that speaks of the choices of a world."""
    return build_active_policy(world.bank.actions, config.decoder, repeats=False)


def check_arms(world: TouchWorld, policy: ActivePolicy, arms: Mapping[str, Arm]) -> None:
    """Try every arm's budget and prices on the objects of reinforcement before anything is trained."""
    bank = part_of(world.bank, world.parts["reinforced"])
    nothing = np.zeros(0, int)
    for arm in arms.values():
        every = touch_batch_of(policy, bank, nothing, nothing)  # of a bank all questions are tried
        check_exploration(policy, bank, every, prices=arm.prices, budget=arm.budget)


def looked_up(
    world: TouchWorld, policy: ActivePolicy, params: Params, config: LearnerConfig, contacts: int
) -> SeedPolicy:
    """Look-ups in what a policy believes about the validation objects of a world."""
    answer = answerer(policy, params, world.bank)
    val = beliefs_of(world, answer, "val")
    look = look_up(world.bank, val, contacts, config.kept)
    return SeedPolicy(policy=policy, params=params, answer=answer, val=val, look=look)


def with_dropout(world: TouchWorld, share: float, seed: int) -> TouchWorld:
    """The same contacts without those of the sensors and motions that drop out of each object with this probability."""
    stays = drop_out(world.bank, len(world.bank.label), share, np.random.default_rng(seed))
    return dataclasses.replace(world, bank=dataclasses.replace(world.bank, available=world.bank.available & stays))


def warm_params(
    world: TouchWorld, policy: ActivePolicy, config: LearnerConfig, contacts: int, seed: int, context: Context
) -> Params:
    """SFT on touches drawn at random about the objects of the warm start."""
    learned = part_of(world.bank, world.parts["warm"])
    return warm_up(policy, learned, contacts, config.warm, context, f"warm/{seed}", seed)


def beliefs_of(world: TouchWorld, answer: Answer, part: str) -> Beliefs:
    """A policy's beliefs about the objects of a part after each single contact."""
    objects, label = world.parts[part], np.asarray(world.bank.label)
    return Beliefs(single_beliefs(answer, objects, label.shape[1], len(world.bank.choices)), label[objects])


def controls(world: TouchWorld, warm: SeedPolicy, config: LearnerConfig, contacts: int, seed: int) -> dict[str, Played]:
    """Outcomes of plans by rule on test objects; plans of k contacts end in `_k`, but for one contact."""
    bank, objects, look = world.bank, world.parts["test"], warm.look
    n, questions = len(objects), bank.label.shape[1]
    rng = np.random.default_rng([seed, contacts])
    made = {"no_touch": np.full((n, questions, 1), NO_CHOICE, np.int32)}
    for k in range(1, contacts + 1):
        made[counted("random", k)] = at_random((n, questions, len(bank.choices)), k, rng)
        made[counted("best_press", k)] = same_for_all(look.press[k], n, questions)
        made[counted("best_fixed", k)] = same_for_all(look.fixed[k], n, questions)
        made[counted("by_question", k)] = same_for_question(look.by_question[k], n)
    for threshold in config.thresholds:
        name = f"until_{100 * threshold:.0f}"
        made[name] = until_sure(objects, look.order, contacts, threshold, warm.answer)
    return {name: play(bank, objects, choices, warm.answer) for name, choices in made.items()}


def counted(plan: str, contacts: int) -> str:
    """Name of a plan of so many contacts."""
    return plan if contacts == 1 else f"{plan}_{contacts}"


def every_touch(world: TouchWorld, beliefs: Beliefs) -> Played:
    """All contacts of every test object, their beliefs added as if their errors were independent."""
    objects, choices = world.parts["test"], tuple(range(len(world.bank.choices)))
    right = np.stack([beliefs.right(a, choices) for a in beliefs.questions], 1).astype(float)
    total = lambda x: np.broadcast_to(np.asarray(x, float)[objects].sum(1)[:, None], right.shape)
    chosen = same_for_all(choices, *right.shape)
    return Played(right=right, seconds=total(world.bank.seconds), harm=total(world.bank.harm), choices=chosen)


def reinforced(
    world: TouchWorld, warm: SeedPolicy, config: LearnerConfig, name: str, arm: Arm, seed: int, context: Context
) -> dict[str, Any]:
    """Outcomes of a reinforced policy on test objects, as JSON.

    Also those of its contacts answered by the warm start, of contacts that it chooses without observing any, and where
    sensors and motions drop out.
    """
    params = reinforced_params(world, warm.policy, warm.params, config, name, arm, seed, context)
    context.processes.write_once(lambda: publish(world, warm.policy, params, arm.budget, name, seed, context.directory))
    objects = world.parts["test"]
    found = explore(warm.policy, params, world.bank, objects, arm.budget)
    own_answers = play(world.bank, objects, found.choices, warm.answer)
    unseen = dataclasses.replace(world.bank, available=jnp.zeros_like(world.bank.available))
    unseeing = explore(warm.policy, params, unseen, objects, arm.budget)
    chosen_unseen = play(world.bank, objects, unseeing.choices, answerer(warm.policy, params, world.bank))
    lacking = explore(warm.policy, params, with_dropout(world, config.dropout, seed).bank, objects, arm.budget)
    return as_json(
        {
            name: found,
            f"{name}_warm_answers": own_answers,
            f"{name}_unseen": chosen_unseen,
            f"{name}_{MISSING}": lacking,
        }
    )


def played_once(name: str, seed: int, compute: Callable[[], Any], context: Context) -> Any:
    """Stage that `reinforced` saved; where it is done, but its policy cannot be read, it is made again."""
    stage = f"played/{name}/{seed}"
    if context.done(stage):
        try:
            require_published(context.directory, name, seed)
        except PolicyError as error:
            context.print(f"{fault_of(error)}; it is made again")
            compute()
    return context.once(stage, compute)


def reinforced_params(
    world: TouchWorld,
    policy: ActivePolicy,
    params: Params,
    config: LearnerConfig,
    name: str,
    arm: Arm,
    seed: int,
    context: Context,
) -> Params:
    """GRPO on the objects of that part, from the parameters of a warm start."""
    one = arm.budget == 1
    return reinforce(
        policy,
        params,
        part_of(world.bank, world.parts["reinforced"]),
        config.grpo,
        arm.budget,
        arm.prices,
        config.dropout if one else config.several_dropout,
        config.single_steps if one else config.steps,
        context,
        f"grpo/{name}/{seed}",
        seed,
    )


def one_step_look_ahead(
    world: TouchWorld, warm: SeedPolicy, config: LearnerConfig, seed: int, context: Context
) -> dict[str, Any]:
    """SFT that imitates the contact after which the warm start believes most in the true level of training objects."""
    beliefs = beliefs_of(world, warm.answer, "reinforced")
    true = np.take_along_axis(beliefs.log_probs, beliefs.label[:, None, :, None], -1)[..., 0]  # n C A
    learned, best = part_of(world.bank, world.parts["reinforced"]), true.argmax(1).astype(np.int32)
    params = imitate(warm.policy, warm.params, learned, best, config.warm, context, f"imitation/{seed}", seed)
    return as_json({"imitation": explore(warm.policy, params, world.bank, world.parts["test"], 1)})


def of_equal_seconds(found: Mapping[str, Played], policy: Played, contacts: int) -> dict[str, Played]:
    """Plans by rule in the mean time of a policy."""
    seconds = float(policy.seconds.mean())
    return {
        f"{plan}_{EQUAL}": dataclasses.replace(policy, right=at_seconds(found, plan, seconds, contacts))
        for plan in RULES
    }


def at_seconds(found: Mapping[str, Played], plan: str, seconds: float, contacts: int) -> Float[np.ndarray, "n A"]:
    """Right answers of a plan at a mean time of touch: a mixture of its plans of one contact fewer and one more."""
    steps = [found["no_touch"], *(found[counted(plan, k)] for k in range(1, contacts + 1))]
    times = [float(step.seconds.mean()) for step in steps]
    upper = min(int(np.searchsorted(times, seconds)), contacts)
    if upper == 0 or seconds >= times[-1]:
        return steps[upper].right
    share = (seconds - times[upper - 1]) / (times[upper] - times[upper - 1])
    return (1 - share) * steps[upper - 1].right + share * steps[upper].right


def as_json(found: Mapping[str, Played]) -> dict[str, Any]:
    """Saved form of a stage."""
    return {
        name: {k: getattr(one, k).tolist() for k in ("right", "seconds", "harm", "choices")}
        for name, one in found.items()
    }


def from_json(saved: Mapping[str, Any]) -> dict[str, Played]:
    """Outcomes that were saved of a stage."""
    read = lambda one: Played(
        right=np.array(one["right"]),
        seconds=np.array(one["seconds"]),
        harm=np.array(one["harm"]),
        choices=np.array(one["choices"], np.int32),
    )
    return {name: read(one) for name, one in saved.items()}
