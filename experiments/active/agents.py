"""An agent of another library in the same environment: PPO of Stable-Baselines3.

    pip install 'touchr1-jax[agents]'
    python -m experiments active_touch --agents

The agent learns through `rl.gymnasium_env` from the training objects of the policies and pays the same prices.  Its
settings are those with the most reward on validation objects.
"""

import dataclasses
import importlib.util
import itertools
from typing import Any

import numpy as np
from jaxtyping import Int

from experiments.active.arms import Arm, as_json
from experiments.active.contacts import PROPERTIES
from experiments.active.plans import Played
from experiments.active.world import TouchWorld
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.results import Table, named_table
from touchr1_jax.models.active_policy import ActivePolicy
from touchr1_jax.rl.environment import TouchBank
from touchr1_jax.rl.gymnasium_env import Episodes
from touchr1_jax.training.exploration import NO_CHOICE, touch_batch_of

AGENT = "ppo"
PACKAGES = ("gymnasium", "stable_baselines3")
INSTALL = "pip install 'touchr1-jax[agents]'"


@dataclasses.dataclass(frozen=True, kw_only=True)
class AgentConfig:
    """Training of PPO; every learning rate is tried with every weight of the entropy bonus.

    Args:
      steps: actions and answers of a training.
      episodes: that run at once.
      rollout: steps of all of them between updates.
      batch_size: of an update.
      rates, entropies: that are tried.
    """

    steps: int = 200_000
    episodes: int = 64
    rollout: int = 4096
    batch_size: int = 512
    rates: tuple[float, ...] = (3e-4, 1e-3)
    entropies: tuple[float, ...] = (0.003, 0.02)


def missing_packages() -> list[str]:
    """Packages of the agents that are not installed."""
    return [name for name in PACKAGES if importlib.util.find_spec(name) is None]


def check_installed() -> None:
    """Require the packages of the agents.

    Raises:
      ConfigurationError: one is missing.
    """
    missing = missing_packages()
    if missing:
        raise ConfigurationError(f"agents is True: {', '.join(missing)} not installed; run {INSTALL}, or leave it out")


def agent_played(
    world: TouchWorld, policy: ActivePolicy, arm: Arm, config: AgentConfig, name: str, seed: int, context: Context
) -> dict[str, Any]:
    """Outcomes about test objects of the agent that earns most about validation objects, and its settings, as JSON."""
    learned = np.concatenate([world.parts["warm"], world.parts["reinforced"]])
    tried: dict[tuple[float, float], tuple[float, Any]] = {}
    for rate, entropy in context.each(name, tuple(itertools.product(config.rates, config.entropies))):
        model = _trained(world.bank, policy, learned, arm, config, rate, entropy, seed)
        of_val = _played(world.bank, policy, model, world.parts["val"], arm)
        worth = float((of_val.right - arm.second * of_val.seconds - arm.harm * of_val.harm).mean())
        tried[rate, entropy] = worth, model
        context.print(f"{name}, rate {rate:g}, entropy {entropy:g}: {worth:.3f} earned about validation objects")
    (rate, entropy), (worth, model) = max(tried.items(), key=lambda item: item[1][0])
    found = as_json({name: _played(world.bank, policy, model, world.parts["test"], arm)})
    return {"played": found, "settings": {"learning rate": rate, "entropy bonus": entropy, "earned": worth}}


def _episodes(
    bank: TouchBank, policy: ActivePolicy, objects: Int[np.ndarray, "n"], arm: Arm, count: int | None = None
) -> Episodes:
    """Episodes of every question about some objects, object by object; by default all at once."""
    which, asked = _every_question(objects)
    batch = touch_batch_of(policy, bank, which, asked)
    return Episodes(bank, batch, budget=arm.budget, prices=arm.prices, count=count or len(which))


