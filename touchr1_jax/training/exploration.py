"""Training of a policy that explores: a warm start on random touches, then GRPO on its own trajectories.

policy = build_active_policy(bank.actions, DecoderConfig(vocab_size=0))
params = policy.init(seed, bank.tokens.shape[-1])
params = train_sft(policy, params, RandomTouchFeed(policy, bank, batch_size=16, budget=3, seed=seed), SFTConfig())
params = train_active(policy, params, ActiveFeed(policy, bank, ...), bank, config, LoopConfig(steps=200), ...)
"""

import functools
from typing import Any

import grain
import jax
import numpy as np
import optax

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
    """Questions about the objects of a bank in random order."""

    def __init__(
        self, policy: ActivePolicy, bank: TouchBank, *, batch_size: int, seed: int, dropout: float = 0.0
    ) -> None:
        if not 0 <= dropout < 1:
            raise ValueError(f"dropout is {dropout}: must lie in 0 ≤ dropout < 1; lower it")
        check_bank(bank)
        self._policy, self._bank, self._dropout = policy, jax.device_get(bank), dropout
        self._object, self._attribute = labelled_questions(np.asarray(bank.label))
        order = grain.MapDataset.range(len(self._object)).seed(seed).shuffle().repeat().batch(batch_size)
        super().__init__(order.to_iter_dataset(ONE_AT_A_TIME), seed)


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

    Number and choice of the touches are uniform, so that nothing shows which touch is good.  The arguments are those of
    `ActiveFeed`.
    """

    def __init__(self, policy: ActivePolicy, bank: TouchBank, *, budget: int, **options: Any) -> None:
        super().__init__(policy, bank, **options)
        if not 1 <= budget <= len(bank.choices):
            raise ValueError(f"budget is {budget}: must lie in 1 … {len(bank.choices)}, the choices; change it")
        self._budget = budget
        language, encode = policy.language, policy.tokenizer.encode
        self._actions = [encode(language.action_text(i)) for i in range(len(language.actions))]
        self._answers = [[encode(language.answer_text(words[0])) for words in a.levels] for a in language.attributes]

    def make(self, element: np.ndarray, rng: np.random.Generator) -> SFTBatch:
        """One batch of trajectories."""
        which, attribute, n = self._object[element], self._attribute[element], len(element)
        batch = touch_batch_of(self._policy, self._bank, which, attribute)
        offered = drop_out(self._bank, n, self._dropout, rng)
        chosen = np.argsort(rng.random(offered.shape), 1)[:, : self._budget]
        taken = np.arange(self._budget) < rng.integers(0, self._budget + 1, (n, 1))
        rows = np.arange(n)[:, None]
        felt = taken & offered[rows, chosen] & self._bank.available[which[:, None], chosen]
        touch = np.where(felt[..., None, None], self._bank.tokens[which[:, None], chosen], 0).astype(np.float32)
        tokens = np.stack([self._written(*row) for row in zip(chosen, taken.sum(1), attribute, which, strict=True)])
        seen: dict[str, Any] = {
            "prompt": batch.features,
            "touch": touch[:, None],
            "exists": np.broadcast_to(felt[:, None, :, None], (n, 1, *touch.shape[1:3])),
            "stream_mask": felt.any(1, keepdims=True),
        }
        of: dict[str, Any] = {
            "touch": Explored(**seen),
            "ids": batch.ids[:, None],
            "mask": batch.mask[:, None],
            "streams": np.ones((n, 1, 1), bool),
            "tokens": tokens[:, None],
            "token_mask": (tokens != self._policy.tokenizer.pad_id)[:, None],
        }
        return SFTBatch(**of)

    def _written(self, chosen: np.ndarray, count: int, attribute: int, which: int) -> np.ndarray:
        """Tokens [T] of some actions and the right answer."""
        level = int(self._bank.label[which, attribute])
        turns = [*(self._actions[c] for c in chosen[:count]), self._answers[attribute][level]]
        tokens = np.full((self._budget + 1, self._policy.turns.length), self._policy.tokenizer.pad_id, np.int32)
        for row, ids in zip(tokens, turns, strict=False):
            row[: len(ids)] = ids
        return tokens.reshape(-1)


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
    """Reinforce a policy by GRPO on its own trajectories; the reference is where it starts.

    Args:
      policy: prompts, turns and forward passes.
      params: of the policy after its warm start.
      batches: `ActiveBatch`es of `config.drawn` prompts, for example of an `ActiveFeed`.
      environment: what the actions are taken in.
      config: sizes of a step and algorithm; `length` is `policy.tokens(budget)`.
      loop: number of steps.
      hooks: log, checkpoints, devices.
      prices: of a second and of a unit of harm.
      budget: most actions of a trajectory.
      reward: terms of the reward of one trajectory.
      seed: of the trajectories.

    Raises:
      EnvironmentCheckError: an environment from which nothing can be learned.
      RewardError: a reward that is not finite, or prices at which touching never pays.
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
    """Try environment and reward on a batch before training; of a `TouchBank`, all objects and questions.

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
