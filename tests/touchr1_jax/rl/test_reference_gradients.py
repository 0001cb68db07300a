"""Loss and gradient of every algorithm and option against central differences of a float64 loss written in NumPy.

Each preset and each option stands alone, and every two values of two `FACTORS` stand together in some row of `ROWS`.
"""

import dataclasses
import functools
import itertools
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.rl import reference
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl.config import AnyAlgorithm, Average, GRPOConfig, Norm, Paper, Surrogate
from touchr1_jax.rl.enumerated import LevelRewards
from touchr1_jax.rl.gradient import level_log_probs, logit_terms
from touchr1_jax.rl.losses import check_centering, grpo_loss

P, G, T, V = 2, 3, 3, 5
NEAR = 1e-5
STEP = 1e-5
DIRECTIONS = 8
"""Random directions along which gradients are compared; an error of any parameter is in all of them."""

LOUD = {"beta": 0.3, "gamma": 0.2, "entropy_weight": 0.1}
PRESETS = {preset.__name__: preset() for preset in get_args(AnyAlgorithm)}
ALGORITHMS = {
    **PRESETS,
    **{f"KL {kl}": Paper(**LOUD, kl=kl) for kl in ("k1", "k2", "k3", "exact")},
    **{f"average {x.value}": Paper(**LOUD, average=x) for x in Average},
    **{f"surrogate {x.value}": Paper(**LOUD, surrogate=x, clip_low=0.1, clip_high=0.15) for x in Surrogate},
    "entropy up to a floor": Paper(**LOUD, entropy_floor_nat=1.25),
    "grounding of bounded size": Paper(**LOUD, grounding_cap_nat=0.8, grounding_budget=0.12),
    "grounding without the perturbed branch": Paper(**LOUD, grounding_stop_masked=True),
    "importance of tokens": Paper(**LOUD, importance_cap=1.1),
    "importance of rollouts": Paper(**LOUD, importance_cap=1.1, importance_sequence=True),
    "rollouts dropped": Paper(**LOUD, mismatch_limit=0.15, importance_cap=1.1),
    "scores centered": Paper(**LOUD, score_centering=2),
    "scores centered under weights": Paper(**LOUD, score_centering=2, importance_cap=1.1),
    "KL in the reward": Paper(**LOUD, kl_in_reward=True),
    "anchor": Paper(**LOUD, anchor=0.7),
}
SAMPLING = {
    "temperature": {"temperature": 0.7},
    "top-p": {"top_p": 0.8},
    "min-p": {"min_p": 0.3},
    "all of them": {"temperature": 1.5, "top_p": 0.9, "min_p": 0.2},
}
BY_TOKEN = "token_advantage"
FACTORS: dict[str, tuple[dict[str, Any], ...]] = {
    "surrogate": tuple({"surrogate": x, "clip_low": 0.1, "clip_high": 0.15} for x in Surrogate),
    "average": tuple({"average": x} for x in Average),
    "weights": (
        {},
        {"importance_cap": 1.1},
        {"importance_cap": 1.1, "importance_sequence": True},
        {"mismatch_limit": 0.15},
        {"mismatch_limit": 0.15, "importance_cap": 1.1, "importance_sequence": True},
        {"score_centering": 2},
        {"score_centering": 2, "importance_cap": 1.1},
    ),
    "credit": (
        {},
        {BY_TOKEN: True},
        *({"enumerated": x} for x in Norm),
        {"enumerated": Norm.STD, "learn_conclusion": False},
    ),
    "kl": (*({"kl": x} for x in ("k1", "k2", "k3", "exact")), {"kl_in_reward": True}),
    "grounding": ({}, {"grounding_stop_masked": True}, {"grounding_cap_nat": 0.8, "grounding_budget": 0.12}),
    "further": ({}, {"entropy_floor_nat": 1.25}, {"anchor": 0.7}),
    "sampling": ({}, *SAMPLING.values()),
    "first": ({"first": True}, {"first": False}),
}
Row = tuple[int, ...]
"""Number of a value of each factor, −1 where none is chosen yet."""


def options(row: Row) -> dict[str, Any]:
    """Options of a row."""
    chosen = (values[i] for values, i in zip(FACTORS.values(), row, strict=True) if i >= 0)
    return {name: value for part in chosen for name, value in part.items()}


def config_of(row: Row) -> GRPOConfig:
    """Configuration of a row."""
    of = options(row)
    sampling = {name: of.pop(name) for name in ("temperature", "top_p", "min_p") if name in of}
    algorithm = Paper(**LOUD, **{name: x for name, x in of.items() if name not in ("first", BY_TOKEN)})
    return GRPOConfig(prompts=2 * P, micro_prompts=P, group=G, length=T + 2, algorithm=algorithm, **sampling)


