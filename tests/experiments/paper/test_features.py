"""What baselines see of recorded contacts."""

import dataclasses

import numpy as np
import pytest

from experiments.paper import features
from experiments.paper.eval_variants import pooled, swap_objects
from experiments.paper.features import SIDE, field_features, picture_features
from tests.experiments import tiny


def test_fields_of_the_strongest_press_are_averaged_over_cells(data, monkeypatch):
    rows = data.parts["test"][:2]
    found = field_features(data.store, rows, data.clip.sensors)
    assert found.x.shape == (2, 4, 2 * SIDE**2)
    recorded = data.store.contact(int(rows[0]))["tac3d"]
    t = int(np.argmin(recorded.force_n[:, 2]))
    s = data.clip.sensors.index("tac3d")
    assert found.present.all()
    depth = found.x[0, s, : SIDE**2]
    assert depth.max() <= recorded.depth_mm[t].max() + 1e-6
    assert depth.mean() == pytest.approx(recorded.depth_mm[t].mean(), rel=0.05)
    bare = dataclasses.replace(
        recorded, depth_mm=None, deformation_mm=None, frames=np.zeros((len(recorded), 4, 4, 3), np.uint8)
    )
    monkeypatch.setattr(type(data.store), "contact", lambda self, i, fields: {"tac3d": bare})
    assert not field_features(data.store, rows, data.clip.sensors).present.any()


def test_pictures_tell_colour_and_texture(data):
    found = picture_features(data.store, data.parts["test"])
    assert found.present.all()
    view = data.store.objects[data.store.contacts[int(data.parts["test"][0])].object_id].view
    colour = found.x[0, 0, : 3 * SIDE**2].reshape(SIDE, SIDE, 3)
    assert colour.mean((0, 1)) == pytest.approx(view.mean((0, 1)) / 255, abs=1e-3)
    flat = features._looks(np.full((16, 16, 3), 100, np.uint8))
    assert np.ptp(flat[3 * SIDE**2 :]) == 0


def test_tokens_that_are_not_there_do_not_count():
    felt = tiny.features(3)
    time = felt.touch_time.copy()
    time[0, 0, 1:] = -1
    felt = dataclasses.replace(felt, touch_time=time, stream_mask=felt.stream_mask & (np.arange(3) != 2)[:, None])
    seen = pooled(felt)
    assert np.allclose(seen.x[0, 0], felt.touch[0, 0, 0], atol=1e-6)
    assert np.allclose(seen.x[1, 2], felt.touch[1, 2].mean(0), atol=1e-6)
    assert seen.present.tolist() == [[True] * 4, [True] * 4, [False] * 4]


def test_swapped_touch_is_whole_and_anothers():
    felt = tiny.features(4)
    objects = np.array(["a", "a", "b", "c"])
    swapped = swap_objects(felt, objects, 0)
    for i in range(4):
        (source,) = (j for j in range(4) if np.array_equal(swapped.touch[i], felt.touch[j]))
        assert objects[source] != objects[i]
    assert np.array_equal(swapped.view, felt.view)
