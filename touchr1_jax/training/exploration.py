"""Training of a policy that explores: a warm start on random touches, then GRPO on its own trajectories.

policy = build_active_policy(bank.actions, DecoderConfig(vocab_size=0))
params = policy.init(seed, bank.tokens.shape[-1])
params = train_sft(policy, params, RandomTouchFeed(policy, bank, batch_size=16, budget=3, seed=seed), SFTConfig())
params = train_active(policy, params, ActiveFeed(policy, bank, ...), bank, config, LoopConfig(steps=200), ...)
"""

import dataclasses
import functools
from typing import Any

import grain
import jax
import numpy as np
import optax
from jaxtyping import Bool, Float, Int

from touchr1_jax.models.active_policy import ActiveFns, ActivePolicy, Explored
from touchr1_jax.rl.active import ActiveInputs, make_active_step
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.environment import Environment, TouchBank, TouchCase, check_bank, check_environment
from touchr1_jax.rl.grpo import start_state
from touchr1_jax.rl.touch_reward import Prices, TouchReward, check_touch_reward, check_touching_pays, priced_answer
from touchr1_jax.rl.trajectory import ActiveBatch
from touchr1_jax.training.feeds import ONE_AT_A_TIME, Feed
from touchr1_jax.training.loop import SILENT, Batches, Hooks, LoopConfig, fit, peek
from touchr1_jax.training.optimizer import falling_adamw
from touchr1_jax.training.questions import labelled_questions
from touchr1_jax.training.sft import SFTBatch
from touchr1_jax.types import Params

NO_CHOICE = -1
"""Stands in a row of choices where the trajectory has concluded."""


@dataclasses.dataclass(frozen=True)
class WrittenTurns:
    """Tokens of every turn of a policy: [C, L] of actions, [A, K, L] of answers, padded."""

    actions: Int[np.ndarray, "C L"]
    answers: Int[np.ndarray, "A K L"]
    pad: int

    @staticmethod
    def of(policy: ActivePolicy) -> "WrittenTurns":
        """Those of a policy's language."""
        language, tokenizer, length = policy.language, policy.tokenizer, policy.turns.length
        row = lambda text: np.array(
            (ids := tokenizer.encode(text)) + [tokenizer.pad_id] * (length - len(ids)), np.int32
        )
        levels = [[row(language.answer_text(words[0])) for words in a.levels] for a in language.attributes]
        actions = [row(language.action_text(c)) for c in range(len(language.actions))]
        return WrittenTurns(np.stack(actions), np.array(levels), tokenizer.pad_id)

    def trajectories(
        self, choices: Int[np.ndarray, "n B"], question: Int[np.ndarray, "n"], level: Int[np.ndarray, "n"]
    ) -> Int[np.ndarray, "n T"]:
        """Tokens of trajectories with these choices (`NO_CHOICE` after the last) and the answer after them."""
        n, budget = choices.shape
        made = choices != NO_CHOICE
        turns = np.full((n, budget + 1, self.actions.shape[1]), self.pad, np.int32)
        turns[:, :budget] = np.where(made[..., None], self.actions[np.maximum(choices, 0)], self.pad)
        turns[np.arange(n), made.sum(1)] = self.answers[question, level]
        return turns.reshape(n, -1)


def exploration_batch(policy: ActivePolicy, attribute: np.ndarray, label: np.ndarray, case: Any) -> ActiveBatch:
    """One question per row, on the host: row i asks attribute[i].

    Args:
      policy: prompts.
      attribute: int [P].
      label: int [P, A], the level of every attribute, −1 where it is unknown.
      case: the environment's own data of the rows, a tree of arrays [P, …].
    """
    of: dict[str, Any] = {
        "features": policy.prompt_features(len(attribute)),
        "ids": policy.ids[attribute],
        "mask": policy.mask[attribute],
        "target": policy.target(attribute, label),
    }
    return ActiveBatch(**of, case=case)


def touch_batch_of(
    policy: ActivePolicy, bank: TouchBank, which: np.ndarray, attribute: np.ndarray, offered: np.ndarray | None = None
) -> ActiveBatch:
    """One question about an object per row, on the host: row i asks attribute[i] about object which[i].

    Args:
      policy: prompts.
      bank: contacts.
      which, attribute: int [P].
      offered: bool [P, C], choices that have not dropped out; by default all.
    """
    everything = np.ones((len(which), len(bank.choices)), bool)
    case: Any = (np.asarray(which, np.int32), everything if offered is None else offered)
    return exploration_batch(policy, attribute, np.asarray(bank.label)[which], TouchCase(*case))


