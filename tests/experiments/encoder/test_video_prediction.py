"""Predicted frames, shrunk: clips of four frames of 28 px, one and two frames ahead."""

import dataclasses

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.encoder import video_prediction
from experiments.encoder.pretrain import StageOneDataConfig
from experiments.encoder.video_prediction import (
    COPY,
    MEAN,
    TOUCH,
    VISION,
    FrameScores,
    VideoTrainingConfig,
    mean_frames,
)
from sensors_io.pipeline import clip_batches
from tests.experiments import tiny
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.models.frame_decoder import FrameDecoderConfig

TINY = video_prediction.VideoPredictionConfig(
    touch=StageOneDataConfig(scenes=tiny.SCENES),
    frames=4,
    image_px=28,
    skips=(1, 2),
    tactile=dataclasses.replace(tiny.MODEL.tactile, causal=True),
    decoder=FrameDecoderConfig(width=4, num_layers=1),
    film=VideoTrainingConfig(steps=2, batch_size=2),
    scored=3,
    mean_of=4,
)


@pytest.mark.slow
def test_both_predictors_and_the_baselines_are_reported(tmp_path, cache_dir):
    directory = run_shrunk(video_prediction, TINY, tmp_path, "--cache-dir", str(cache_dir))
    results = read_json(directory / "results.json")
    rows = [row[0] for row in results["tables"][0]["rows"]]
    assert rows == [f"{name}, {s} ahead" for s in (1, 2) for name in (TOUCH, VISION, COPY, MEAN)]
    assert [c["name"] for c in results["tables"][0]["columns"]] == ["method", "l1", "ssim", "encoder_distance", "skill"]
    of_sensors = {table["title"]: table["rows"] for table in results["tables"]}["L1 by sensor"]
    assert [row[0] for row in of_sensors] == ["gelsight_mini", "xense", "tac3d", "dmtac_x"]
    assert (directory / "plots" / "film_strip.png").stat().st_size > 1000


def test_mean_frames_are_means_of_what_was_recorded(data, context):
    rows = data.parts["sft"][:3]
    (clip,) = clip_batches(data.store, rows, data.clip, batch_size=3, seed=0, shuffle=False, repeat=False)
    exists = clip["frame_mask"][..., None, None, None]
    assert not exists.all()  # some frames are padding of zeros
    known = np.ma.masked_array(clip["frames"] / 255.0, ~np.broadcast_to(exists, clip["frames"].shape))
    np.testing.assert_allclose(mean_frames(data, rows, context), known.mean(0).filled(0.0), atol=1e-6)


def test_scores_leave_out_what_is_missing():
    values = np.array([[[1.0, np.nan, 7.0]], [[3.0, 5.0, 9.0]]])
    scores = FrameScores(values={"l1": values}, skips=np.array([3, 3, 5]))
    np.testing.assert_array_equal(scores.mean("l1", 3, 1), [1, 4])
    np.testing.assert_array_equal(scores.mean("l1", 3, 0), [3])
