"""From pictures to a calibration, and what refuses it."""

import dataclasses
import pathlib
import re

import numpy as np
import pytest

from sensors_io.__main__ import main
from sensors_io.calibration.calibrate import CalibrateConfig, calibrate
from sensors_io.calibration.presses import BallPresses
from sensors_io.fields.types import Calibration, CalibrationError
from tests.sensors_io.calibration.synthetic import press_ball, spread_touches
from tests.sensors_io.checks import refused

CLIPS = pathlib.Path(__file__).parents[2] / "data" / "gelslam"
MM_PER_PX = 3 * 0.0634
QUICK = CalibrateConfig(folds=2, repeats=1)
TOUCHES = spread_touches(12)
SAID = ("will not transfer.*press more often", "slopes are (steep|flat)", r"cover \d+% of.*right; press there")


@pytest.fixture(scope="module")
def presses() -> BallPresses:
    return press_ball(TOUCHES)


def names(presses: BallPresses) -> tuple[str, ...]:
    return tuple(f"press {i}" for i in range(len(presses)))


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A calibration by the command, from real presses."""
    out = tmp_path_factory.mktemp("calibration") / "mini.npz"
    command = ["calibrate", str(CLIPS), "--background", str(CLIPS / "background.png"), "--ball-diameter-mm", "6.31"]
    assert main([*command, "--mm-per-px", str(MM_PER_PX), "--out", str(out), "--folds", "3", "--repeats", "2"]) == 0
    return out


@pytest.mark.long
def test_real_presses_calibrate(real: pathlib.Path) -> None:
    """14 of them, a third as wide as they were recorded: coarser than the published figures, the same order."""
    made = Calibration.load(real)
    assert made.made_from["ball_diameter_mm"] == 6.31
    assert made.made_from["held-out presses"] == 14
    assert made.made_from["held-out depth rmse median, um"] < 25
    assert made.made_from["held-out radius error median, %"] < 20


@pytest.mark.long
def test_extract_writes_arrays_over_frames(real: pathlib.Path, tmp_path: pathlib.Path) -> None:
    inputs = [str(CLIPS / f"press_{i}.png") for i in (9, 20)] + [str(CLIPS / "background.png")]
    out = tmp_path / "fields.npz"
    command = ["extract", *inputs, "--background", str(CLIPS / "background.png"), "--calibration", str(real)]
    assert main([*command, "--out", str(out)]) == 0
    with np.load(out) as fields:
        assert fields["depth_mm"].shape == (3, 80, 106)
        assert fields["contact"].any((1, 2)).tolist() == [True, True, False]
        assert (fields["depth_mm"][:2].max((1, 2)) > 0.5).all()
        assert fields["flags"][2] & 16
        assert not fields["flags"][:2].astype(int)[0] & 16
        for name in ("deformation_mm", "shear_mm"):  # a bare gel carries none
            assert fields[name].shape == (3, 1, 1, 2)
            assert np.isnan(fields[name]).all()
        assert (fields["flags"].astype(int) & 2048).all()
        assert str(fields["calibration"]) == Calibration.load(real).hash


@pytest.mark.long
def test_the_order_of_the_presses_changes_no_bit(presses: BallPresses) -> None:
    order = np.random.default_rng(2).permutation(len(presses))
    named = np.array(names(presses))
    one, report = calibrate(presses, tuple(named), "x", QUICK)
    two, other = calibrate(presses.chosen(order), tuple(named[order]), "x", QUICK)
    assert one.hash == two.hash
    assert one.made_from == two.made_from
    np.testing.assert_array_equal(report.touches.stacked()[order], other.touches.stacked())
    np.testing.assert_array_equal(report.errors.depth_um[:, order], other.errors.depth_um)
    assert [report.kept[i] for i in order] == list(other.kept)


@pytest.mark.long
def test_a_map_that_will_not_transfer_says_so(presses: BallPresses) -> None:
    left = dataclasses.replace(presses, pictures=presses.pictures[TOUCHES[:, 0] < 50])
    strict = dataclasses.replace(QUICK, least_presses=4, sure_radius=1e-4, sure_bias=1e-5)
    said = calibrate(left, names(left), "x", strict)[1].warnings
    assert [bool(re.search(part, text)) for part, text in zip(SAID, said, strict=True)] == [True] * 3
    fine = dataclasses.replace(QUICK, sure_radius=0.2, sure_bias=0.2, sure_cover=0.2)
    assert calibrate(presses, names(presses), "x", fine)[1].warnings == ()


@pytest.mark.long
def test_presses_that_cannot_calibrate_are_refused(presses: BallPresses) -> None:
    washed = np.clip(presses.pictures.astype(int) * 8 - 770, 0, 255).astype(np.uint8)
    grey = np.repeat(presses.pictures[..., :1], 3, -1)
    blank = np.repeat(presses.background[None], 10, 0)
    window = "pictures of 106 × 80 px show {}.*longer side must lie in"
    for said, change in (
        (r"--ball-diameter-mm|is no ball|come out", {"radius_mm": 1.2}),
        (window.format("47.7 × 36.0 mm at --mm-per-px 0.45"), {"mm_per_px": 3 * presses.mm_per_px}),
        (window.format("5.3 × 4.0 mm"), {"mm_per_px": presses.mm_per_px / 3}),
        (r"saturated|no ball|everywhere", {"pictures": washed}),
        ("by 60 grey levels everywhere", {"background": presses.background - np.uint8(60)}),
        (r"0 of 10 presses can be used[\s\S]*press 3 shows no contact", {"pictures": blank}),
        ("change alike.*maker's table", {"pictures": grey}),
        ("5 of 5 presses can be used: must be ≥ 8", {"pictures": presses.pictures[:5]}),
        (r"1 of 10 presses[\s\S]*press 9 is a copy of press 0", {"pictures": presses.pictures[[0] * 10]}),
    ):
        wrong = dataclasses.replace(presses, **change)
        refused(CalibrationError, said, calibrate, wrong, names(wrong), "x", QUICK)


@pytest.mark.long
def test_pictures_that_are_given_twice_count_once(presses: BallPresses) -> None:
    """A copy in another fold would be held out from nothing; more folds than presses are as many as presses."""
    twice = presses.chosen(np.arange(24) % 12)
    config = dataclasses.replace(QUICK, folds=20)
    done = []
    made, report = calibrate(twice, names(twice), "x", config, lambda *at: done.append(at))
    alone, other = calibrate(presses, names(presses), "x", dataclasses.replace(QUICK, folds=12))
    assert (made.hash, len(report.kept), report.left_out[0].reason) == (alone.hash, 12, "is a copy of press 0")
    np.testing.assert_array_equal(report.errors.depth_um, other.errors.depth_um)
    assert done[-1] == (13, 13)


@pytest.mark.slow
def test_a_picture_without_contact_is_left_out_and_named(presses: BallPresses) -> None:
    blank = dataclasses.replace(presses, pictures=np.concatenate([presses.pictures, presses.background[None]]))
    _, report = calibrate(blank, names(blank), "x", QUICK)
    assert [(press.name, "shows no contact" in press.reason) for press in report.left_out] == [("press 12", True)]
    assert len(report.kept) == 12


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"folds": 1}, "folds is 1: must be ≥ 2; raise it"),
        ({"repeats": 0}, "repeats is 0: must be ≥ 1; raise it"),
        ({"seed": -1}, "seed is -1: must be ≥ 0; raise it"),
        ({"most_radius": float("nan")}, "most_radius is nan: must be ≥ 0; raise it"),
        ({"window_mm": (40.0, 10.0)}, "window_mm is .*: must be two numbers that rise"),
    ],
)
def test_requirements_that_mean_nothing_are_refused(change, said):
    with pytest.raises(ValueError, match=said):
        CalibrateConfig(**change)