def possible(row: Row) -> bool:
    """False for options that are refused together."""
    try:
        config = config_of(row)
        if config.algorithm.score_centering:
            check_centering(config.algorithm)
    except ValueError:
        return False
    plain = (config.temperature, config.top_p, config.min_p) == (1, 1, 0)
    return plain or not config.algorithm.score_centering  # it needs a server, which draws as it is


def pairwise() -> list[Row]:
    """Rows in which every two values of two factors that are possible together are together somewhere; greedy."""
    places, sizes = range(len(FACTORS)), [len(values) for values in FACTORS.values()]
    with_ = lambda row, at, value: (*row[:at], value, *row[at + 1 :])
    nothing = (-1,) * len(FACTORS)
    missing = {
        (a, i, b, j)
        for a, b in itertools.combinations(places, 2)
        for i, j in itertools.product(range(sizes[a]), range(sizes[b]))
        if possible(with_(with_(nothing, a, i), b, j))
    }
    rows = []
    while missing:
        a, i, b, j = min(missing)
        row = with_(with_(nothing, a, i), b, j)
        for at in sorted(places, key=lambda p: -sizes[p]):
            if row[at] < 0:
                choices = [r for value in range(sizes[at]) if possible(r := with_(row, at, value))]
                row = max(choices, key=lambda r: sum(r[a] == i and r[b] == j for a, i, b, j in missing))
        rows.append(row)
        missing = {pair for pair in missing if (row[pair[0]], row[pair[2]]) != (pair[1], pair[3])}
    return rows


ROWS = pairwise()


def problem(config: GRPOConfig, seed: int = 0) -> dict[str, np.ndarray]:
    """Logits of three policies, and rollouts of a fourth whose log-probabilities are up to ±.3 off."""
    rng = np.random.default_rng(seed)
    own = rng.normal(0, 1, (P, G, T, V))
    tokens = rng.integers(0, V, (P, G, T))
    log_p = reference.log_softmax(own / config.temperature)
    here = reference.drawn(config, log_p, log_p, tokens)
    found = {
        "own": own,
        "reference": own + rng.normal(0, 0.5, own.shape),
        "perturbed": own + rng.normal(0, 0.8, own.shape),
        "tokens": tokens,
        "old": here + rng.uniform(-0.3, 0.3, here.shape),
        "sampler": here + rng.uniform(-0.3, 0.3, here.shape),
        "mask": np.arange(T) < rng.integers(1, T + 1, (P, G, 1)),
        "advantage": rng.normal(size=(P, G)),
        "weight": np.array([0.7, 0.3]),
        "answer": rng.integers(0, V, (P, T)),
        **head_of(own + rng.normal(0, 0.5, own.shape)),
    }
    length = found["mask"].sum(-1)  # of more than one token, the second or a later one is a level
    at = np.where(length > 1, 1 + rng.integers(0, np.maximum(length - 1, 1)), T)
    earns = {"earns": rng.uniform(0, 1, (P, G, 3)), "sampled": rng.uniform(0, 1, (P, G))}
    return found | earns | {"at": at, "ids": np.array([[0, 3, -1], [1, 2, 4]]), BY_TOKEN: rng.normal(size=(P, G, T))}


def levels_of(fixed: dict[str, np.ndarray]) -> LevelRewards:
    """Rewards of every conclusion."""
    reward = np.where(fixed["ids"][:, None] >= 0, fixed["earns"], 0)
    floats = (jnp.asarray(x, jnp.float32) for x in (reward, fixed["sampled"]))
    return LevelRewards(*(jnp.asarray(fixed[name], jnp.int32) for name in ("ids", "at")), *floats)


def head_of(logits: np.ndarray) -> dict[str, np.ndarray]:
    """The two most likely tokens of a sampler and their log-probabilities, [P, G, T, 2]."""
    log_q = reference.log_softmax(logits)
    head = np.argsort(-log_q, -1)[..., :2]
    return {"head": head, "head_q": np.take_along_axis(log_q, head, -1)}


class AsLogits(PolicyFns):
    """Functions of a policy whose hidden states are logits."""

    def logits(self, params, states):
        return states


