"""The stages in their parts: evidence and noise."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.study.dataset import Dataset
from experiments.study.stages import Probed, gather_evidence, noise_bank
from sensors_io.schema import CLIP_ARRAYS, LEVELS
from touchr1_jax.training.evidence import ProbeConfig

PROBE = ProbeConfig(folds=2, iterations=4)


@pytest.fixture(scope="module")
def probed(data):
    """Random features of every stream; sensors 0 and 1 miss one contact each, sensor 2 saw one alone, sensor 3 none."""
    n = len(data.store)
    present = np.ones((n, 4), bool)
    present[data.parts["sft"][:2], [0, 1]] = False
    present[:, 2] = np.arange(n) == data.parts["sft"][0]
    present[:, 3] = False
    streams = np.random.default_rng(0).normal(size=(n, 4, 5)).astype(np.float32)
    return Probed(streams=streams, present=present, force=np.zeros((n, 1), np.float32))


def test_evidence_of_what_was_felt_is_a_distribution_and_of_the_rest_nothing(data, probed, context):
    evidence = gather_evidence(data, probed, PROBE, context)
    sft = np.isin(np.arange(len(data.store)), data.parts["sft"])
    for a, levels in enumerate(LEVELS.values()):
        assert (evidence[:, :, a, levels:] == -np.inf).all()
        for s in (0, 1):
            felt = sft & probed.present[:, s]
            known = evidence[:, s, a, :levels]
            np.testing.assert_allclose(np.exp(known[felt]).sum(-1), 1, atol=1e-5)
            assert np.ptp(known[felt], axis=-1).min() > 0
            assert (known[~felt] == 0).all()
        assert (evidence[:, 3, a, :levels] == 0).all()  # sensor 3 was never there
        assert (evidence[:, 2, a, :levels] == 0).all()  # one object cannot be held out


def test_an_attribute_that_nobody_annotated_has_no_evidence(data, probed, context):
    label = np.where(np.arange(4) == 0, -1, data.label)
    evidence = gather_evidence(dataclasses.replace(data, label=label), probed, PROBE, context)
    assert (evidence[:, :, 0, :3] == 0).all()
    assert (evidence[data.parts["sft"][1:], 0, 1, :3] != 0).all()


class Mirror:
    """In the place of the policy: the streams that it is given, unencoded."""

    def encode_streams(self, params, pixels, push, index, mask, sensor):
        del params
        rows = [x.reshape(len(sensor), -1).astype(jnp.float32) for x in (pixels, push, index, mask)]
        return jnp.concatenate(rows, -1)[:, None]


@pytest.fixture
def bank(data, monkeypatch):
    """Draw noise from given clips; returns pixels, forces, frame indices and masks, leading [K, S, F]."""

    def draw(clip: dict[str, np.ndarray], draws: int):
        monkeypatch.setattr(Dataset, "batches", lambda *args, **kwargs: iter([clip]))
        made = np.asarray(noise_bank(Mirror(), {}, data, seed=3, draws=draws))[:, :, 0]
        s, f, h, w = clip["frames"].shape[1:5]
        ends = np.cumsum([f * h * w * 3, f * 3, f])
        pixels, force, index, mask = np.split(made, ends, -1)
        return pixels.reshape(draws, s, f, h * w, 3), force.reshape(draws, s, f, 3), index, mask

    return draw


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


def test_noise_of_a_constant_touch_is_that_constant_whatever_the_padding_holds(bank):
    levels = np.array([[40, 50, 60], [70, 80, 90]])[:, None, None, None, :]  # [S, 1, 1, 1, 3]
    pushes = np.array([[1.0, 2, -3], [4, 5, -6]])[:, None, :]
    pixels, force, _, _ = bank(touched(levels, pushes), 2)
    np.testing.assert_allclose(pixels, np.broadcast_to(levels[:, :, 0], pixels.shape), atol=1e-3)
    np.testing.assert_allclose(force, np.broadcast_to(pushes, force.shape), atol=1e-5)


def test_noise_has_the_mean_and_spread_of_the_recorded_frames(bank):
    stripes = np.where(np.arange(8) % 2, 120, 80)[:, None]  # mean 100, σ 20
    pushes = np.array([0.0, 4.0, 0.0])[:, None]  # frames 0 and 1 count: mean 2, σ 2
    pixels, force, _, _ = bank(touched(stripes, pushes), 400)
    np.testing.assert_allclose(pixels.mean((0, 2, 3)), 100, atol=0.5)
    np.testing.assert_allclose(pixels.std((0, 2, 3)), 20, atol=0.5)
    np.testing.assert_allclose(force.mean((0, 2)), 2, atol=0.3)
    np.testing.assert_allclose(force.std((0, 2)), 2, atol=0.3)


def test_noise_keeps_the_frame_times_of_the_contacts_and_no_frame_repeats(bank):
    clip = touched(np.where(np.arange(8) % 2, 120, 80)[:, None], np.zeros(3))
    pixels, _, index, mask = bank(clip, 6)
    rows = np.arange(6) % 4
    assert np.array_equal(index, clip["frame_index"][rows])
    assert np.array_equal(mask, clip["frame_mask"][rows])
    assert len(np.unique(pixels[..., 0, 0])) == pixels[..., 0, 0].size
