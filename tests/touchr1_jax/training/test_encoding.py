"""Encoded noise: drawn at the statistics of the recorded frames."""

import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.schema import CLIP_ARRAYS
from tests.touchr1_jax import tiny
from tests.touchr1_jax.tiny import FNS
from touchr1_jax.models.load import WeightsError
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.training.encoding import encode_contacts, noise_bank
from touchr1_jax.types import TouchBatch


class Mirror(PolicyFns):
    """In the place of the policy: the streams that it is given, unencoded."""

    def encode_streams(self, params, *stream):
        del params
        pixels, push, index, mask, sensor = stream
        rows = [x.reshape(len(sensor), -1).astype(jnp.float32) for x in (pixels, push, index, mask)]
        return jnp.concatenate(rows, -1)[:, None]


def bank(clip: dict[str, np.ndarray], draws: int):
    """Noise drawn from clips: pixels, forces, frame indices and masks, leading [K, S, F]."""
    made = np.asarray(noise_bank(Mirror(**vars(FNS)), {}, TouchBatch(**clip), seed=3, draws=draws))[:, :, 0]
    s, f, h, w = clip["frames"].shape[1:5]
    pixels, force, index, mask = np.split(made, np.cumsum([f * h * w * 3, f * 3, f]), -1)
    return pixels.reshape(draws, s, f, h * w, 3), force.reshape(draws, s, f, 3), index, mask


def touched(levels: np.ndarray, pushes: np.ndarray, contacts: int = 4) -> dict[str, np.ndarray]:
    """Clips of two sensors whose last frame is padding, white and pushed with 10⁶ N; sensor 1 misses contact 0."""
    sizes = {"P": contacts, "S": 2, "F": 3, "H": 8, "W": 8, "Hv": 4, "Wv": 4, "A": 4, "3": 3}
    shape = lambda spec: tuple(sizes[d] for d in ("P", *spec.dims))
    clip = {name: np.zeros(shape(spec), spec.dtype) for name, spec in CLIP_ARRAYS.items()}
    clip["frames"][:] = levels
    clip["force_n"][:] = pushes
    clip["frame_mask"][:, :, :2] = True
    clip["frame_mask"][0, 1] = False
    clip["frame_index"][:] = 10 * np.arange(contacts)[:, None, None] + np.arange(3)
    clip["frames"][~clip["frame_mask"]] = 255
    clip["force_n"][~clip["frame_mask"]] = 1e6
    return clip


def test_noise_of_a_constant_touch_is_that_constant_whatever_the_padding_holds():
    levels = np.array([[40, 50, 60], [70, 80, 90]])[:, None, None, None, :]  # [S, 1, 1, 1, 3]
    pushes = np.array([[1.0, 2, -3], [4, 5, -6]])[:, None, :]
    pixels, force, _, _ = bank(touched(levels, pushes), 2)
    np.testing.assert_allclose(pixels, np.broadcast_to(levels[:, :, 0], pixels.shape), atol=1e-3)
    np.testing.assert_allclose(force, np.broadcast_to(pushes, force.shape), atol=1e-5)


def test_noise_has_the_mean_and_spread_of_the_recorded_frames():
    stripes = np.where(np.arange(8) % 2, 120, 80)[:, None]  # mean 100, σ 20
    pushes = np.array([0.0, 4.0, 0.0])[:, None]  # frames 0 and 1 count: mean 2, σ 2
    pixels, force, _, _ = bank(touched(stripes, pushes), 400)
    np.testing.assert_allclose(pixels.mean((0, 2, 3)), 100, atol=0.5)
    np.testing.assert_allclose(pixels.std((0, 2, 3)), 20, atol=0.5)
    np.testing.assert_allclose(force.mean((0, 2)), 2, atol=0.3)
    np.testing.assert_allclose(force.std((0, 2)), 2, atol=0.3)


def test_noise_keeps_the_frame_times_of_the_contacts_and_no_frame_repeats():
    clip = touched(np.where(np.arange(8) % 2, 120, 80)[:, None], np.zeros(3))
    pixels, _, index, mask = bank(clip, 6)
    rows, sensors = np.array([[0, 1, 2, 3, 0, 1], [1, 2, 3, 1, 2, 3]]).T, np.arange(2)
    assert np.array_equal(index, clip["frame_index"][rows, sensors])
    assert np.array_equal(mask, clip["frame_mask"][rows, sensors])
    assert len(np.unique(pixels[..., 0, 0])) == pixels[..., 0, 0].size


def test_no_draw_has_the_frames_of_a_sensor_that_recorded_none():
    """The encoder reads masked frames as nothing: such a draw would be no noise, but a blank."""
    mask = bank(touched(np.full(8, 100)[:, None], np.zeros(3)), 8)[-1]
    assert mask.any(-1).all()


class Pushed(PolicyFns):
    """In the place of the policy: touch that is as strong as the force."""

    def encode(self, params, batch, *, blind):
        del params, blind
        features = tiny.features(0, len(batch.label))
        return features.replace(touch=features.touch + batch.force_n[:, :, :1, :1])


def test_a_contact_whose_features_are_not_finite_is_named():
    """A policy would answer the first word of its vocabulary, in validation and tests without a word."""
    batches = [tiny.touch_batch(seed, 2) for seed in range(2)]
    assert len(encode_contacts(Pushed(**vars(FNS)), {}, batches).touch) == 4
    batches[1].force_n[0, 1, 0] = np.nan
    with pytest.raises(WeightsError, match="touch of contact 2 among those to encode has numbers that are not finite"):
        encode_contacts(Pushed(**vars(FNS)), {}, batches)