def ours(config: GRPOConfig, fixed: dict[str, np.ndarray], *, first: bool):
    """Value and gradient [2, P, G, T, V] of the loss in float32, by the functions that the step uses."""
    x = {name: jnp.asarray(value, jnp.float32) for name, value in fixed.items() if value.dtype == float}
    tokens, mask = jnp.asarray(fixed["tokens"], jnp.int32), jnp.asarray(fixed["mask"])

    def loss(own, perturbed):
        logits = {"own": own, "reference": x["reference"], "perturbed": perturbed}
        terms = logit_terms(config, tokens, logits, jnp.asarray(fixed["head"], jnp.int32))
        old = jax.lax.stop_gradient(terms.log_prob) if first else x["old"]
        answer = jnp.asarray(fixed["answer"])[..., None]  # scored by the states of each prompt's first rollout
        likelihood = jnp.take_along_axis(jax.nn.log_softmax(own[:, 0]), answer, -1)[..., 0].mean(-1)
        anchor = likelihood if config.algorithm.anchor else None
        arrays = (terms, old, x["sampler"], mask, x["advantage"], x["weight"])
        levels = levels_of(fixed) if config.algorithm.enumerated else None
        if levels is not None:
            of_levels = jax.vmap(functools.partial(level_log_probs, object.__new__(AsLogits), config, {}))
            arrays = (terms._replace(level_log_prob=of_levels(own, levels)), *arrays[1:])
        return grpo_loss(*arrays, config, answer=anchor, head=x["head_q"], levels=levels)[0]

    value, gradient = jax.jit(jax.value_and_grad(loss, (0, 1)))(x["own"], x["perturbed"])
    return float(value), np.stack(gradient)


def differences(config: GRPOConfig, fixed: dict[str, np.ndarray], directions: np.ndarray, *, first: bool):
    """Value of the float64 loss, and its central differences along directions [n, 2, P, G, T, V]."""
    logits = np.stack([fixed["own"], fixed["perturbed"]])
    of = lambda x: reference.objective(config, *x, fixed, first=first)
    slopes = [(of(logits + STEP * d) - of(logits - STEP * d)) / (2 * STEP) for d in directions]
    return of(logits), np.array(slopes)


def distance(config: GRPOConfig, *, first: bool, by_token: bool = False, wrong: GRPOConfig | None = None) -> float:
    """Distance of the slopes of two gradients, relative to the second's; the values must agree too.

    `wrong` is the configuration of the first one where that is to be another.
    """
    fixed = problem(config)
    fixed["advantage"] = fixed[BY_TOKEN] if by_token else fixed["advantage"]
    directions = np.random.default_rng(1).normal(size=(DIRECTIONS, 2, *fixed["own"].shape))
    value, gradient = ours(wrong or config, fixed, first=first)
    expected, exact = differences(config, fixed, directions, first=first)
    assert wrong or value == pytest.approx(expected, rel=NEAR, abs=1e-6)
    assert np.abs(exact).max() > 1e-3
    slopes = np.tensordot(directions, gradient.astype(float), gradient.ndim)
    return float(np.linalg.norm(slopes - exact) / np.linalg.norm(exact))


def long_unless(quick: bool, name: str, value: Any):
    """A case of a test that `make test` passes over unless it is `quick`."""
    return pytest.param(value, id=name, marks=() if quick else pytest.mark.long)


FIRST = [pytest.param(True, marks=pytest.mark.long, id="first update"), pytest.param(False, id="later update")]


@pytest.mark.parametrize("first", FIRST)
@pytest.mark.parametrize("algorithm", [long_unless(name in PRESETS, name, x) for name, x in ALGORITHMS.items()])
def test_gradient_of_every_algorithm_and_option(algorithm, first):
    config = GRPOConfig(prompts=2 * P, micro_prompts=P, group=G, length=T + 2, algorithm=algorithm)
    assert distance(config, first=first) <= NEAR


@pytest.mark.parametrize("sampling", [long_unless(len(x) > 1, name, x) for name, x in SAMPLING.items()])
def test_gradient_under_every_way_to_sample(sampling):
    config = GRPOConfig(prompts=P, micro_prompts=P, group=G, length=T, algorithm=Paper(**LOUD), **sampling)
    assert distance(config, first=False) <= NEAR


@pytest.mark.long
@pytest.mark.parametrize("row", ROWS, ids=str)
def test_gradient_of_options_together(row):
    of = options(row)
    assert distance(config_of(row), first=of["first"], by_token=BY_TOKEN in of) <= NEAR


def test_a_gradient_that_is_wrong_by_a_ten_thousandth_is_seen():
    config = GRPOConfig(prompts=P, micro_prompts=P, group=G, length=T, algorithm=Paper(**LOUD))
    off = dataclasses.replace(config, algorithm=dataclasses.replace(config.algorithm, gamma=0.2002))
    assert distance(config, first=False, wrong=off) > NEAR
