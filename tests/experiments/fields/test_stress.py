"""The accounting of methods under stress, on outcomes that are known."""

import pytest

from experiments.fields.stability_fields import FieldStabilityConfig
from experiments.fields.stress import Stress, StressOutcome, break_table, gathered, silence
from sensors_io.schema import Flag

GOOD = StressOutcome(error=0.1, wrong=0.0, flags=Flag.NONE)
SILENT = StressOutcome(error=9.0, wrong=0.2, flags=Flag.NONE)
FLAGGED = StressOutcome(error=9.0, wrong=0.2, flags=Flag.MARKER_LOSS)

NOISE = Stress(name="noise", levels=(1, 2))
OUTCOMES = gathered(
    [("ours", "noise", 1, GOOD), ("ours", "noise", 2, FLAGGED)]
    + [("theirs", "noise", level, outcome) for level in (1, 2) for outcome in (SILENT, GOOD)]
)


def test_silent_is_broken_without_a_flag():
    assert [o.silent for o in (GOOD, SILENT, FLAGGED)] == [False, True, False]


def test_silent_frames_are_counted_by_method():
    _, ours = silence(OUTCOMES, "ours", "frames", "frames broken")
    _, theirs = silence(OUTCOMES, "theirs", "frames", "frames broken")
    assert (ours.measured, theirs.measured) == (0, 2)


def test_a_method_breaks_first_at_its_lowest_broken_level():
    assert break_table("tracking", OUTCOMES, [NOISE]).rows == (
        ("ours", "2: marker_loss 1"),
        ("theirs", "1: silent 2"),
    )


def test_a_configuration_without_the_package_is_refused():
    with pytest.raises(ValueError, match="must hold"):
        FieldStabilityConfig(methods=("mean shift",))
