"""Records with pictures and extracted fields: what is written, what is refused, how a killed extraction goes on."""

import dataclasses
import functools
import pathlib
import shutil

import cv2
import numpy as np
import pytest

from sensors_io.codec import encode_sequence
from sensors_io.contents import put_rest_pictures, rest_pictures
from sensors_io.errors import UserError
from sensors_io.fields import extracted_records
from sensors_io.fields.extract import ExtractConfig, Extractor
from sensors_io.fields.extracted_records import FieldsJob, write_extracted
from sensors_io.fields.recorded import RecordedGels, RestGel, recorded_fields
from sensors_io.fields.sources import read_pictures
from sensors_io.fields.types import CalibrationError
from sensors_io.quality import QualityConfig
from sensors_io.records import RecordsExistError, RecordStore, RecordWriter
from sensors_io.schema import Flag
from tests.sensors_io import fakes
from tests.sensors_io.checks import refused
from tests.sensors_io.fields.test_extract import SHAPE, bare, calibration, dotted, touched

CALIBRATION = dataclasses.replace(calibration(bare()), sensor="gelsight_mini")
BARE = {"deformation_mm": None, "depth_mm": None, "valid": None, "force_n": None, "contact_region_px": None}


def recorded(n: int = 0, trial: int = 0, background: np.ndarray | None = None, **changes):
    """Three pictures of a Mini, the first one untouched, without fields."""
    rest = bare() if background is None else background
    frames = np.stack([rest, touched(rest), touched(rest)])
    return fakes.sequence(n, length=3, trial=trial, **BARE | {"mm_per_px": 0.1, "frames": frames} | changes)


def written(path: pathlib.Path, contacts: int = 3, **changes) -> pathlib.Path:
    with RecordWriter(path, meta=fakes.META) as writer:
        writer.write_object(fakes.card(0))
        for trial in range(contacts):
            other = fakes.sequence(0, "xense", length=3, trial=trial)
            writer.write_contact([recorded(trial=trial, **changes), other])
    return path


def job(records: pathlib.Path, **changes) -> FieldsJob:
    values = {
        "records": records,
        "sensor": "gelsight_mini",
        "gel": RestGel(background=bare()),
        "calibration": CALIBRATION,
        "config": ExtractConfig(),
    }
    return FieldsJob(**values | changes)


def test_a_frame_is_followed_from_the_one_before_it_in_its_recording():
    """Also when the recording is read again: its first frame follows none."""
    extractor, frames = Extractor(dotted(), 0.1), np.stack([dotted(8.0), dotted(8.0), dotted(14.0)])
    for _ in range(2):
        moved = recorded_fields(recorded(frames=frames), extractor).deformation_mm
        np.testing.assert_allclose(np.median(moved[..., 0], (1, 2)), [0.8, 0.8, 1.4], atol=0.02)


@pytest.mark.parametrize(("periods", "late"), [(1.8, [False, False, True]), (2.5, [False, False, False])])
def test_gaps_are_of_the_periods_that_the_config_says(tmp_path, periods, late):
    config = ExtractConfig(quality=QualityConfig(gap_periods=periods))
    times = np.cumsum([0, 40, 40, 80], dtype=np.int64) * 1_000_000
    frames = np.stack([bare()] * 4)
    made = fakes.sequence(0, length=4, **BARE | {"mm_per_px": 0.1, "frames": frames, "host_time_ns": times})
    found = recorded_fields(made, Extractor(bare(), 0.1, config=config)).flags & np.uint32(Flag.TIME_GAP)
    assert found.astype(bool).tolist() == [False, *late]
    with RecordWriter(tmp_path, meta=fakes.META) as writer:
        writer.write_object(fakes.card(0))
        writer.write_contact([made])
    assert read_pictures([tmp_path], made.sensor, config.quality).gap.tolist() == [False, *late]


