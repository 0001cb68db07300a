"""All fields at once: what a bare gel, a marker gel and a wrong input give."""

import pathlib

import cv2
import numpy as np
import pytest

from sensors_io.devices.sources import source_of
from sensors_io.fields.deformation import DeformationReader
from sensors_io.fields.evidence import Pattern
from sensors_io.fields.extract import ExtractConfig, Extractor, OtherGelWarning
from sensors_io.fields.slopes import ColourMap
from sensors_io.fields.sources import SourceError, read_pictures
from sensors_io.fields.types import Calibration, CalibrationError, Fields
from sensors_io.index import MissingIndexError
from sensors_io.schema import Flag, SchemaError
from tests.sensors_io.checks import refused

SHAPE = (160, 214)


def bare() -> np.ndarray:
    return np.full((*SHAPE, 3), 120, np.uint8)


def dotted(shift: float = 0.0) -> np.ndarray:
    """A grid of dots, moved along x."""
    picture = np.full((*SHAPE, 3), 160, np.uint8)
    for y in range(14, SHAPE[0] - 8, 18):
        for x in range(14, SHAPE[1] - 8, 18):
            centre = (round((x + shift) * 16), y * 16)
            cv2.circle(picture, centre, 3 * 16, (30, 30, 30), -1, cv2.LINE_AA, shift=4)
    return cv2.GaussianBlur(picture, (0, 0), 0.8)


