"""An agent of another library in the same environment: PPO of Stable-Baselines3.

    pip install 'touchr1-jax[agents]'
    python -m experiments active_touch --agents

It learns from all objects that the policies learn from, by `rl.gymnasium_env`, pays the same prices, and its settings
are chosen by its reward on validation objects.
"""

import dataclasses
import importlib.util
import itertools
from typing import Any

import numpy as np
from jaxtyping import Int

from experiments.active.arms import Arm, as_json
from experiments.active.contacts import PROPERTIES
from experiments.active.plans import NO_CHOICE, Played
from experiments.active.world import TouchWorld
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError
from experiments.core.results import Table, named_table
from touchr1_jax.models.active_policy import ActivePolicy
from touchr1_jax.rl.environment import TouchBank
from touchr1_jax.rl.gymnasium_env import make_gymnasium_env
from touchr1_jax.training.exploration import touch_batch_of

AGENT = "ppo"
PACKAGES = ("gymnasium", "stable_baselines3")
INSTALL = "pip install 'touchr1-jax[agents]'"


@dataclasses.dataclass(frozen=True, kw_only=True)
class AgentConfig:
    """Training of PPO; every learning rate is tried with every weight of the entropy bonus.

    Args:
      steps: actions and answers of a training.
      rollout: of them between updates.
      batch_size: of an update.
      rates, entropies: that are tried.
    """

    steps: int = 200_000
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


def _environment(bank: TouchBank, policy: ActivePolicy, objects: Int[np.ndarray, "n"], arm: Arm) -> Any:
    """Episodes of every question about some objects, object by object."""
    which, asked = _every_question(objects)
    return make_gymnasium_env(bank, touch_batch_of(policy, bank, which, asked), budget=arm.budget, prices=arm.prices)


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
        _environment(bank, policy, objects, arm),
        learning_rate=rate,
        n_steps=config.rollout,
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
    env, levels = _environment(bank, policy, objects, arm), np.asarray(bank.label)
    which, asked = _every_question(objects)
    choices = np.full((len(which), arm.budget), NO_CHOICE, np.int32)
    right, seconds, harm = (np.zeros(len(which)) for _ in range(3))
    for i, (of_object, question) in enumerate(zip(which, asked, strict=True)):
        seen, _ = env.reset(options={"prompt": i})
        ended, totals, action = False, {}, 0
        while not ended:
            action = int(model.predict(seen, deterministic=True)[0])
            seen, _, ended, _, totals = env.step(action)
        taken = totals["actions"]
        choices[i, : len(taken)] = taken
        right[i] = action - len(bank.choices) == levels[of_object, question]
        seconds[i], harm[i] = totals["seconds"], totals["harm"]
    shaped = lambda x: x.reshape(len(objects), len(PROPERTIES), *x.shape[1:])
    return Played(*(shaped(x) for x in (right, seconds, harm, choices)))


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
        note="Settings that earned most about validation objects; the scores stand among the plans.",
    )
