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

Observation = dict[str, np.ndarray]
"""Float32 arrays [E, …] of E episodes by their names."""

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
    share of the budget; `touch`, the observed tokens [B, N, W], 0 where there is none, or the result of `encode`.  An
    action beyond the budget ends the episode without an answer.

    Args:
      environment: the environment of the actions.
      batch: prompts, whose text is ignored.
      budget: most actions of an episode.
      prices, reward: as in training.
      encode: computes the observation `touch` from the observed tokens.

    Raises:
      ImportError: Gymnasium is not installed.
      EnvironmentCheckError: as `check_environment`.
    """
    try:
        import gymnasium
    except ImportError as error:
        raise ImportError("gymnasium is not installed; run: pip install 'touchr1-jax[gymnasium]'") from error
    episodes = Episodes(environment, batch, budget=budget, prices=prices, reward=reward, encode=encode)

    class ExplorationEnv(gymnasium.Env):
        """Episodes of questions about objects."""

        action_space, observation_space = episodes.spaces()

        def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            """A new question; `options={"prompt": i}` chooses it."""
            super().reset(seed=seed)
            drawn = int(self.np_random.integers(episodes.prompts))
            return _only(episodes.begin(np.array([(options or {}).get("prompt", drawn)]))), {}

        def step(self, action: Any) -> Any:
            """Take an action or conclude."""
            seen, reward, ended, totals = episodes.step(np.array([action]))
            return _only(seen), float(reward[0]), bool(ended[0]), False, totals[0]

    return ExplorationEnv()


class Episodes:
    """E episodes at once, on the host; the reward of each comes with its last step.

    Attributes:
      prompts, actions: number of prompts; number of actions and levels.
    """

    def __init__(
        self,
        environment: Environment,
        batch: ActiveBatch,
        *,
        budget: int,
        prices: Prices,
        reward: TouchReward = priced_answer,
        encode: Encode | None = None,
        count: int = 1,
    ) -> None:
        """See `make_gymnasium_env`; `count` is E."""
        outcome = check_environment(environment, batch.case, budget=budget)
        self._cases, self._target = jax.device_get((batch.case, batch.target))
        self._encode, self._kinds = encode, len(environment.actions)
        self.prompts, self.count = len(self._target.label), count
        self.actions = self._kinds + int(np.max(self._target.levels))
        self._prompt = np.zeros(count, np.int32)
        self._taken = np.full((count, budget), -1, np.int32)
        self._touch = np.zeros((count, budget, *outcome.tokens.shape[-2:]), np.float32)
        self._exists = np.zeros(self._touch.shape[:3], bool)
        self._seconds, self._harm = np.zeros(count, np.float32), np.zeros(count, np.float32)
        self._step = jax.jit(jax.vmap(lambda state, action: environment.step(state, action)))
        self._score = jax.jit(jax.vmap(lambda parsed, target, spent: reward(parsed, target, spent, prices)))
        self._begin = jax.jit(jax.vmap(lambda new, case, old: _where(new, environment.reset(case), old)))
        self._state = jax.jit(jax.vmap(environment.reset))(self._of_prompts(self._cases))

    def begin(self, prompts: Int[np.ndarray, "E"], new: Bool[np.ndarray, "E"] | None = None) -> Observation:
        """Begin the episodes of some prompts, by default all, and observe."""
        new = np.ones(self.count, bool) if new is None else new
        self._prompt = np.where(new, prompts, self._prompt)
        self._state = self._begin(new, self._of_prompts(self._cases), self._state)
        for x, empty in ((self._taken, -1), (self._touch, 0), (self._exists, 0), (self._seconds, 0), (self._harm, 0)):
            x[new] = empty
        return self._observation()

    def step(
        self, actions: Int[np.ndarray, "E"]
    ) -> tuple[Observation, Float[np.ndarray, "E"], Bool[np.ndarray, "E"], list[dict[str, Any]]]:
        """Take an action in every episode: observations, rewards, which episodes end, and totals.

        Raises:
          ValueError: an action that is no number 0 … `actions` − 1.
        """
        if np.any((actions < 0) | (actions >= self.actions)):
            raise ValueError(f"actions are {actions}: must lie in 0 … {self.actions - 1}; correct the agent")
        used = (self._taken >= 0).sum(1)
        going = np.flatnonzero((actions < self._kinds) & (used < self._taken.shape[1]))
        self._state, outcome = jax.device_get(self._step(self._state, np.minimum(actions, self._kinds - 1)))
        at = going, used[going]
        self._taken[at], self._exists[at] = actions[going], outcome.exists[going]
        self._touch[at] = np.where(outcome.exists[going, :, None], outcome.tokens[going], 0)
        self._seconds[going] += outcome.seconds[going]
        self._harm[going] += outcome.harm[going]
        ended = np.ones(self.count, bool)
        ended[going] = False
        rewards = np.where(ended, self._earned(np.maximum(actions - self._kinds, -1)), 0)
        rows = zip(self._seconds.tolist(), self._harm.tolist(), self._taken.tolist(), strict=True)
        totals = [{"seconds": s, "harm": h, "actions": tuple(a for a in taken if a >= 0)} for s, h, taken in rows]
        return self._observation(), rewards, ended, totals

    def spaces(self) -> tuple[Any, Any]:
        """Gymnasium's spaces of one episode's actions and observations."""
        from gymnasium.spaces import Box, Dict, Discrete

        widest = float(np.finfo(np.float32).max)  # Gymnasium's check warns of infinite bounds
        bounds = {"question": (0, 1), "actions": (0, 1), "touch": (-widest, widest)}
        seen = {name: Box(*bounds[name], x.shape[1:], np.float32) for name, x in self._observation().items()}
        return Discrete(self.actions), Dict(seen)

    def _of_prompts(self, tree: Any) -> Any:
        return jax.tree.map(lambda x: x[self._prompt], tree)

    def _earned(self, level: Int[np.ndarray, "E"]) -> Float[np.ndarray, "E"]:
        """Rewards of episodes that conclude with a level, −1 for none."""
        target, some = self._of_prompts(self._target), level >= 0
        answer = np.where(target.asked, level[:, None], -1).astype(np.int32)
        slots: dict[str, Any] = {"perceive": answer[:, None], "compare": answer, "conclude": answer}
        ended: dict[str, Any] = {"formatted": some, "truncated": ~some, "length": np.zeros(self.count, np.int32)}
        spent: Any = (self._seconds, self._harm, (self._taken >= 0).sum(1, dtype=np.int32))
        terms = jax.device_get(self._score(Parsed(**slots, **ended), target, Spent(*spent)))
        return np.stack(list(terms.values())).sum(0)

    def _observation(self) -> Observation:
        touch = self._touch
        if self._encode is not None:
            touch = np.stack([self._encode(*one) for one in zip(touch, self._exists, self._taken, strict=True)])
        times = (self._taken[:, :, None] == np.arange(self._kinds)).sum(1)
        return {
            "question": self._of_prompts(self._target.asked).astype(np.float32),
            "actions": (times / self._taken.shape[1]).astype(np.float32),
            "touch": np.array(touch, np.float32),
        }


def _only(observation: Observation) -> Observation:
    return {name: x[0] for name, x in observation.items()}


def _where(which: Any, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(which, x, y), new, old)
