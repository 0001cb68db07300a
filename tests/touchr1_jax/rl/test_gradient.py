"""The objective and its gradient, away from the sampling policy so that every part is alive."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.rl import reference
from touchr1_jax.rl.config import GRPOConfig, Norm, Paper, Surrogate
from touchr1_jax.rl.enumerated import LevelRewards
from touchr1_jax.rl.gradient import Experience, grpo_gradient, prompt_terms
from touchr1_jax.rl.losses import token_log_probs
from touchr1_jax.types import Rollout

pytestmark = pytest.mark.long

P, G, T = 4, 2, 4
FNS = tiny.SHALLOW
PARAMS, REFERENCE = tiny.shallow_params(0), tiny.shallow_params(1)
ALGORITHM = Paper(beta=0.1, gamma=0.05)
CONFIG = GRPOConfig(prompts=P, group=G, length=T, micro_prompts=2, algorithm=ALGORITHM)
ROUNDING = 1e-6  # nat: the perturbed prompt is encoded from its first change on, by products of other shapes
ALONE = dataclasses.replace(CONFIG, algorithm=Paper(beta=0.0, gamma=0.0))  # the policy gradient alone

group_logits = jax.jit(jax.vmap(FNS.group_logits, in_axes=(None, 0, 0, 0, 0)))


@pytest.fixture(scope="module")
def experience() -> Experience:
    """Random completions, some ended early, with old log-probabilities off by up to ±.6."""
    rng = np.random.default_rng(0)
    batch = tiny.question_batch(1, P)
    tokens = tiny.completions(0, P, G, T)
    log_p = jax.nn.log_softmax(group_logits(PARAMS, batch.features, batch.ids, batch.mask, tokens))
    old = token_log_probs(log_p, tokens) + jnp.asarray(rng.uniform(-0.6, 0.6, tokens.shape), jnp.float32)
    length = rng.integers(1, T + 1, (P, G, 1))
    return Experience(
        batch=batch,
        masked_touch=tiny.features(7, P).touch,
        masked_stream=jnp.zeros(P, jnp.int32),
        rollout=Rollout(tokens=tokens, log_prob=old, mask=jnp.arange(T) < length),
        old=old,
        advantage=jnp.asarray(rng.normal(size=(P, G)), jnp.float32),
        weight=jnp.array([0.5, 0.0, 0.25, 0.25]),
    )


def gradient(config: GRPOConfig):
    """The jitted (experience, parameters) → gradient, parts and old log-probabilities of a later update."""
    return jax.jit(lambda e, params=PARAMS: grpo_gradient(FNS, config, params, REFERENCE, e, first=False))


compute = gradient(CONFIG)


@pytest.fixture(scope="module")
def whole(experience):
    """Gradient and parts under `CONFIG`."""
    return compute(experience, PARAMS)


def logits_of(experience: Experience) -> list[np.ndarray]:
    """Logits of policy, reference and perturbed policy."""
    b = experience.batch
    masked = b.features.replace(touch=experience.masked_touch)
    runs = (PARAMS, b.features), (REFERENCE, b.features), (PARAMS, masked)
    return [np.asarray(group_logits(p, f, b.ids, b.mask, experience.rollout.tokens)) for p, f in runs]


def test_loss_and_parts_equal_a_float64_reference(experience, whole):
    rollout = jax.tree.map(np.asarray, experience.rollout)
    terms = reference.terms(
        *logits_of(experience),
        rollout.tokens,
        rollout.log_prob,
        rollout.mask,
        np.asarray(experience.advantage),
        clip=0.2,
    )
    gain = np.asarray(experience.weight) @ terms["surrogate"]
    gain += (ALGORITHM.gamma * terms["grounding"] - ALGORITHM.beta * terms["kl"]).mean()
    parts = whole[1]
    np.testing.assert_allclose(parts["loss"], -gain, rtol=1e-5)
    for name, value in terms.items():
        np.testing.assert_allclose(parts[name], value.mean(), rtol=1e-4, err_msg=name)
    assert 0 < parts["clip_share"] < 1
    assert parts["kl"] > 0.1
    assert parts["grounding"] > 0.1


def test_gradient_is_that_of_the_loss(experience, whole):
    """A directional derivative of the float32 loss against the dot product with the gradient."""
    rng = np.random.default_rng(1)
    direction = jax.tree.map(lambda x: rng.normal(size=x.shape).astype(np.float32), PARAMS)
    forward = lambda params: compute(experience, params)[1]["loss"]
    h = 1e-3
    moved = lambda by: jax.tree.map(lambda x, d: np.asarray(x) + np.float32(by) * d, PARAMS, direction)
    ahead, behind = moved(h), moved(-h)
    slope = (float(forward(ahead)) - float(forward(behind))) / (2 * h)
    dot = sum(float(np.vdot(g, d)) for g, d in zip(*map(jax.tree.leaves, (whole[0], direction)), strict=True))
    assert slope == pytest.approx(dot, rel=2e-2)


@pytest.fixture(scope="module")
def one_stream(experience) -> Experience:
    """The same with stream 0 or 1 alone perturbed."""
    stream = jnp.arange(P) % tiny.S
    own, other = experience.batch.features.touch, experience.masked_touch
    chosen = (jnp.arange(tiny.S) == stream[:, None])[..., None, None]
    return experience._replace(masked_touch=jnp.where(chosen, other, own), masked_stream=stream)


def test_an_anchor_adds_the_likelihood_of_the_answers_and_its_gradient(experience, whole):
    """As if each answer were a completion alone; of the first prompt none is known."""
    b, tokens = experience.batch, tiny.completions(3, P, 1, T)
    mask = jnp.arange(T) < jnp.array([[0], [1], [3], [T]])
    answered = experience._replace(batch=b.replace(answer=tokens[:, 0], answer_mask=mask))

    def likelihood(params):
        log_p = jax.nn.log_softmax(group_logits(params, b.features, b.ids, b.mask, tokens))
        each = jnp.sum(token_log_probs(log_p, tokens)[:, 0] * mask, -1) / jnp.maximum(jnp.sum(mask, -1), 1)
        return jnp.mean(each)

    value, slope = jax.value_and_grad(likelihood)(PARAMS)
    anchored = dataclasses.replace(CONFIG, algorithm=dataclasses.replace(ALGORITHM, anchor=0.7))
    grads, parts, _ = gradient(anchored)(answered)
    np.testing.assert_allclose(parts["answer_likelihood"], value, rtol=1e-5)
    np.testing.assert_allclose(parts["loss"], whole[1]["loss"] - 0.7 * value, rtol=1e-5)
    scale = max(float(np.abs(g).max()) for g in jax.tree.leaves(grads))
    for a, plain, more in zip(*map(jax.tree.leaves, (grads, whole[0], slope)), strict=True):
        np.testing.assert_allclose(a, plain - 0.7 * more, atol=1e-5 * scale)
    with pytest.raises(ValueError, match="anchor is above 0, but the batch holds no verified answers"):
        gradient(anchored)(experience)


def test_levels_that_are_not_learned_follow_the_reference_without_kl_too(experience):
    """At β = 0 the gradient is that of the least β; the KL of no other token is in it, and none is logged."""
    ids, at = jnp.arange(3, 6), jnp.ones((P, G), jnp.int32)
    levels = LevelRewards(jnp.tile(ids, (P, 1)), at, jnp.zeros((P, G, 3)), jnp.zeros((P, G)))
    algorithm = Paper(gamma=0.0, enumerated=Norm.NONE, learn_conclusion=False)
    of = lambda beta: dataclasses.replace(CONFIG, algorithm=dataclasses.replace(algorithm, beta=beta))
    (found, parts, _), (least, _, _) = (gradient(of(beta))(experience._replace(levels=levels)) for beta in (0.0, 1e-12))
    assert max(float(np.abs(g).max()) for g in jax.tree.leaves(least)) > 1e-3
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), found, least)
    assert "kl" not in parts


def test_metrics_of_tokens_are_those_of_prompts_that_have_some(experience):
    """The rollouts of the first prompt were cut off and are masked, those of the second are dropped."""
    mask = experience.rollout.mask.at[0].set(False)
    off = experience.rollout.log_prob.at[1].add(9.0)
    some = experience._replace(rollout=experience.rollout.replace(mask=mask, log_prob=off))
    config = dataclasses.replace(CONFIG, algorithm=dataclasses.replace(ALGORITHM, mismatch_limit=4.0))
    _, whole, _ = gradient(config)(experience._replace(rollout=experience.rollout.replace(log_prob=off)))
    _, parts, _ = gradient(config)(some)
    alone = gradient(dataclasses.replace(config, prompts=1, micro_prompts=1))
    each = [alone(jax.tree.map(lambda x, p=p: x[p : p + 1], some))[1] for p in range(P)]
    assert (whole["kept_prompts"], whole["drawn_prompts"]) == (P - 1, P)
    assert (parts["kept_prompts"], parts["drawn_prompts"]) == (P - 2, P - 1)
    for name, first in (("kl", 2), ("grounding", 2), ("entropy", 2), ("clip_share", 2), ("sampler_gap", 1)):
        np.testing.assert_allclose(parts[name], np.mean([e[name] for e in each[first:]]), rtol=1e-5)


def test_stopped_branch_changes_the_gradient_but_no_value(one_stream):
    stopped = dataclasses.replace(CONFIG, algorithm=dataclasses.replace(ALGORITHM, grounding_stop_masked=True))
    (free, free_parts, _), (held, held_parts, _) = compute(one_stream, PARAMS), gradient(stopped)(one_stream)
    np.testing.assert_allclose(held_parts["loss"], free_parts["loss"], rtol=1e-5)
    assert any(np.abs(np.subtract(a, b)).max() > 1e-4 for a, b in zip(*map(jax.tree.leaves, (free, held)), strict=True))


def test_grounding_is_logged_for_every_stream(one_stream):
    """Prompts 0 and 2 perturb stream 0, prompts 1 and 3 stream 1."""
    parts = compute(one_stream, PARAMS)[1]
    assert [parts[f"perturbed_stream_{s}"] for s in range(tiny.S)] == [2, 2]
    by_stream = np.mean([parts[f"grounding_stream_{s}"] for s in range(tiny.S)])
    np.testing.assert_allclose(by_stream, parts["grounding"], rtol=1e-5)


@pytest.mark.parametrize("kind", Surrogate)
def test_no_ratio_is_clipped_at_the_first_update_whatever_the_sampler_computed(experience, kind):
    """The sampler's log-probabilities are off by up to ±.6, the clip range is a millionth, and bfloat16 rounds."""
    algorithm = Paper(surrogate=kind, clip_low=1e-6, clip_high=1e-6, beta=0.0, gamma=0.0)
    config = dataclasses.replace(CONFIG, algorithm=algorithm, bfloat16=True)
    both = jax.jit(lambda e, first: grpo_gradient(FNS, config, PARAMS, REFERENCE, e, first=first))
    _, parts, old = both(experience, True)
    assert parts["clip_share"] == 0
    gap = np.abs(old - experience.rollout.log_prob)[np.asarray(experience.rollout.mask)]
    assert parts["sampler_gap_peak"] == pytest.approx(gap.max(), abs=1e-6)
    _, later, kept = both(experience, False)
    np.testing.assert_array_equal(kept, experience.old)
    assert later["clip_share"] > 0