def test_fields_lie_beside_the_pictures(tmp_path):
    records, out = written(tmp_path / "records"), tmp_path / "fields"
    put_rest_pictures(records, {"rest.png": b"a picture"})
    write_extracted(job(records, rows=SHAPE[0] // 2), out)
    before, after = RecordStore(records), RecordStore(out)
    assert after.contacts == before.contacts
    assert rest_pictures(out) == {"rest.png": b"a picture"}
    assert after.objects["object_0"].labels == before.objects["object_0"].labels
    old, new = before.contact(1), after.contact(1)
    assert encode_sequence(old["xense"]) == encode_sequence(new["xense"])
    np.testing.assert_array_equal(old["gelsight_mini"].frames, new["gelsight_mini"].frames)
    mini = new["gelsight_mini"]
    write_extracted(job(records, rows=10**6), tmp_path / "large")  # never enlarged
    assert RecordStore(tmp_path / "large").contact(1)["gelsight_mini"].depth_mm.shape[1:] == SHAPE
    whole = Extractor(bare(), 0.1, CALIBRATION).extract(mini.frames).depth_mm
    halved = np.stack([cv2.resize(d, (SHAPE[1] // 2, SHAPE[0] // 2), interpolation=cv2.INTER_AREA) for d in whole])
    np.testing.assert_allclose(mini.depth_mm, halved, atol=5e-4)
    assert (mini.deformation_mm, mini.force_n, mini.calibration) == (None, None, CALIBRATION.hash)
    assert not (mini.flags & np.uint32(Flag.REFUSED)).any()
    assert [bool(f & Flag.NO_CONTACT) for f in mini.flags.tolist()] == [True, False, False]


def test_a_gel_with_markers_gives_all_fields_and_an_estimated_force(tmp_path):
    frames = np.stack([dotted(), dotted(1.0), dotted(2.0)])
    records = written(tmp_path / "records", 1, frames=frames)
    made = dataclasses.replace(CALIBRATION, background=dotted())
    coarse = {"gel": RestGel(rest_frames=1), "calibration": made, "config": ExtractConfig(nodes=6)}
    write_extracted(job(records, **coarse), tmp_path / "out")
    mini = RecordStore(tmp_path / "out").contact(0)["gelsight_mini"]
    assert mini.depth_mm.shape == (3, *SHAPE)
    assert mini.deformation_mm.shape == mini.shear_mm.shape == (3, *SHAPE, 2)
    assert np.median(mini.deformation_mm[2, ..., 0]) == pytest.approx(0.2, abs=0.02)
    assert (mini.force_n.shape, mini.camera["force_n"]) == ((3, 3), "estimated from the fields")
    measured = written(tmp_path / "measured", 1, frames=frames, force_n=np.full((3, 3), -1.5, np.float32))
    write_extracted(job(measured, **coarse), tmp_path / "kept")
    assert (RecordStore(tmp_path / "kept").contact(0)["gelsight_mini"].force_n == -1.5).all()


def test_the_gel_at_rest_of_other_records_stays(tmp_path):
    """It is written behind the lock and the check, and belongs to what an extraction is known by."""
    records, other = written(tmp_path / "records", 1), written(tmp_path / "other", 1)
    for path, content in ((records, b"a picture"), (other, b"another")):
        put_rest_pictures(path, {"rest.png": content})
    refused(RecordsExistError, "made by config", write_extracted, job(records), other)
    assert rest_pictures(other) == {"rest.png": b"another"}
    write_extracted(job(records), tmp_path / "out")
    put_rest_pictures(records, {"rest.png": b"another"})
    refused(RecordsExistError, "made by config", write_extracted, job(records), tmp_path / "out")
    assert rest_pictures(tmp_path / "out") == {"rest.png": b"a picture"}


def test_an_extraction_of_other_recordings_is_not_continued(tmp_path):
    """Under the same keys and in files of the same size, which is all that the index knows."""
    records = written(tmp_path / "records", 1, force_n=np.full((3, 3), -1.5, np.float32))
    before = RecordStore(records).digest
    write_extracted(job(records), tmp_path / "out")
    shutil.rmtree(records)
    assert RecordStore(written(records, 1, force_n=np.full((3, 3), -2.5, np.float32))).digest == before
    refused(RecordsExistError, "made by config", write_extracted, job(records), tmp_path / "out")


def test_a_contact_without_a_gel_at_rest_costs_no_other(tmp_path):
    lost = {"camera": {"recording": {"background": "gone.png"}}}
    with RecordWriter(tmp_path / "records", meta=fakes.META) as writer:
        writer.write_object(fakes.card(0))
        for trial in range(4):
            writer.write_contact([recorded(trial=trial, **(lost if trial in (0, 2) else {}))])
    skipped = write_extracted(job(tmp_path / "records"), tmp_path / "out", frames_per_shard=3)
    store = RecordStore(tmp_path / "out")
    assert [store.contact(i)["gelsight_mini"].key.trial for i in range(len(store))] == [1, 3]
    assert [skip.name for skip in skipped] == [f"object_0/0/press/{trial}/gelsight_mini" for trial in (0, 2)]
    assert "gone.png is absent" in skipped[0].reason
    assert store.meta.notes["fields"]["skipped"] == [dataclasses.asdict(skip) for skip in skipped]
    assert write_extracted(job(tmp_path / "records"), tmp_path / "out", frames_per_shard=3) == skipped


@pytest.mark.parametrize("when", ["before a part", "after a part"])
def test_an_extraction_that_was_killed_goes_on(tmp_path, monkeypatch, when):
    records = written(tmp_path / "records", 4)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    write_extracted(job(records), whole, frames_per_shard=6)
    make, calls = extracted_records.make_part, []

    def die(*args):
        calls.append(args[1])
        if len(calls) == 3 and when == "before a part":
            raise KeyboardInterrupt
        make(*args)
        if len(calls) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(extracted_records, "make_part", die)
    with pytest.raises(KeyboardInterrupt):
        write_extracted(job(records), killed, frames_per_shard=6)
    assert len(RecordStore(killed, allow_incomplete=True)) == 2
    write_extracted(job(records), killed, frames_per_shard=6)
    assert calls == [0, 1, 2, *([2] if when == "before a part" else []), 3]
    for name in sorted(f.name for f in whole.glob("contacts-*")):
        assert (killed / name).read_bytes() == (whole / name).read_bytes()
    assert RecordStore(killed).complete


def test_what_cannot_be_extracted_is_one_line(tmp_path):
    records, out = written(tmp_path / "records", 1), tmp_path / "out"
    extract = functools.partial(write_extracted, out=out)
    refused(CalibrationError, "no gel at rest was recorded", extract, job(records, gel=RestGel()))
    for inside in (records, records / "fields"):
        refused(CalibrationError, "must not be the records", write_extracted, job(records), inside)
    refused(CalibrationError, "--sensor is 'tac3d'", extract, job(records, sensor="tac3d", calibration=None))
    refused(CalibrationError, "carries no field", extract, job(records, calibration=None))
    refused(CalibrationError, "rows is -1", job, records, rows=-1)
    refused(CalibrationError, "is for 'x'", job, records, calibration=calibration(bare()))
    refused(UserError, "rest_frames is 1", RestGel, background=bare(), rest_frames=1)
    refused(UserError, "mm_per_px is 2", RestGel, mm_per_px=2)
    with_depth = fakes.write(tmp_path / "full", 1, sensors=("gelsight_mini",))
    refused(CalibrationError, "has depth_mm, deformation_mm already", extract, job(with_depth))
    assert not out.exists() or not RecordStore(out, allow_incomplete=True).complete


def test_a_calibration_serves_pictures_of_another_size(tmp_path):
    """Halved pictures of the same window have the same depth; another window, pitch or no pitch is refused."""
    half = tuple(n // 2 for n in SHAPE)
    small = np.stack([cv2.resize(f, half[::-1], interpolation=cv2.INTER_AREA) for f in recorded().frames])
    gels = RecordedGels(tmp_path, RestGel(background=bare()), CALIBRATION)
    halved = recorded(frames=small, mm_per_px=None)
    found = recorded_fields(halved, gels.extractor(halved))
    whole = Extractor(bare(), 0.1, CALIBRATION).extract(recorded().frames).depth_mm[1]
    area = cv2.resize(whole, half[::-1], interpolation=cv2.INTER_AREA)
    assert found.mm_per_px == pytest.approx(0.2)
    assert np.abs(found.depth_mm[1] - area).max() < 0.02 * area.max()
    refused(CalibrationError, "must be equal", gels.extractor, recorded(frames=small, mm_per_px=0.1))
    refused(CalibrationError, "same window", gels.extractor, recorded(frames=small[:, :-10]))
    refused(CalibrationError, "of 'xense': must be equal", gels.extractor, recorded(sensor="xense"))
    lost = {"recording": {"background": "gone.png"}}
    refused(CalibrationError, "gone.png is absent", gels.extractor, recorded(camera=lost))
    own = lambda pitch: RecordedGels(tmp_path, RestGel(rest_frames=1, mm_per_px=pitch))
    refused(CalibrationError, "--mm-per-px", own(None).extractor, recorded(mm_per_px=None))
    assert own(0.2).extractor(recorded(mm_per_px=None)).judged