def observed(
    bank: TouchBank,
    which: Int[np.ndarray, "n"],
    choices: Int[np.ndarray, "n B"],
    offered: Bool[np.ndarray, "n C"] | None = None,
) -> tuple[Float[np.ndarray, "n B N W"], Bool[np.ndarray, "n B N"]]:
    """Observations of these choices about objects, on the host, and where anything is observed."""
    at = which[:, None], np.maximum(choices, 0)
    exists = (choices != NO_CHOICE) & np.asarray(bank.available[at])
    if offered is not None:
        exists &= np.take_along_axis(offered, at[1], 1)
    tokens = np.where(exists[..., None, None], np.asarray(bank.tokens[at]), 0).astype(np.float32)
    return tokens, np.broadcast_to(exists[..., None], tokens.shape[:-1])


def demonstration(
    policy: ActivePolicy,
    written: WrittenTurns,
    bank: TouchBank,
    which: Int[np.ndarray, "P"],
    attribute: Int[np.ndarray, "P"],
    choices: Int[np.ndarray, "P B"],
    offered: Bool[np.ndarray, "P C"] | None = None,
) -> SFTBatch:
    """SFT batch on the host: row i makes its choices about object which[i] and gives the right answer to attribute[i].

    Args:
      policy, written: prompts, and the turns of its language.
      bank: contacts, on the host.
      which, attribute: object and question.
      choices: in order, `NO_CHOICE` after the last.
      offered: choices that have not dropped out; by default all.  Other choices observe nothing.
    """
    n = len(which)
    touch, exists = observed(bank, which, choices, offered)
    tokens = written.trajectories(choices, attribute, np.asarray(bank.label)[which, attribute])
    seen: dict[str, Any] = {
        "prompt": policy.prompt_features(n),
        "touch": touch[:, None],
        "exists": exists[:, None],
        "stream_mask": exists[..., 0].any(1, keepdims=True),
    }
    of: dict[str, Any] = {
        "touch": Explored(**seen),
        "ids": policy.ids[attribute][:, None],
        "mask": policy.mask[attribute][:, None],
        "streams": np.ones((n, 1, 1), bool),
        "tokens": tokens[:, None],
        "token_mask": (tokens != written.pad)[:, None],
    }
    return SFTBatch(**of)


def drop_out(bank: TouchBank, n: int, share: float, rng: np.random.Generator) -> np.ndarray:
    """Choices that stay when each sensor and each motion drops out with probability `share`, bool [n, C].

    A row that would offer fewer than two choices keeps all.
    """
    stays = np.ones((n, len(bank.choices)), bool)
    for names in ([c.sensor for c in bank.choices], [c.motion for c in bank.choices]):
        different, index = np.unique(names, return_inverse=True)
        stays &= (rng.random((n, len(different))) >= share)[:, index]
    return stays | (stays.sum(1, keepdims=True) < 2)


class _BankFeed(Feed):
    """Questions about the objects of a bank, each once an epoch, in random order."""

    def __init__(
        self, policy: ActivePolicy, bank: TouchBank, *, batch_size: int, seed: int, dropout: float = 0.0
    ) -> None:
        if not 0 <= dropout < 1:
            raise ValueError(f"dropout is {dropout}: must lie in 0 ≤ dropout < 1; lower it")
        check_bank(bank)
        self._policy, self._bank, self._dropout = policy, jax.device_get(bank), dropout
        self._object, self._attribute = labelled_questions(np.asarray(bank.label))
        n = len(self._object)
        # (seed, batch) is the seed of what a batch draws (`Feed`), and a last 0 would change nothing
        order = functools.lru_cache(2)(lambda epoch: np.random.default_rng((seed, epoch, 1)).permutation(n))

        def rows(batch: int, _: Any) -> Int[np.ndarray, "P"]:
            epoch, place = np.divmod(batch * batch_size + np.arange(batch_size), n)
            return np.array([order(e)[i] for e, i in zip(epoch.tolist(), place, strict=True)])

        # Grain's own shuffle takes .1 ms a row: a tenth of a warm start
        batches = grain.MapDataset.range(1).repeat().map_with_index(rows)
        super().__init__(batches.to_iter_dataset(ONE_AT_A_TIME), seed)


class ActiveFeed(_BankFeed):
    """GRPO batches: questions about objects of a bank, each with the choices that have not dropped out.

    Args:
      policy: prompts.
      bank: contacts of the training objects.
      batch_size: prompts of a batch.
      seed: of the order and of what drops out.
      dropout: probability that a sensor or a motion drops out.
    """

    def make(self, element: np.ndarray, rng: np.random.Generator) -> ActiveBatch:
        """One batch of questions."""
        which, attribute = self._object[element], self._attribute[element]
        offered = drop_out(self._bank, len(which), self._dropout, rng)
        return touch_batch_of(self._policy, self._bank, which, attribute, offered)