def test_under_a_cap_the_sampler_counts_in_the_weight_alone(experience):
    cap = 1.2
    config = dataclasses.replace(ALONE, algorithm=dataclasses.replace(ALONE.algorithm, importance_cap=cap))
    b, r = experience.batch, experience.rollout
    log_p = jax.nn.log_softmax(group_logits(PARAMS, b.features, b.ids, b.mask, r.tokens))
    learner = token_log_probs(log_p, r.tokens)
    _, parts, old = jax.jit(lambda e: grpo_gradient(FNS, config, PARAMS, REFERENCE, e))(experience)
    np.testing.assert_allclose(old, learner, rtol=1e-5, atol=1e-5)
    weight = np.minimum(np.exp(learner - r.log_prob), cap)
    gain = np.where(r.mask, weight * experience.advantage[..., None], 0).sum(-1) / r.mask.sum(-1)
    np.testing.assert_allclose(parts["surrogate"], gain.mean(), rtol=1e-4)


@pytest.mark.parametrize(
    ("change", "tolerance"),
    [
        ({"micro_prompts": 1}, 1e-5),
        ({"max_logits": 3 * tiny.V}, 1e-5),
        ({"remat": True}, 1e-5),
        ({"bfloat16": True}, 0.1),
    ],
)
def test_cheaper_passes_give_the_gradient_of_the_exact_ones(one_stream, change, tolerance):
    """Prompts one by one, each encoded again from its perturbed stream on; a few logits at a time; in bfloat16."""
    whole = compute(one_stream, PARAMS)
    grads, parts, _ = gradient(dataclasses.replace(CONFIG, **change))(one_stream)
    a, b = (np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)]) for tree in (grads, whole[0]))
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(grads))
    if "bfloat16" in change:
        assert np.linalg.norm(a - b) <= tolerance * np.linalg.norm(b)
        assert float(parts["loss"]) == pytest.approx(float(whole[1]["loss"]), abs=0.05)
        return
    np.testing.assert_allclose(a, b, atol=tolerance * np.abs(b).max())
    rtol = 1e-5 if "max_logits" in change else 1e-4
    for name, value in whole[1].items():
        np.testing.assert_allclose(parts[name], value, rtol=rtol, atol=1e-6, err_msg=name)


