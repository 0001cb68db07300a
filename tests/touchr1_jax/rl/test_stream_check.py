"""A stream that never reaches the policy is named and refused before training."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.rl.stream_check import ROUNDING_NAT, StreamError, check_streams, stream_influence

pytestmark = pytest.mark.long

P, LENGTH = 3, 3
BATCH = tiny.question_batch(0, P)
NOISE = jnp.asarray(np.random.default_rng(1).normal(size=(2, *BATCH.features.touch.shape[1:])), jnp.float32)


@pytest.fixture(scope="module")
def influence():
    """One program for all cases, which differ in numbers."""
    run = lambda batch, noise: stream_influence(
        tiny.SHALLOW, tiny.shallow_params(0), batch, noise, jax.random.key(0), LENGTH
    )
    return jax.jit(run)


def test_every_stream_that_is_read_moves_the_answers(influence):
    size, present = jax.device_get(influence(BATCH, NOISE))
    assert present.all()
    assert (size > 1e-4).all()
    check_streams(size, present)


def test_a_stream_of_constants_is_refused(influence):
    """Touch and noise of stream 1 end in the same tokens, as behind an encoder that is not connected."""
    wire = lambda x: x.at[:, 1].set(0.5)
    batch = BATCH.replace(features=BATCH.features.replace(touch=wire(BATCH.features.touch)))
    size, present = jax.device_get(influence(batch, wire(NOISE)))
    assert size[0] > 1e-4
    assert size[1] <= ROUNDING_NAT
    with pytest.raises(StreamError, match=r"stream 1: noise in it moves the answers by .* its touch does not reach"):
        check_streams(size, present)


def test_a_stream_that_is_hidden_from_attention_is_refused_and_one_that_is_absent_is_not(influence):
    absent = BATCH.replace(features=BATCH.features.replace(stream_mask=BATCH.features.stream_mask.at[:, 0].set(False)))
    size, present = jax.device_get(influence(absent, NOISE))
    assert size[0] <= ROUNDING_NAT
    assert present.tolist() == [False, True]
    check_streams(size, present)
    with pytest.raises(StreamError, match="stream 0"):
        check_streams(size, np.array([True, True]))


def test_a_batch_without_any_touch_is_refused():
    """No stream is present, so that none can be found silent."""
    with pytest.raises(StreamError, match="no prompt of the first batch has touch"):
        check_streams(np.zeros(2), np.zeros(2, bool))


def test_a_divergence_that_is_no_number_is_refused():
    with pytest.raises(StreamError, match="stream 0"):
        check_streams(np.array([np.nan]), np.array([True]))