def _vectorised(episodes: Episodes, seed: int) -> Any:
    """Episodes as Stable-Baselines3 steps through them: one that ends begins anew with a prompt drawn at random."""
    from stable_baselines3.common.vec_env import VecEnv

    rng = np.random.default_rng(seed)
    drawn = lambda: rng.integers(episodes.prompts, size=episodes.count)

    class Vectorised(VecEnv):
        def __init__(self) -> None:
            action_space, observation_space = episodes.spaces()
            self.render_mode = None
            super().__init__(episodes.count, observation_space, action_space)

        def reset(self) -> Any:
            return episodes.begin(drawn())

        def step_async(self, actions: np.ndarray) -> None:
            self._actions = actions

        def step_wait(self) -> Any:
            _, rewards, ended, totals = episodes.step(self._actions)
            return episodes.begin(drawn(), ended), rewards, ended, totals

        def close(self) -> None:
            pass

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(self, attr_name)] * self.num_envs

        # the interface asks for these two; PPO calls neither, and there is no environment of one episode to reach
        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise NotImplementedError(f"{attr_name}: episodes step together and have no attributes of their own")

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **options: Any) -> list[Any]:
            raise NotImplementedError(f"{method_name}: episodes step together and have no methods of their own")

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False] * self.num_envs

    return Vectorised()


def _every_question(objects: Int[np.ndarray, "n"]) -> tuple[np.ndarray, np.ndarray]:
    return np.repeat(objects, len(PROPERTIES)), np.tile(np.arange(len(PROPERTIES)), len(objects))


def _trained(
    bank: TouchBank,
    policy: ActivePolicy,
    objects: Int[np.ndarray, "n"],
    arm: Arm,
    config: AgentConfig,
    rate: float,
    entropy: float,
    seed: int,
) -> Any:
    import stable_baselines3  # of the extra `agents`

    model = stable_baselines3.PPO(
        "MultiInputPolicy",
        _vectorised(_episodes(bank, policy, objects, arm, config.episodes), seed),
        learning_rate=rate,
        n_steps=config.rollout // config.episodes,
        batch_size=config.batch_size,
        ent_coef=entropy,
        gamma=1.0,
        policy_kwargs={"net_arch": [128, 128]},
        seed=seed,
        device="cpu",
    )
    return model.learn(config.steps)


def _played(bank: TouchBank, policy: ActivePolicy, model: Any, objects: Int[np.ndarray, "n"], arm: Arm) -> Played:
    """The likeliest actions of an agent in every episode."""
    which, asked = _every_question(objects)
    episodes, touches = _episodes(bank, policy, objects, arm), len(bank.choices)
    seen = episodes.begin(np.arange(len(which)))
    level, going = np.full(len(which), -1), np.ones(len(which), bool)
    for _ in range(arm.budget + 1):
        actions = np.where(
            going, model.predict(seen, deterministic=True)[0], touches
        )  # to conclude anew changes nothing
        seen, _, ended, totals = episodes.step(actions)
        level = np.where(going & ended, actions - touches, level)
        going &= ~ended
    right = level == np.asarray(bank.label)[which, asked]
    seconds, harm = (np.array([of[name] for of in totals]) for name in ("seconds", "harm"))
    choices = np.full((len(which), arm.budget), NO_CHOICE, np.int32)
    for row, of in zip(choices, totals, strict=True):
        row[: len(of["actions"])] = of["actions"]
    shaped = lambda x: x.reshape(len(objects), len(PROPERTIES), *x.shape[1:])
    return Played(*(shaped(x) for x in (right.astype(float), seconds, harm, choices)))


def agents_table(settings: dict[str, dict[str, float]], steps: int) -> Table:
    """Agents that were run, or why there are none."""
    if not settings:
        missing = missing_packages()
        why = f"not installed: {', '.join(missing)}; {INSTALL}, then --agents" if missing else "give --agents"
        rows: list[dict[str, Any]] = [{"agent": f"{AGENT} of Stable-Baselines3", "state": f"not run: {why}"}]
        return named_table("Agents of other libraries", rows)
    state = {"state": f"trained for {steps:,} steps"}
    return named_table(
        "Agents of other libraries",
        [{"agent": name} | state | chosen for name, chosen in settings.items()],
        formats={"learning rate": "g", "entropy bonus": "g", "earned": ".3f"},
        note="Settings with the highest reward on validation objects; the scores are in the table of plans.",
    )
