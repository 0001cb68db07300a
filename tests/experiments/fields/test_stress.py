"""The accounting of methods under stress, on outcomes that are known."""

import pytest

from experiments.core.results import assemble
from experiments.fields.stress import StressedField, StressOutcome, break_table, gathered, stress_section
from sensors_io.schema import Flag

GOOD = StressOutcome(error=0.1, wrong=0.0, flags=Flag.NONE)
SILENT = StressOutcome(error=9.0, wrong=0.2, flags=Flag.NONE)
FLAGGED = StressOutcome(error=9.0, wrong=0.2, flags=Flag.MARKER_LOSS)

NOISE = StressedField("tracking", {"noise": (1, 2)}, 1.0, "px", "", ("frames", "frames broken"))


def outcomes(**frames):
    return gathered((name, "noise", level, o) for name, of in frames.items() for level in of for o in of[level])


def test_silent_is_broken_without_a_flag():
    assert [o.silent for o in (GOOD, SILENT, FLAGGED)] == [False, True, False]


@pytest.mark.parametrize(("mild", "silent"), [(GOOD, 0), (SILENT, 1), (FLAGGED, 0)])
def test_the_package_must_not_break_silently(mild, silent):
    parts = stress_section(NOISE, outcomes(other={1: [SILENT], 2: [SILENT]}, this={1: [mild], 2: [FLAGGED]}))
    assert [(r.measured, r.bound) for r in assemble(parts, {}).requirements] == [(silent, 0)]


def test_a_method_breaks_first_at_its_lowest_broken_level():
    found = outcomes(this={1: [GOOD], 2: [FLAGGED]}, theirs={1: [SILENT, GOOD], 2: [SILENT, GOOD]})
    assert break_table(NOISE, found).rows == (("this", "2: marker loss 1"), ("theirs", "1: silent 2"))
