"""Objectives without labels compared, collapse, and predicted frames: their arithmetic by hand values."""

import numpy as np
import pytest

from experiments.encoder.pretrain import depth_measures
from experiments.encoder.stability_encoder import ARMS, CollapseOutcome
from experiments.encoder.stage_one import at_steps, chosen_steps, lead
from experiments.encoder.video_prediction import FrameScores, mean_frames
from sensors_io.pipeline import clip_batches


def test_measures_of_depth_by_hand():
    """A dent of .4 mm in one of four nodes: its depth, rms .2, and the change along x and y at the one corner."""
    depth = np.zeros((1, 2, 2), np.float32)
    depth[0, 0, 0] = 0.4
    np.testing.assert_allclose(depth_measures(depth), [[0.4, 0.2, np.sqrt(0.32)]], rtol=1e-6)


def test_steps_are_chosen_for_each_number_of_labels_over_all_seeds():
    """Axes seed, count, steps, contact, attribute: with few labels short training is right, with many long."""
    right = np.zeros((2, 2, 2, 3, 3), bool)
    right[:, 0, 0], right[:, 1, 1] = True, True
    right[0, 0, 1, :2] = True
    steps = chosen_steps(right)
    assert list(steps) == [0, 1]
    assert at_steps(right, steps).shape == (2, 2, 3, 3)
    assert at_steps(right, steps).all()


def test_a_lead_pairs_contacts_and_is_in_points():
    a, b = np.ones((2, 1, 4, 3)), np.zeros((2, 1, 4, 3))
    b[:, :, :2] = 1
    found = lead(a, b, np.array([0, 0, 1, 1]))
    assert found.mean == 50
    assert (found.low, found.high) == (0, 100)


def test_failure_is_defined_at_the_end_and_alarms_during_training():
    """Seed 0 falls and recovers, seed 1 falls for good and keeps a third of its spread."""
    measured = {
        "kept": np.array([[0.2, 0.3, 0.9], [0.9, 0.4, 0.3]]),  # a fresh encoder raises no alarm
        "rank_share": np.full((2, 3), 0.5),
        "skill": np.full((2, 3), 0.3),
    }
    outcome = CollapseOutcome(arm=ARMS[0], measured=measured, kept=np.array([2.0, 0.3]), lead=np.array([-1.0, 0.0]))
    np.testing.assert_array_equal(outcome.failed, [False, True])
    np.testing.assert_array_equal(outcome.alarmed, [False, True])
    assert outcome.first_alarm(1) == 2


@pytest.mark.long
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