def touched(background: np.ndarray, at_px: int = 107) -> np.ndarray:
    """A bump of light at the centre, or at another x, odd in x as a slope is."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    dx, dy = (x - at_px) / 14, (y - 80) / 14
    shade = 90 * dx * np.exp(-(dx**2 + dy**2) / 2)
    return np.clip(background + shade[..., None] * np.array([1.0, 0.3, -0.7]), 0, 255).astype(np.uint8)


def calibration(background: np.ndarray, mm_per_px: float = 0.1) -> Calibration:
    """Red is a slope along x: n_x = −d_red."""
    weights = np.zeros((1, 3, 2), np.float32)
    weights[0, 0, 0] = -0.4
    return Calibration(
        sensor="x",
        background=background,
        mm_per_px=mm_per_px,
        colours=ColourMap(weights=weights, degree=1, position_degree=0),
        made_from={},
    )


def test_a_bare_gel_gives_depth_and_is_refused_shear() -> None:
    extractor = Extractor(bare(), 0.1, calibration(bare()))
    assert Flag.NO_ZERO_LEVEL in extractor.judged
    fields = extractor.extract(np.stack([bare(), touched(bare()), touched(touched(bare(), 50), 164)]))
    assert fields.depth_mm is not None
    assert fields.depth_mm.shape == fields.contact.shape == (3, *SHAPE)
    assert fields.deformation_mm is fields.shear_mm is None
    assert (fields.flags & np.uint32(Flag.REFUSED)).all()
    assert [bool(f & Flag.NO_CONTACT) for f in fields.flags.tolist()] == [True, False, False]
    assert [bool(f & Flag.SEVERAL_CONTACTS) for f in fields.flags.tolist()] == [False, False, True]
    assert "deformation_mm, shear_mm" in extractor.refused[0]


def test_a_picture_that_leaves_no_gel_untouched_has_no_zero_level() -> None:
    """A gel that slopes everywhere is flagged; one that is pressed in the middle, or not at all, is not."""
    ramp = np.clip(bare() + np.array([25.0, 0.0, 0.0]), 0, 255).astype(np.uint8)  # n_x = 0.16 at every pixel
    fields = Extractor(bare(), 0.1, calibration(bare())).extract(np.stack([bare(), touched(bare()), ramp]))
    assert [bool(f & Flag.NO_ZERO_LEVEL) for f in fields.flags.tolist()] == [False, False, True]
    assert not Extractor(bare(), 0.1).read(ramp).flags[0] & Flag.NO_ZERO_LEVEL  # without depth nothing hangs on it


def test_a_marker_gel_without_calibration_gives_its_motion_and_is_refused_depth() -> None:
    extractor = Extractor(dotted(), 0.1)
    assert extractor.evidence.pattern is Pattern.MARKERS
    assert Flag.NO_ZERO_LEVEL not in extractor.judged
    fields = extractor.extract(np.stack([dotted(), dotted(1.0)]))
    assert fields.depth_mm is fields.shear_mm is None
    assert fields.deformation_mm is not None
    moved = fields.deformation_mm[1]
    np.testing.assert_allclose(np.median(moved, (0, 1)), [0.1, 0.0], atol=0.01)
    assert fields.grid_mm is not None
    window = np.multiply(fields.grid_mm, moved.shape[1::-1])
    np.testing.assert_allclose(window, [0.1 * SHAPE[1], 0.1 * SHAPE[0]], rtol=1e-6)


def test_a_marker_gel_with_calibration_gives_everything() -> None:
    extractor = Extractor(dotted(), 0.1, calibration(dotted()), ExtractConfig(nodes=12))
    assert extractor.refused == ()
    fields = extractor.read(dotted(0.5))
    assert fields.shear_mm is not None
    assert fields.traction_mpa is not None
    assert fields.force_n is not None
    assert fields.shear_mm.shape == fields.deformation_mm.shape == (1, 9, 12, 2)  # type: ignore[union-attr]
    noisy = Extractor(dotted(), 0.1, calibration(dotted()), ExtractConfig(nodes=12, shear="subtracted"))
    subtracted = noisy.read(dotted(0.5)).shear_mm
    assert not np.allclose(subtracted, fields.shear_mm, atol=1e-3)  # type: ignore[arg-type]
    np.testing.assert_allclose(subtracted, fields.deformation_mm, atol=1e-3)  # type: ignore[arg-type]


def test_a_still_is_read_as_if_no_other_had_been() -> None:
    """Of 18 px a pitch: after a motion of 8 px one of 14 px is that, and otherwise one of −4 px."""
    extractor, stills = Extractor(dotted(), 0.1), np.stack([dotted(8.0), dotted(14.0)])
    alone = [Extractor(dotted(), 0.1).extract(still[None]).deformation_mm for still in stills]
    np.testing.assert_array_equal(extractor.extract(stills).deformation_mm, np.concatenate(alone))  # type: ignore[arg-type]


def test_what_does_not_fit_together_is_refused() -> None:
    refused(CalibrationError, "must be equal; calibrate", lambda: Extractor(bare(), 0.2, calibration(bare())))
    refused(CalibrationError, "mm_per_px is 1.0: must lie in", calibration, bare(), 1.0)
    refused(SchemaError, "background", calibration, bare().astype(np.float32))
    refused(ValueError, "mm_per_px is 0: must be > 0", DeformationReader, dotted(), 0)
    contact, flags = np.zeros((2, 4, 5), bool), np.zeros(2, np.uint32)
    wrong = np.zeros((2, 4, 6), np.float32)
    refused(SchemaError, "depth_mm", Fields, contact=contact, flags=flags, mm_per_px=0.1, depth_mm=wrong)
    wrong = np.zeros((2, 3, 3, 2), np.float32)
    refused(SchemaError, "grid_mm is None", Fields, contact=contact, flags=flags, mm_per_px=0.1, shear_mm=wrong)
    with pytest.raises(SchemaError, match=r"shape \[80, 214, 3\]: must be \[160, 214, 3\]"):
        Extractor(bare(), 0.1).read(bare()[:80])


@pytest.mark.parametrize("change", [lambda p: p[..., ::-1], lambda p: (p * 0.8).astype(np.uint8), lambda p: p + 16])
def test_a_gel_unlike_that_of_the_calibration_is_named(change) -> None:
    """Swapped channels, less light, another unit; 14 grey levels are drift."""
    rest = np.broadcast_to(np.array([80, 110, 140], np.uint8), bare().shape).copy()
    with pytest.warns(OtherGelWarning, match="differs from that of the calibration by (16|28|60) grey levels"):
        Extractor(change(rest), 0.1, calibration(rest))
    Extractor(rest + np.uint8(14), 0.1, calibration(rest))


def test_a_calibration_is_read_back_and_a_changed_one_is_refused(tmp_path: pathlib.Path) -> None:
    made, path = calibration(dotted()), tmp_path / "c.npz"
    made.save(path)
    (plain := path.with_name("plain")).touch()
    assert path.stat().st_mode == plain.stat().st_mode  # others of a laboratory read what they may read
    assert Calibration.load(path).hash == made.hash
    arrays = dict(np.load(path))
    signed = [{"plain": np.array(str(arrays["plain"]).replace(made.hash, by * 16))} for by in "0f"]
    for change in (*signed, {"weights": 2 * arrays["weights"]}):
        np.savez(path, **arrays | change)
        refused(CalibrationError, "its hash is", Calibration.load, path)
    path.write_text("no zip")
    refused(CalibrationError, "is no calibration", Calibration.load, path)


def test_a_gap_is_flagged_and_a_still_is_not() -> None:
    extractor = Extractor(dotted(), 0.1)
    far = dotted(11.0)
    found = [extractor.read(dotted()), extractor.read(far, gap=True), extractor.read(far, apart=True)]
    assert [bool(f.flags[0] & Flag.TIME_GAP) for f in found] == [False, True, False]
    assert not (extractor.extract(np.stack([dotted()] * 5)).flags & np.uint32(Flag.TIME_GAP)).any()


def test_pictures_are_read_by_number_and_sizes_must_agree(tmp_path: pathlib.Path) -> None:
    for name, side in (("2", 8), ("10", 8)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((side, side, 3), int(name), np.uint8))
    found = read_pictures([tmp_path], "x")
    assert found.names == ("2.png", "10.png")
    assert found.frames[:, 0, 0, 0].tolist() == [2, 10]
    assert found.apart.all()
    assert not found.gap.any()
    assert found.chosen(np.array([1])).names == ("10.png",)
    cv2.imwrite(str(tmp_path / "3.png"), np.zeros((9, 8, 3), np.uint8))
    refused(SourceError, "different sizes", read_pictures, [tmp_path], "x")
    (tmp_path / "4.webm").touch()
    refused(SourceError, "4.webm: must be one kind", read_pictures, [tmp_path], "x")
    refused(SourceError, "4.webm does not open as a video", read_pictures, [tmp_path / "4.webm"], "x")


def test_what_is_no_picture_is_refused(tmp_path: pathlib.Path) -> None:
    (tmp_path / "a.png").write_text("no picture")
    refused(SourceError, "does not open as a picture: must be a whole picture", read_pictures, [tmp_path], "x")
    refused(SourceError, "is absent", read_pictures, [tmp_path / "none.png"], "x")
    cv2.imwrite(str(tmp_path / "a.png"), np.random.default_rng(0).integers(0, 255, (40, 40, 3), np.uint8))
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:-200])
    refused(SourceError, "is cut off", read_pictures, [tmp_path], "x")
    for lost in ("contacts-00000.arrayrecord", ".journals"):  # pictures next to records are not the recorded ones
        (tmp_path / lost / "backgrounds").mkdir(parents=True)
        (tmp_path / lost / lost).mkdir()
        refused(MissingIndexError, "has no index.json", read_pictures, [tmp_path / lost], "x")
        refused(MissingIndexError, "has no index.json", getattr, source_of(tmp_path / lost), "identity")
