"""Settings from which a policy that chooses cannot learn are named before anything is trained."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.active import active_touch
from experiments.active.active_touch import ActiveTouchConfig
from experiments.active.arms import Arm, LearnerConfig, check_arms
from experiments.active.videos import StoppingConfig
from experiments.core.errors import ConfigurationError
from tests.touchr1_jax.explored import BANK, POLICY
from touchr1_jax.rewards import RewardError
from touchr1_jax.rl.environment import EnvironmentCheckError

WHOLE = jax.tree.map(jnp.asarray, dataclasses.replace(BANK, available=np.ones((4, 2), bool)))


def world(**changes):
    return SimpleNamespace(bank=dataclasses.replace(WHOLE, **changes), parts={"reinforced": np.arange(4)})


@pytest.mark.long
def test_arms_that_can_learn_pass():
    check_arms(world(), POLICY, {"chosen": Arm(budget=1), "chosen_2": Arm(budget=2, second=0.01, harm=0.1)})


def available(*rows):
    return jnp.asarray(np.array(rows, bool))


CASES = {
    "touching never pays": ({}, Arm(budget=1, second=9.0), RewardError),
    "second is nan": ({}, Arm(budget=1, second=float("nan")), RewardError),
    "budget is 0": ({}, Arm(budget=0), EnvironmentCheckError),
    "available for no object": ({"available": available(*[(1, 0)] * 4)}, Arm(budget=1), EnvironmentCheckError),
    "fewer than 2 contacts": (
        {"available": available((1, 1), (1, 1), (1, 0), (1, 1))},
        Arm(budget=1),
        EnvironmentCheckError,
    ),
    "seconds of": ({"seconds": jnp.full((4, 2), jnp.nan)}, Arm(budget=1), EnvironmentCheckError),
}


@pytest.mark.long
@pytest.mark.parametrize("names", CASES)
def test_arms_that_cannot_learn_are_named(names):
    changes, arm, error = CASES[names]
    with pytest.raises(error, match=names):
        check_arms(world(**changes), POLICY, {"chosen": arm})


def test_agents_that_are_not_installed_are_refused_before_contacts_are_made(monkeypatch):
    monkeypatch.setattr("experiments.active.agents.missing_packages", lambda: ["stable_baselines3"])
    with pytest.raises(
        ConfigurationError, match=r"stable_baselines3 not installed; run pip install 'touchr1-jax\[agents\]'"
    ):
        active_touch.run(ActiveTouchConfig(agents=True), None)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"questions": 4}, "warm.questions is 4: must be 1"),
        ({"pack": 64}, "warm.pack is 64: must be 0"),
        ({"curriculum": 0.5}, r"warm.curriculum is 0\.5: must be 0"),
        ({"conclusion_weight": 5.0}, r"warm.conclusion_weight is 5\.0: must be 1"),
    ],
)
@pytest.mark.parametrize("config", [LearnerConfig, StoppingConfig])
def test_options_that_a_warm_start_does_not_read_are_refused(config, change, said):
    with pytest.raises(ValueError, match=said):
        config(warm=dataclasses.replace(config().warm, **change))
