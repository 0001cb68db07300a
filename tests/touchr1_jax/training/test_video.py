"""Video prediction: what reaches a predicted frame, and what it is compared with."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.models.frame_decoder import FrameDecoderConfig
from touchr1_jax.training.video import (
    Asked,
    VideoConfig,
    VideoPredictor,
    draw_asked,
    every_question,
    make_video_step,
    start_video,
    target_of,
    video_loss,
)

pytestmark = pytest.mark.long

P, S = 2, tiny.S
CONFIG = VideoConfig(
    encoder=dataclasses.replace(tiny.CONFIG.tactile, causal=True, frames_per_step=1),
    decoder=FrameDecoderConfig(width=4, num_layers=1),
    vision=tiny.CONFIG.vision,
    skips=(1, 2),
)
OPTIMIZER = optax.adam(3e-3)
ASKED = Asked(last=jnp.ones((P, S), jnp.int32), skip=jnp.ones((P, S), jnp.int32))


@pytest.fixture(scope="module")
def batch():
    return jax.tree.map(jnp.asarray, tiny.touch_batch(0, P))


@pytest.fixture(scope="module")
def state(batch):
    return jax.jit(lambda key, b: start_video(CONFIG, OPTIMIZER, key, b))(jax.random.key(0), batch)


@pytest.fixture(scope="module")
def predict(state):
    """Predictions with an output layer that no longer answers the last frame."""
    params = jax.tree.map(jnp.array, state.params)
    params["decoder"]["out"]["kernel"] = jax.random.normal(jax.random.key(1), params["decoder"]["out"]["kernel"].shape)
    return jax.jit(lambda b, a: VideoPredictor(CONFIG).apply({"params": params}, b, a))


def test_the_future_is_not_seen(predict, batch):
    before = predict(batch, ASKED)
    later = batch.replace(frames=batch.frames.at[:, :, 2:].set(7), force_n=batch.force_n.at[:, :, 2:].set(7.0))
    np.testing.assert_array_equal(predict(later, ASKED), before)
    for t in (0, 1):
        assert (predict(batch.replace(frames=batch.frames.at[:, :, t].set(7)), ASKED) != before).any()
    assert (predict(batch.replace(view=255 - batch.view), ASKED) != before).any()
    assert (predict(batch, ASKED.replace(skip=jnp.zeros((P, S), jnp.int32))) != before).any()


def test_a_fresh_predictor_copies_the_last_frame(state, batch):
    value, metrics = jax.jit(lambda s, b, a: video_loss(CONFIG, s.params, b, a))(state, batch, ASKED)
    copied = np.abs(np.asarray(batch.frames[:, :, 1], float) - np.asarray(batch.frames[:, :, 3], float)).mean() / 255
    np.testing.assert_allclose(value, copied, rtol=1e-5)
    np.testing.assert_allclose(metrics["skill"], 0.0, atol=1e-6)


def test_targets_by_hand(batch):
    frames, exists = target_of(batch, ASKED.replace(last=ASKED.last.at[0, 0].set(0)), CONFIG.skips)
    np.testing.assert_allclose(frames[0, 0], batch.frames[0, 0, 2] / 255.0, rtol=1e-6)
    np.testing.assert_allclose(frames[1, 1], batch.frames[1, 1, 3] / 255.0, rtol=1e-6)
    assert exists.all()
    gone = batch.replace(
        frame_mask=batch.frame_mask.at[0, 1, 3].set(False), stream_mask=batch.stream_mask.at[1, 0].set(False)
    )
    np.testing.assert_array_equal(target_of(gone, ASKED, CONFIG.skips)[1], [[True, False], [False, True]])


def test_questions_stay_within_the_clip(batch):
    keys = jax.random.split(jax.random.key(0), 50)
    asked = jax.vmap(lambda k: draw_asked(k, batch, CONFIG.skips))(keys)
    seen = {(int(t), int(k)) for t, k in zip(np.ravel(asked.last), np.ravel(asked.skip), strict=True)}
    assert seen == set(every_question(tiny.FRAMES, CONFIG.skips)) == {(0, 0), (1, 0), (2, 0), (0, 1), (1, 1)}
    with pytest.raises(ValueError, match=r"skips is \(1, 4\): must be < 4"):
        draw_asked(keys[0], batch, (1, 4))


def test_frames_are_learned_by_heart(state, batch):
    step, state = make_video_step(CONFIG, OPTIMIZER), jax.tree.map(jnp.array, state)
    skills = []
    for _ in range(40):
        state, metrics = step(state, batch)
        skills.append(float(metrics["skill"]))
    assert abs(skills[0]) < 1e-6
    assert np.mean(skills[-5:]) > 0.02  # frames of noise: what can be learned is to answer their mean
    assert step._cache_size() == 1


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"encoder": dataclasses.replace(CONFIG.encoder, causal=False)}, "encoder is causal=False"),
        ({"encoder": dataclasses.replace(CONFIG.encoder, patches_kept=2)}, "patches_kept=2"),
        ({"skips": ()}, r"skips is \(\): must hold numbers"),
    ],
)
def test_bad_configs_are_refused(change, match):
    with pytest.raises(ValueError, match=match):
        dataclasses.replace(CONFIG, **change)
