"""Baselines on fixed features, on contacts whose answers are known by hand; the features of recorded contacts."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.paper.feature_baselines import (
    CELLS,
    ContactFeatures,
    field_features,
    linear_probe,
    mean_tokens,
    nearest,
    other_objects,
    picture_features,
    together_and_alone,
)
from touchr1_jax.training.linear_probe import ProbeConfig

LEVELS = (3,)


def features(x, present=None) -> ContactFeatures:
    x = np.asarray(x, np.float32)
    return ContactFeatures(x=x, present=np.ones(x.shape[:2], bool) if present is None else np.asarray(present))


def predict(known, asked, levels, **options):
    return together_and_alone(functools.partial(nearest, levels=levels, **options), *known, asked)


def two_streams(noise: float, seed: int = 0, n: int = 60) -> tuple[ContactFeatures, np.ndarray]:
    """Stream 0 carries the level, stream 1 something else; both carry a constant too."""
    rng = np.random.default_rng(seed)
    label = np.arange(n)[:, None] % 3
    signal = np.stack([label[:, 0], np.arange(n) // 3 % 2], 1).astype(float)
    x = np.stack([signal, np.full((n, 2), 7.0)], 2)
    return features(x + noise * rng.normal(size=x.shape)), label


def test_neighbours_vote_by_one_over_their_distance():
    known = features([[[0.0]], [[1.0]], [[10.0]]]), np.array([[0], [1], [2]])
    together, alone = predict(known, features([[[0.2]], [[1.1]], [[7.0]]]), (3,), neighbours=1)
    assert together[:, 0].tolist() == [0, 1, 2]
    assert alone.shape == (3, 1, 1)
    known = features([[[0.0]], [[3.0]], [[3.0]]]), np.array([[0], [1], [1]])
    at = lambda x: predict(known, features([[[x]]]), (2,), neighbours=3)[0][0, 0]
    assert at(0.9) == 0  # 1/.9 against 2/2.1
    assert at(1.1) == 1  # 1/1.1 against 2/1.9


def test_a_feature_counts_by_its_spread_and_one_without_spread_does_not():
    x = [[[0.0, 0.0, 5.0]], [[1.0, 1000.0, 5.0]]]
    known = features(x), np.array([[0], [1]])
    assert predict(known, features([[[0.1, 600.0, 9.0]]]), (2,), neighbours=1)[0][0, 0] == 0


def test_streams_that_are_not_shared_do_not_count():
    known = features([[[0.0], [9.0]], [[1.0], [0.0]]], [[True, False], [True, True]]), np.array([[0], [1]])
    asked = features([[[0.1], [0.0]], [[0.0], [0.0]]], [[True, True], [False, False]])
    together, alone = predict(known, asked, (2,), neighbours=1)
    assert together[:, 0].tolist() == [0, -1]  # by the first stream alone; ⊥ where nothing was recorded
    assert alone[:, :, 0].tolist() == [[0, 1], [-1, -1]]


@pytest.mark.long
def test_a_probe_reads_a_stream_and_gives_bottom_where_it_is_absent():
    (known, label), (asked, truth) = two_streams(noise=0.05), two_streams(noise=0.05, seed=1)
    present = np.arange(60)[:, None] > 0
    probe = functools.partial(linear_probe, levels=LEVELS, config=ProbeConfig(iterations=20))
    together, alone = together_and_alone(probe, known.only(0), label, features(asked.only(0).x, present))
    assert np.array_equal(together[1:], truth[1:])
    assert np.array_equal(alone[:, 0], together)
    assert together[0, 0] == -1


def test_tokens_of_the_picture_stand_beside_each_stream_by_hand():
    """Two sensors, the second absent; a token without time does not count, nor does a picture that is not there."""
    seen = SimpleNamespace(
        touch=np.array([[[[1.0], [3.0]], [[5.0], [7.0]]]] * 2),
        touch_time=np.array([[[0, 0], [0, 0]], [[0, -1], [0, 0]]]),
        stream_mask=np.array([[True, False]] * 2),
        view=np.array([[[2.0, 4.0], [4.0, 8.0]]] * 2),
        view_mask=np.array([True, False]),
    )
    plain, both = mean_tokens(seen), mean_tokens(seen, picture=True)
    np.testing.assert_array_equal(plain.x[:, :, 0], [[2, 0], [1, 0]])
    np.testing.assert_array_equal(both.x[..., :1], plain.x)
    np.testing.assert_array_equal(both.x[..., 1:], [[[3, 6]] * 2, [[0, 0]] * 2])
    np.testing.assert_array_equal(both.present, [[True, False]] * 2)


def test_other_objects_are_others_and_all_are_drawn():
    objects = np.array(["a", "b", "a", "c", "b", "a"])
    drawn = np.stack([other_objects(objects, seed) for seed in range(200)])
    assert (objects[drawn] != objects).all()
    for i in range(6):
        assert set(drawn[:, i]) == set(np.flatnonzero(objects != objects[i]))
    with pytest.raises(ValueError, match="only"):
        other_objects(np.array(["a", "a"]), 0)


@pytest.mark.long
def test_fields_of_the_strongest_press_are_averaged_over_cells(data):
    rows = data.parts["test"][:2]
    found = field_features(data.store, rows, data.clip.sensors)
    assert found.x.shape == (2, 4, 2 * CELLS**2)
    assert found.present.all()
    recorded = data.store.contact(int(rows[0]))["tac3d"]
    t = int(np.argmin(recorded.force_n[:, 2]))
    depth = found.x[0, data.clip.sensors.index("tac3d"), : CELLS**2]
    assert depth.max() <= recorded.depth_mm[t].max() + 1e-6
    assert depth.mean() == pytest.approx(recorded.depth_mm[t].mean(), rel=0.05)
    bare = SimpleNamespace(depth_mm=None, deformation_mm=None)
    store = SimpleNamespace(contact=lambda row, fields: {"tac3d": bare})
    assert not field_features(store, np.arange(2), ("tac3d", "xense")).present.any()


def test_pictures_give_colour_and_texture():
    view = np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)
    found = picture_features([view, np.full((16, 16, 3), 100, np.uint8), None])
    assert found.present.tolist() == [[True], [True], [False]]
    colour, texture = np.split(found.x[:, 0], [3 * CELLS**2], axis=1)
    assert colour[0].reshape(CELLS, CELLS, 3).mean((0, 1)) == pytest.approx(view.mean((0, 1)) / 255, abs=1e-3)
    assert np.ptp(texture[1]) == 0
    assert texture[0].min() > texture[1].max()