class RandomTouchFeed(_BankFeed):
    """SFT batches: trajectories of 0 to `budget` different touches at random, then the label as answer.

    Number and choice of the touches are uniform, so that the batches do not show which touch is good.  The arguments
    are those of `ActiveFeed`.
    """

    def __init__(self, policy: ActivePolicy, bank: TouchBank, *, budget: int, **options: Any) -> None:
        super().__init__(policy, bank, **options)
        if not 1 <= budget <= len(bank.choices):
            raise ValueError(f"budget is {budget}: must lie in 1 … {len(bank.choices)}, the choices; change it")
        self._budget, self._written = budget, WrittenTurns.of(policy)

    def make(self, element: np.ndarray, rng: np.random.Generator) -> SFTBatch:
        """One batch of trajectories."""
        which, attribute, n = self._object[element], self._attribute[element], len(element)
        offered = drop_out(self._bank, n, self._dropout, rng)
        chosen = np.argsort(rng.random(offered.shape), 1)[:, : self._budget]
        taken = np.arange(self._budget) < rng.integers(0, self._budget + 1, (n, 1))
        choices = np.where(taken, chosen, NO_CHOICE)
        return demonstration(self._policy, self._written, self._bank, which, attribute, choices, offered)


def train_active(
    policy: ActivePolicy,
    params: Params,
    batches: Batches,
    environment: Environment,
    config: GRPOConfig,
    loop: LoopConfig,
    hooks: Hooks = SILENT,
    *,
    prices: Prices,
    budget: int,
    reward: TouchReward = priced_answer,
    seed: int = 0,
) -> Params:
    """Train a policy by GRPO on its own trajectories; the reference is the initial policy.

    Args:
      policy: prompts, turns and forward passes.
      params: of the policy after its warm start.
      batches: `ActiveBatch`es of `config.drawn` prompts, for example of an `ActiveFeed`.
      environment: the environment of the actions.
      config: sizes of a step and algorithm; `length` is `policy.tokens(budget)`.
      loop: number of steps.
      hooks: log, checkpoints, devices.
      prices: of a second and of a unit of harm.
      budget: most actions of a trajectory.
      reward: terms of the reward of one trajectory.
      seed: of the trajectories.

    Raises:
      EnvironmentCheckError: an environment from which nothing can be learned.
      RewardError: a reward that is not finite, or prices so high that touching never pays.
      ValueError: settings that trajectories cannot have.
    """
    check_exploration(policy, environment, peek(batches), prices=prices, budget=budget, reward=reward)
    fns = policy.constrained_fns if config.algorithm.constrained else policy.fns
    optimizer, step = active_program(fns, reward, config, budget, loop.steps)
    state = start_state(params, optimizer, jax.random.key(seed), config)
    inputs = ActiveInputs(reference=params, environment=environment, prices=prices)
    step, state, batches = hooks.devices.shard(step, state, batches, config.drawn, inputs)
    return hooks.devices.gather(fit(step, state, batches, loop, hooks).params)


def check_exploration(
    policy: ActivePolicy,
    environment: Environment,
    batch: ActiveBatch,
    *,
    prices: Prices,
    budget: int,
    reward: TouchReward = priced_answer,
) -> None:
    """Try environment and reward on a batch before training; with a `TouchBank`, on all objects and questions.

    Raises:
      EnvironmentCheckError, RewardError: as `train_active`.
    """
    if isinstance(environment, TouchBank):
        check_bank(environment)
        which, attribute = labelled_questions(np.asarray(environment.label))
        batch = touch_batch_of(policy, environment, which, attribute)
    outcome = check_environment(environment, batch.case, budget=budget)
    check_touch_reward(reward, prices, batch.target, outcome, budget)
    if isinstance(environment, TouchBank):
        check_touching_pays(reward, prices, batch.target, outcome)


@functools.cache
def active_program(
    fns: ActiveFns, reward: TouchReward, config: GRPOConfig, budget: int, steps: int
) -> tuple[optax.GradientTransformation, Any]:
    """Optimizer and compiled step, made once for all seeds and prices."""
    updates = steps * config.algorithm.updates * config.algorithm.minibatches
    rate = config.learning_rate * config.lr_scale
    optimizer = falling_adamw(rate, config.final_share, updates, config.max_grad_norm)
    return optimizer, make_active_step(fns, optimizer, config, budget, reward)
