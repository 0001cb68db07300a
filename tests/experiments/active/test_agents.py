"""An agent of another library is trained and scored in the same environment, and is named where it is not run."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.active import agents
from experiments.active.agents import AgentConfig, agent_played, agents_table
from experiments.active.arms import Arm, from_json
from experiments.active.contacts import PROPERTIES
from tests.touchr1_jax.explored import CHOICES, DECODER
from touchr1_jax.models.active_policy import build_active_policy
from touchr1_jax.rl.environment import TouchBank

OBJECTS = 12


def world():
    """The slide shows the level of every property in its token, the press shows nothing; both take a second."""
    label = np.random.default_rng(0).integers(0, 3, (OBJECTS, len(PROPERTIES))).astype(np.int32)
    tokens = np.zeros((OBJECTS, 2, len(PROPERTIES), 3), np.float32)
    tokens[:, 1] = np.eye(3)[label]
    bank = TouchBank(
        tokens=jnp.asarray(tokens),
        available=jnp.ones((OBJECTS, 2), bool),
        seconds=jnp.ones((OBJECTS, 2)),
        harm=jnp.zeros((OBJECTS, 2)),
        label=jnp.asarray(label),
        choices=CHOICES,
    )
    parts = dict(zip(("warm", "reinforced", "val", "test"), np.split(np.arange(OBJECTS), 4), strict=True))
    return SimpleNamespace(bank=bank, parts=parts)


def test_an_agent_that_is_not_run_is_named_with_what_it_takes(monkeypatch):
    monkeypatch.setattr(agents, "missing_packages", lambda: ["stable_baselines3"])
    (row,) = agents_table({}, 10).rows
    assert "not run: not installed: stable_baselines3" in row[1]
    assert "touchr1-jax[agents]" in row[1]
    monkeypatch.setattr(agents, "missing_packages", list)
    assert agents_table({}, 10).rows[0][1] == "not run: give --agents"


@pytest.mark.slow  # trains an agent of PyTorch
def test_an_agent_is_chosen_on_validation_objects_and_scored_on_test_objects(tmp_path):
    pytest.importorskip("stable_baselines3")
    one = world()
    policy = build_active_policy(one.bank.actions, DECODER)
    said: list[str] = []
    context = SimpleNamespace(each=lambda _, items: items, print=said.append)
    config = AgentConfig(steps=256, rollout=128, batch_size=64, rates=(1e-3,), entropies=(0.0, 0.01))
    saved = agent_played(one, policy, Arm(budget=1, second=0.01), config, "ppo", 0, context)
    played = from_json(saved["played"])["ppo"]
    assert played.right.shape == (3, len(PROPERTIES))
    assert set(np.unique(played.right)) <= {0.0, 1.0}
    np.testing.assert_array_equal(played.seconds, played.contacts)
    assert len(said) == 2
    assert saved["settings"]["entropy bonus"] in config.entropies
    assert len(agents_table({"ppo": saved["settings"]}, 256).rows) == 1
