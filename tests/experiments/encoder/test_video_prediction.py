"""Predicted films, shrunk: clips of four frames of 28 px, one and two frames ahead."""

import dataclasses

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.encoder import video_prediction
from experiments.encoder.data import StageOneDataConfig
from experiments.encoder.video_prediction import SIGHT, TOUCH
from experiments.encoder.video_scores import COPY, MEAN, FrameScores, mean_frames
from experiments.encoder.video_training import VideoTrainingConfig
from sensors_io.pipeline import clip_batches
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.models.frame_decoder import FrameDecoderConfig

TINY = video_prediction.VideoPredictionConfig(
    touch=StageOneDataConfig(scenes=dataclasses.replace(tiny.SCENES)),
    frames=4,
    image_px=28,
    skips=(1, 2),
    tactile=dataclasses.replace(tiny.MODEL.tactile, causal=True),
    decoder=FrameDecoderConfig(width=4, num_layers=1),
    film=VideoTrainingConfig(steps=2, batch_size=2),
    scored=3,
    mean_of=4,
)


@pytest.fixture(scope="module")
def directory(tmp_path_factory, cache_dir):
    return run_shrunk(video_prediction, TINY, tmp_path_factory.mktemp("runs"), "--cache-dir", str(cache_dir))


@pytest.mark.slow
def test_both_predictors_stand_beside_the_baselines(directory):
    results = read_json(directory / "results.json")
    rows = [row[0] for row in results["tables"][0]["rows"]]
    assert rows == [f"{name}, {s} ahead" for s in (1, 2) for name in (TOUCH, SIGHT, COPY, MEAN)]
    assert [c["name"] for c in results["tables"][0]["columns"]] == ["method", "l1", "ssim", "encoder_distance", "skill"]
    of_sensors = {table["title"]: table["rows"] for table in results["tables"]}["L1 by sensor"]
    assert [row[0] for row in of_sensors] == ["gelsight_mini", "xense", "tac3d", "dmtac_x"]
    assert (directory / "plots" / "film_strip.png").stat().st_size > 1000


def test_mean_frames_are_means_of_what_was_recorded(data, context):
    rows = data.parts["sft"][:3]
    (clip,) = clip_batches(data.store, rows, data.clip, batch_size=3, seed=0, shuffle=False, repeat=False)
    seen = clip["frame_mask"][..., None, None, None]
    assert not seen.all()  # some frames were left out of their clips, as padding of zeros
    known = np.ma.masked_array(clip["frames"] / 255.0, ~np.broadcast_to(seen, clip["frames"].shape))
    np.testing.assert_allclose(mean_frames(data, rows, context), known.mean(0).filled(0.0), atol=1e-6)


def test_scores_leave_out_what_is_missing():
    values = np.array([[[1.0, np.nan, 7.0]], [[3.0, 5.0, 9.0]]])
    scores = FrameScores(values={"l1": values}, skips=np.array([3, 3, 5]))
    np.testing.assert_array_equal(scores.of("l1", 3), [1, 4])
    np.testing.assert_array_equal(scores.by_sensor("l1", 3), [3])
