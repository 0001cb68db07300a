"""Loss and gradient of every algorithm and option against central differences of a float64 loss written in NumPy."""

import dataclasses
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax.rl import reference
from touchr1_jax.rl.config import AnyAlgorithm, Average, GRPOConfig, Paper, Surrogate
from touchr1_jax.rl.gradient import logit_terms
from touchr1_jax.rl.losses import grpo_loss

P, G, T, V = 2, 3, 3, 5
NEAR = 1e-5
STEP = 1e-5

LOUD = {"beta": 0.3, "gamma": 0.2, "entropy_weight": 0.1}
ALGORITHMS = {
    **{preset.__name__: preset() for preset in get_args(AnyAlgorithm)},
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


def problem(seed: int = 0) -> dict[str, np.ndarray]:
    """Logits of three policies, and rollouts of a fourth whose log-probabilities are up to ±.3 off."""
    rng = np.random.default_rng(seed)
    own = rng.normal(0, 1, (P, G, T, V))
    tokens = rng.integers(0, V, (P, G, T))
    here = reference.of_tokens(reference.log_softmax(own), tokens)
    return {
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


def head_of(logits: np.ndarray) -> dict[str, np.ndarray]:
    """The two most likely tokens of a sampler and their log-probabilities, [P, G, T, 2]."""
    log_q = reference.log_softmax(logits)
    head = np.argsort(-log_q, -1)[..., :2]
    return {"head": head, "head_q": np.take_along_axis(log_q, head, -1)}


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
        return grpo_loss(*arrays, config, answer=anchor, head=x["head_q"])[0]

    value, gradient = jax.jit(jax.value_and_grad(loss, (0, 1)))(x["own"], x["perturbed"])
    return float(value), np.stack(gradient)


def differences(config: GRPOConfig, fixed: dict[str, np.ndarray], *, first: bool):
    """Value and central differences of the float64 loss."""
    logits = np.stack([fixed["own"], fixed["perturbed"]])
    of = lambda x: reference.objective(config, *x, fixed, first=first)
    gradient = np.zeros_like(logits)
    for at in np.ndindex(logits.shape):
        ahead, behind = logits.copy(), logits.copy()
        ahead[at], behind[at] = logits[at] + STEP, logits[at] - STEP
        gradient[at] = (of(ahead) - of(behind)) / (2 * STEP)
    return of(logits), gradient


def distance(config: GRPOConfig, *, first: bool) -> float:
    """Distance of the two gradients, relative to the second; the values must agree too."""
    fixed = problem()
    (value, gradient), (expected, exact) = (f(config, fixed, first=first) for f in (ours, differences))
    assert value == pytest.approx(expected, rel=NEAR, abs=1e-6)
    assert np.abs(exact).max() > 1e-3
    return float(np.linalg.norm(gradient - exact) / np.linalg.norm(exact))


@pytest.mark.parametrize("first", [True, False], ids=["first update", "later update"])
@pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)
def test_gradient_of_every_algorithm_and_option(algorithm, first):
    config = GRPOConfig(prompts=2 * P, micro_prompts=P, group=G, length=T + 2, algorithm=algorithm)
    assert distance(config, first=first) <= NEAR


@pytest.mark.parametrize("sampling", SAMPLING.values(), ids=SAMPLING)
def test_gradient_under_every_way_to_sample(sampling):
    config = GRPOConfig(prompts=P, micro_prompts=P, group=G, length=T, algorithm=Paper(**LOUD), **sampling)
    assert distance(config, first=False) <= NEAR


def test_a_gradient_that_is_wrong_by_a_ten_thousandth_is_seen():
    config = GRPOConfig(prompts=P, micro_prompts=P, group=G, length=T, algorithm=Paper(**LOUD))
    fixed = problem()
    off = dataclasses.replace(config, algorithm=dataclasses.replace(config.algorithm, gamma=0.2002))
    wrong, exact = ours(off, fixed, first=False)[1], differences(config, fixed, first=False)[1]
    assert np.linalg.norm(wrong - exact) > NEAR * np.linalg.norm(exact)
