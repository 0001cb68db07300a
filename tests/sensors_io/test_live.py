"""A data set that is made when it is asked for gives the clips of the same set on disk."""

import numpy as np

from sensors_io import live
from sensors_io.live import LiveScenes
from sensors_io.pipeline import ClipConfig, clip_batches
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import CLIP_ARRAYS
from tests.sensors_io import fakes


def test_clips_are_those_from_disk(monkeypatch, tmp_path):
    def made(config, i):
        return [fakes.sequence(i // 2, sensor, trial=i % 2) for sensor in ("xense", "tac3d")]

    monkeypatch.setattr(live, "make_contact", made)
    monkeypatch.setattr(live, "contact_key", lambda config, i: made(config, i)[0].key)
    monkeypatch.setattr(live, "object_cards", lambda config: [fakes.card(n) for n in range(config.objects)])
    scenes = LiveScenes(SceneConfig(objects=6, sites=1))
    clip = ClipConfig(frames=3, image_px=8, view_px=8, sensors=("xense", "tac3d"))
    fakes.write(tmp_path, 6, sensors=("xense", "tac3d"))
    order = {"batch_size": 2, "seed": 5, "repeat": False}
    fed, read = (list(clip_batches(store, range(6), clip, **order)) for store in (scenes, RecordStore(tmp_path)))
    assert len(fed) == len(read) == 3
    for a, b in zip(fed, read, strict=True):
        assert a.keys() == b.keys() == CLIP_ARRAYS.keys() | {"contact"}
        for name in a:
            rounding = {"force_n": 1e-3, "frames": 1}.get(name, 0)  # fields and forces are stored as counts
            np.testing.assert_allclose(a[name].astype(float), b[name].astype(float), atol=rounding, err_msg=name)
