"""Cost of a step on trajectories, compared with a step on single answers of as many tokens."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.active.arms import LearnerConfig, SeedPolicy
from experiments.active.policies import part_of
from experiments.active.world import TouchWorld
from experiments.core.context import Context
from experiments.core.results import Requirement, Table, at_most, named_table
from experiments.core.timing import interleaved
from touchr1_jax.models.active_policy import ActivePolicy
from touchr1_jax.models.policy import Slots
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl.active import ActiveInputs
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.grpo import FrozenInputs, make_grpo_step, start_state
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.rl.touch_reward import Prices, priced_answer
from touchr1_jax.training.compilation import committed
from touchr1_jax.training.exploration import active_program, touch_batch_of
from touchr1_jax.types import Params, Parsed, Target

TURNS, SHARED, WHOLE = "turns", "one turn, observations in the prompt", "one turn of as many tokens"
MOST_RATIO = 1.5

_ROUNDS = 9


def step_cost(
    world: TouchWorld, warm: SeedPolicy, learner: LearnerConfig, contacts: int, context: Context
) -> dict[str, Any]:
    """Seconds of all steps in rounds that alternate, and the programs that the step on trajectories was compiled to.

    The step on trajectories is that of training, constrained and with enumerated answers.  One answer is written
    without a constraint, once of as many tokens as a trajectory has with its observations, once of as many as its turns
    have; the observations then stand in the prompt, which a whole group shares.
    """
    config = dataclasses.replace(learner.grpo, length=warm.policy.tokens(contacts))
    bank = part_of(world.bank, world.parts["reinforced"])
    rng = np.random.default_rng(0)
    which = rng.integers(len(bank.label), size=config.drawn)
    batch = touch_batch_of(warm.policy, bank, which, rng.integers(bank.label.shape[1], size=config.drawn))
    fns = warm.policy.constrained_fns if config.algorithm.constrained else warm.policy.fns
    optimizer, step = active_program(fns, priced_answer, config, contacts, learner.steps)
    inputs = ActiveInputs(warm.params, bank, Prices(jnp.float32(0.0), jnp.float32(0.0)))
    written, observed = config.length, contacts * bank.tokens.shape[2]
    tokens = {TURNS: (written, observed), WHOLE: (written + observed - 1, 1), SHARED: (written, observed)}
    calls = {TURNS: _repeated(step, start_state(warm.params, optimizer, jax.random.key(0), config), batch, inputs)}
    for name in (WHOLE, SHARED):
        length, given = tokens[name]
        single = dataclasses.replace(config, length=length)
        calls[name] = single_turn(warm.policy, warm.params, single, batch, given)
    for call in calls.values():
        jax.block_until_ready(call())
    before = step._cache_size()
    seconds = interleaved(calls, context.rounds("timing steps", _ROUNDS))
    return {
        "seconds": {name: s.tolist() for name, s in seconds.items()},
        "tokens": tokens,
        "traces": 1 + step._cache_size() - before,
    }


def single_turn(
    policy: ActivePolicy, params: Params, config: GRPOConfig, batch: GRPOBatch, observed: int
) -> Callable[[], Any]:
    """A step of `make_grpo_step` on the same questions, which `observed` encoded tokens of touch follow."""
    asked, width = batch.ids.shape
    module, plain = policy.fns.module, policy.fns
    size = module.config.decoder.hidden_size
    slots = Slots(np.arange(width, width + observed)[None], np.zeros(0, np.int32), np.full(width + observed, -1))
    fns = PolicyFns(module=module, slots=slots, banned=plain.banned, end_ids=(), pad_id=plain.pad_id)
    touch = np.random.default_rng(0).normal(size=(asked, 1, observed, size)).astype(np.float32)
    features = dataclasses.replace(
        batch.features,
        touch=jnp.asarray(touch),
        touch_time=jnp.zeros((asked, 1, observed), jnp.int32),
        stream_mask=jnp.ones((asked, 1), bool),
    )
    widths = ((0, 0), (0, observed))
    given = GRPOBatch(
        features=features,
        ids=jnp.pad(jnp.asarray(batch.ids), widths),
        mask=jnp.pad(jnp.asarray(batch.mask), widths, constant_values=True),
        target=batch.target,
    )
    sampled: dict[str, Any] = {"constrained": False, "enumerated": None, "learn_conclusion": True}
    free: Any = dataclasses.replace(config.algorithm, **sampled, reference_every=None, reference_share=1.0)
    config = dataclasses.replace(config, algorithm=free)
    optimizer = optax.adamw(config.learning_rate)
    step = make_grpo_step(fns, _first_token, optimizer, config)
    state = start_state(params, optimizer, jax.random.key(0), config)
    return _repeated(step, state, given, FrozenInputs(params, jnp.asarray(touch[:1])))


def _first_token(tokens: jax.Array, target: Target) -> tuple[jax.Array, dict[str, jax.Array], Parsed]:
    """A reward that costs nothing: whether the first token is even."""
    answer = jnp.full(target.asked.shape, -1)
    parsed = Parsed(
        perceive=answer[None],
        compare=answer,
        conclude=answer,
        formatted=jnp.array(True),
        truncated=jnp.array(False),
        length=jnp.int32(len(tokens)),
    )
    reward = (tokens[0] % 2).astype(jnp.float32)
    return reward, {"even": reward}, parsed


def _repeated(step: Callable[..., Any], state: Any, batch: Any, inputs: Any) -> Callable[[], Any]:
    """Calls of a step, each from the state that the last one left; as in training, all but the batch is committed."""
    state, inputs = committed((state, inputs))

    def call() -> Any:
        nonlocal state
        state, metrics = step(state, batch, inputs)
        return metrics

    return call


def cost_ratios(cost: dict[str, Any], name: str) -> np.ndarray:
    """Time of a step on trajectories over that of a step on one answer in each round."""
    return np.array(cost["seconds"][TURNS]) / np.array(cost["seconds"][name])


def cost_table(cost: dict[str, Any]) -> Table:
    """Times of all steps."""
    rows = [
        {
            "step": name,
            "written": cost["tokens"][name][0],
            "observed": cost["tokens"][name][1],
            "median": float(np.median(seconds)),
            "turns over it": float(np.median(cost_ratios(cost, name))),
        }
        for name, seconds in cost["seconds"].items()
    ]
    return named_table(
        "Cost of a step",
        rows,
        formats={"median": ".3f", "turns over it": ".2f"},
        units={"median": "s", "turns over it": "×"},
        meanings={
            "written": "tokens of all turns of a trajectory, or of the one answer",
            "observed": "tokens of all observations of a trajectory; in one turn they stand in the prompt",
        },
        note=f"{_ROUNDS} rounds in one process, which alternate between the steps; medians over rounds.",
    )


def cost_requirements(cost: dict[str, Any]) -> tuple[Requirement, ...]:
    """Bounds on the cost of turns."""
    ratios, shared = (cost_ratios(cost, name) for name in (WHOLE, SHARED))
    return (
        at_most(
            "step on turns over a step on one turn of as many tokens",
            float(np.median(ratios)),
            MOST_RATIO,
            "×",
            f"median of {len(ratios)} rounds, {ratios.min():.2f} to {ratios.max():.2f}; where the whole group shares "
            f"the observations {np.median(shared):.2f}",
        ),
        at_most("programs of the step on turns", float(cost["traces"]), 1.0, ""),
    )