@pytest.fixture(scope="module")
def alone():
    """Gradient of the policy-gradient term."""
    return gradient(ALONE)


def test_zero_advantage_has_a_gradient_of_exactly_zero(experience, alone):
    grads, parts, _ = alone(experience._replace(advantage=jnp.zeros((P, G))))
    assert not any(np.any(g) for g in jax.tree.leaves(grads))
    assert parts["loss"] == 0
    assert not {"grounding", "grounding_peak"} & parts.keys()  # not computed at γ = 0


def test_prompts_of_weight_zero_do_not_count(experience, alone):
    """Whatever the rollouts of prompt 1, whose weight is 0, earned."""
    other = experience._replace(advantage=experience.advantage.at[1].set(100.0))
    for a, b in zip(*(jax.tree.leaves(alone(e)[0]) for e in (experience, other)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_stands_after_the_end_does_not_count(experience, alone):
    """Other tokens and log-probabilities where the mask is false; padding has a log-probability of −1e9 there."""
    r = experience.rollout
    filler = r.replace(tokens=jnp.where(r.mask, r.tokens, FNS.pad_id), log_prob=jnp.where(r.mask, r.log_prob, 0.0))
    assert not r.mask.all()
    both = (alone(experience._replace(rollout=x, old=x.log_prob))[:2] for x in (r, filler))
    for a, b in zip(*map(jax.tree.leaves, both), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)


terms_of = jax.jit(lambda e: prompt_terms(FNS, CONFIG, PARAMS, REFERENCE, e))


def grounding_of(one: Experience, touch: jax.Array) -> float:
    """Mean grounding of a prompt's existing tokens when this touch takes the place of its own."""
    return float(jnp.mean(terms_of(one._replace(masked_touch=touch)).grounding, where=one.rollout.mask))


def test_grounding_is_zero_when_nothing_is_perturbed_and_sees_every_stream(experience):
    """Each stream in turn: no modality is silently left out of the perturbed branch."""
    one = jax.tree.map(lambda x: x[0], experience)
    touch = one.batch.features.touch
    assert abs(grounding_of(one, touch)) <= ROUNDING
    for stream in range(tiny.S):
        assert grounding_of(one, touch.at[stream].set(one.masked_touch[stream])) > 1e-2


def test_grounding_ignores_a_stream_that_is_not_there(experience):
    one = jax.tree.map(lambda x: x[0], experience)
    features = one.batch.features
    absent = one._replace(batch=one.batch.replace(features=features.replace(stream_mask=jnp.array([True, False]))))
    assert abs(grounding_of(absent, features.touch.at[1].set(one.masked_touch[1]))) <= ROUNDING
