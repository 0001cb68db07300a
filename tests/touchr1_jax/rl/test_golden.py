"""The default step of the ordinal study, held to the figures of the commit in which the study was first published.

`golden.json` was written once, by the engine of that commit; whatever the engine learns since, the published objective
under its default settings must go on computing the same to float32 rounding.
"""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.rewards import make_rewards, total_reward
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.grpo import FrozenInputs, GRPOState, make_grpo_step
from touchr1_jax.training.optimizer import falling_adamw
from touchr1_jax.types import Parsed, Target

GOLDEN = Path(__file__).with_name("golden.json")
STEPS, P, T = 3, 4, 6
REWARDS = make_rewards(np.array([[1 / 3] * 3 + [0] * 6] * 3 + [[1 / 9] * 9]))
WEIGHTS = {"accuracy": 0.6, "consistency": 0.3, "format": 0.1}
CONFIG = GRPOConfig(prompts=P, group=4, length=T, micro_prompts=2)


def score(tokens: jax.Array, target: Target) -> tuple[jax.Array, dict[str, jax.Array], Parsed]:
    """The published reward of an answer that says its first tokens modulo the number of levels."""
    said = tokens[:4, None] % target.levels
    parsed = Parsed(
        perceive=said[: tiny.S],
        compare=said[2],
        conclude=said[3],
        formatted=tokens[0] > 20,
        truncated=jnp.all(tokens != 1),
        length=jnp.sum(tokens > 1),
    )
    reward, terms = total_reward(REWARDS, WEIGHTS, parsed, target)
    return reward, terms, parsed


def trajectory() -> dict[str, list[float]]:
    """Metrics of each step, and the norm and one projection of the parameters after it."""
    optimizer = falling_adamw(CONFIG.learning_rate * CONFIG.lr_scale, CONFIG.final_share, 10, CONFIG.max_grad_norm)
    step = make_grpo_step(tiny.SHALLOW, score, optimizer, CONFIG)
    params = tiny.copy(tiny.shallow_params(0, loud=0.2))
    shape = (3, tiny.S, tiny.N, tiny.CONFIG.decoder.hidden_size)
    noise = jnp.asarray(np.random.default_rng(5).normal(size=shape), jnp.float32)
    frozen = FrozenInputs(reference=tiny.shallow_params(1, loud=0.2), noise=noise)
    start = jax.tree.leaves(tiny.shallow_params(0, loud=0.2))
    state = GRPOState(params=params, opt_state=optimizer.init(params), step=jnp.int32(0), key=jax.random.key(3))
    lines: dict[str, list[float]] = {}
    for seed in range(STEPS):
        state, metrics = step(state, tiny.question_batch(seed, P), frozen)
        leaves = jax.tree.leaves(state.params)
        metrics["moved"] = sum(jnp.sum(jnp.abs(a - b)) for a, b in zip(leaves, start, strict=True))
        for name, value in metrics.items():
            lines.setdefault(name, []).append(float(value))
    return lines


@pytest.fixture(scope="module")
def lines() -> dict[str, list[float]]:
    return trajectory()


@pytest.mark.long
@pytest.mark.parametrize("name", json.loads(GOLDEN.read_text()) if GOLDEN.exists() else [])
def test_default_step_computes_what_it_always_did(lines, name):
    np.testing.assert_allclose(lines[name], json.loads(GOLDEN.read_text())[name], rtol=2e-4, atol=2e-6)
