"""An update that is too long is shortened to its bound; a short one stays as it is."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.rl.test_grpo import FNS, P
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.rl.gradient import Experience, log_probs
from touchr1_jax.rl.rollout import SampleConfig, sample_group
from touchr1_jax.rl.trust_region import within_trust
from touchr1_jax.rl.update import update_policy
from touchr1_jax.skipping import count_skipped, skip_nonfinite

pytestmark = pytest.mark.long

G, T, DELTA = 8, 4, 0.01
CONFIG = GRPOConfig(prompts=P, group=G, length=T, micro_prompts=P, algorithm=Paper())
BEFORE = tiny.shallow_params(0)
DIRECTION = jax.tree.map(lambda a, b: b - a, BEFORE, tiny.shallow_params(1))


@pytest.fixture(scope="module")
def learn() -> Experience:
    """Rollouts of the policy before the update."""
    batch = tiny.question_batch(1, P)
    draw = SampleConfig(group=G, length=T, end_ids=FNS.end_ids, pad_id=FNS.pad_id)
    rollout = jax.jit(lambda: sample_group(FNS, BEFORE, batch, jax.random.key(0), draw))()
    touch = batch.features.touch
    zero = jnp.zeros((P, G))
    stream = jnp.zeros(P, jnp.int32)
    return Experience(batch, touch, stream, rollout, rollout.log_prob, zero, jnp.ones(P))


@pytest.fixture(scope="module")
def shorten(learn):
    """The parameters and sizes of an update of a given length along one direction, from one program."""
    along = lambda size: jax.tree.map(lambda a, d: a + size * d, BEFORE, DIRECTION)
    return jax.jit(lambda size: within_trust(FNS, CONFIG, BEFORE, along(size), learn, DELTA))


def test_the_policy_that_sampled_has_the_sampled_log_probabilities(learn):
    ours = jax.jit(lambda: log_probs(FNS, CONFIG, BEFORE, learn.batch, learn.rollout))()
    mask = np.asarray(learn.rollout.mask)
    np.testing.assert_allclose(np.asarray(ours)[mask], np.asarray(learn.rollout.log_prob)[mask], atol=1e-4)


def test_a_short_update_stays(shorten):
    params, size = shorten(1e-3)
    assert size["update_scale"] == 1
    assert 0 <= size["update_kl"] < DELTA
    for a, b, d in zip(*map(jax.tree.leaves, (params, BEFORE, DIRECTION)), strict=True):
        np.testing.assert_allclose(a, b + 1e-3 * d, atol=1e-6)


@pytest.mark.parametrize("size", [0.1, 3.0], ids=["a little too long", "far too long"])
def test_a_long_update_ends_near_its_bound(shorten, size):
    """One shortening is enough where KL is quadratic; a far update, where KL is flat, needs several."""
    _, long = shorten(size)
    assert long["update_kl"] > 2 * DELTA
    assert long["update_scale"] < 1
    _, again = shorten(size * long["update_scale"])
    assert 0.3 * DELTA < again["update_kl"] <= 1.5 * DELTA
    assert again["update_scale"] == 1


def test_a_far_update_is_shortened_more_than_once(shorten):
    _, far = shorten(3.0)
    assert far["update_scale"] < 0.9 * np.sqrt(DELTA / far["update_kl"])


def test_an_update_without_a_finite_kl_is_left_out(shorten):
    """Parameters of 1e30 overflow in the first product, and those of a sixteenth of it do."""
    params, size = shorten(1e30)
    assert not np.isfinite(size["update_kl"])
    assert size["update_scale"] == 0
    for a, b in zip(*map(jax.tree.leaves, (params, BEFORE)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_update_to_parameters_that_are_not_finite_is_left_out(learn):
    after = jax.tree.map(lambda a: jnp.full_like(a, jnp.inf), BEFORE)
    params, size = jax.jit(lambda after: within_trust(FNS, CONFIG, BEFORE, after, learn, DELTA))(after)
    assert size["update_scale"] == 0
    jax.tree.map(np.testing.assert_array_equal, params, BEFORE)


@pytest.mark.parametrize(
    ("guard", "counts"), [(skip_nonfinite, [1, 1]), (lambda optimizer: optimizer, None)], ids=["ours", "a caller's own"]
)
def test_an_update_that_is_left_out_is_counted(learn, guard, counts):
    """Both gradients are finite, and the second of two updates is far too long."""
    algorithm = Paper(beta=0.0, gamma=0.0, trust_nat=DELTA, updates=2)
    config = dataclasses.replace(CONFIG, algorithm=algorithm)
    optimizer = guard(optax.sgd(lambda count: jnp.where(count == 0, 0.0, 1e30)))
    learn = learn._replace(advantage=jnp.ones((P, G)))
    update = jax.jit(lambda: update_policy(FNS, optimizer, config, BEFORE, optimizer.init(BEFORE), BEFORE, learn))
    params, state, parts = update()
    jax.tree.map(np.testing.assert_array_equal, params, BEFORE)
    assert parts["lost_updates"] == 1
    found = count_skipped(state)
    assert found is counts or found.tolist() == counts


def test_rollouts_that_are_masked_do_not_make_an_update_look_shorter(learn):
    """Without the rollouts of one prompt the KL is that of the others, not less."""
    there = (jnp.arange(P) > 0)[:, None, None]
    after = jax.tree.map(lambda a, d: a + 0.05 * d, BEFORE, DIRECTION)
    config = dataclasses.replace(CONFIG, algorithm=dataclasses.replace(CONFIG.algorithm, mask_truncated=True))

    def kl(mask):
        part = learn._replace(rollout=learn.rollout.replace(mask=mask))
        return within_trust(FNS, config, BEFORE, after, part, 1e3)[1]["update_kl"]

    measure, mask = jax.jit(kl), learn.rollout.mask
    first, others, all_ = (measure(mask & x) for x in (~there, there, True))
    np.testing.assert_allclose((first + (P - 1) * others) / P, all_, rtol=1e-4)


@pytest.mark.parametrize(("kl", "stays"), [(1.3, True), (2.0, False)])
def test_an_update_is_shortened_from_one_and_a_half_times_the_bound_on(shorten, kl, stays):
    size = 0.1 * np.sqrt(kl * DELTA / shorten(0.1)[1]["update_kl"])
    _, found = shorten(size)
    assert (1.15 if stays else 1.6) * DELTA < found["update_kl"] < (1.45 if stays else 2.4) * DELTA
    assert (found["update_scale"] == 1) == stays
