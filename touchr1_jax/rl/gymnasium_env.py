"""An environment of this package as a Gymnasium environment, for agents of other libraries.

    pip install 'touchr1-jax[gymnasium]'
    env = make_gymnasium_env(bank, batch, budget=3, prices=prices)

An episode is one question.  Actions 0 … C − 1 are those of the environment, and C + k concludes with level k of the
asked attribute.  The reward of an episode comes with its last step, as in training.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from touchr1_jax.rl.environment import Environment, check_environment
from touchr1_jax.rl.touch_reward import Prices, Spent, TouchReward, priced_answer
from touchr1_jax.rl.trajectory import ActiveBatch
from touchr1_jax.types import Parsed

Encode = Callable[[Float[np.ndarray, "B N W"], Bool[np.ndarray, "B N"], Int[np.ndarray, "B"]], np.ndarray]
"""(tokens, which exist, actions or −1) of an episode so far → a float32 array of one shape, such as beliefs."""


def make_gymnasium_env(
    environment: Environment,
    batch: ActiveBatch,
    *,
    budget: int,
    prices: Prices,
    reward: TouchReward = priced_answer,
    encode: Encode | None = None,
) -> Any:
    """A `gymnasium.Env` whose episodes are the prompts of a batch, drawn at random.

    Its observation is a dictionary: `question`, the asked attributes; `actions`, how often each action was taken, as a
    share of the budget; `touch`, the observed tokens [B, N, W], 0 where there is none, or what `encode` makes of them.
    An action after the last one that is allowed ends the episode without an answer.

    Args:
      environment: what the actions are taken in.
      batch: prompts, whose text is ignored.
      budget: most actions of an episode.
      prices, reward: as in training.
      encode: makes the observation `touch` from what was observed.

    Raises:
      ImportError: Gymnasium is not installed.
      EnvironmentCheckError: as `check_environment`.
    """
    try:
        import gymnasium
    except ImportError as error:
        raise ImportError("gymnasium is not installed; run: pip install 'touchr1-jax[gymnasium]'") from error
    episodes = _Episodes(environment, batch, budget, prices, reward, encode)
    widest = float(np.finfo(np.float32).max)  # Gymnasium's check warns of infinite bounds
    bounds = {"question": (0, 1), "actions": (0, 1), "touch": (-widest, widest)}
    spaces = {name: gymnasium.spaces.Box(*bounds[name], x.shape, np.float32) for name, x in episodes.begin(0).items()}

    class ExplorationEnv(gymnasium.Env):
        """Episodes of questions about objects."""

        action_space = gymnasium.spaces.Discrete(episodes.actions)
        observation_space = gymnasium.spaces.Dict(spaces)

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            """A new question; `options={"prompt": i}` chooses it."""
            super().reset(seed=seed)
            drawn = int(self.np_random.integers(episodes.prompts))
            return episodes.begin(int((options or {}).get("prompt", drawn))), {}

        def step(self, action: Any) -> Any:
            """Take an action or conclude."""
            return episodes.step(int(action))

    return ExplorationEnv()


class _Episodes:
    """One episode after the other, on the host."""

    def __init__(
        self,
        environment: Environment,
        batch: ActiveBatch,
        budget: int,
        prices: Prices,
        reward: TouchReward,
        encode: Encode | None,
    ) -> None:
        outcome = check_environment(environment, batch.case, budget=budget)
        self._shape = (budget, *outcome.tokens.shape[-2:])
        self._cases, self._target = jax.device_get((batch.case, batch.target))
        self._budget, self._encode, self._count = budget, encode, len(environment.actions)
        self.prompts = len(self._target.label)
        self.actions = self._count + int(np.max(self._target.levels))
        self._reset = jax.jit(lambda case: environment.reset(case))
        self._step = jax.jit(lambda state, action: environment.step(state, action))
        self._score = jax.jit(lambda parsed, target, spent: reward(parsed, target, spent, prices))

    def begin(self, prompt: int) -> dict[str, np.ndarray]:
        """First observation of an episode."""
        take = lambda tree: jax.tree.map(lambda x: jnp.asarray(x[prompt]), tree)
        self._now, self._state = take(self._target), self._reset(take(self._cases))
        self._touch, self._exists = np.zeros(self._shape, np.float32), np.zeros(self._shape[:2], bool)
        self._taken, self._seconds, self._harm = list[int](), 0.0, 0.0
        return self._observation()

    def step(self, action: int) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Observation, reward, end, False, and the totals of an episode."""
        if action >= self._count or len(self._taken) == self._budget:
            level = action - self._count if action >= self._count else -1
            return self._observation(), self._earned(level), True, False, self._totals()
        self._state, outcome = self._step(self._state, jnp.int32(action))
        place = len(self._taken)
        self._exists[place] = outcome.exists
        self._touch[place] = np.where(self._exists[place][:, None], outcome.tokens, 0)
        self._taken.append(action)
        self._seconds, self._harm = self._seconds + float(outcome.seconds), self._harm + float(outcome.harm)
        return self._observation(), 0.0, False, False, self._totals()

    def _totals(self) -> dict[str, Any]:
        return {"seconds": self._seconds, "harm": self._harm, "actions": tuple(self._taken)}

    def _earned(self, level: int) -> float:
        answer = jnp.where(self._now.asked, level, -1).astype(jnp.int32)
        some = jnp.array(level >= 0)
        parsed = Parsed(
            perceive=answer[None], compare=answer, conclude=answer, formatted=some, truncated=~some, length=jnp.int32(0)
        )
        spent = Spent(jnp.float32(self._seconds), jnp.float32(self._harm), jnp.int32(len(self._taken)))
        return float(sum(self._score(parsed, self._now, spent).values()))

    def _observation(self) -> dict[str, np.ndarray]:
        taken = np.bincount(np.array(self._taken, int), minlength=self._count)
        actions = np.array(self._taken + [-1] * (self._budget - len(self._taken)))
        touch = self._touch if self._encode is None else self._encode(self._touch, self._exists, actions)
        return {
            "question": np.asarray(self._now.asked, np.float32),
            "actions": (taken / self._budget).astype(np.float32),
            "touch": np.array(touch, np.float32),
        }
