"""Recordings to replay: folders of pictures, videos, records, and what the Tac3D software saves."""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Iterator, Mapping
from typing import Protocol

import cv2
import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.devices import tac3d_messages
from sensors_io.devices.base import Identity
from sensors_io.devices.errors import DeviceDataError, DeviceNotFoundError, StreamEndedError
from sensors_io.errors import path_text
from sensors_io.importers.pictures import PictureError, below, read_picture
from sensors_io.importers.video import is_cut_off
from sensors_io.index import looks_like_records
from sensors_io.records import RecordStore
from sensors_io.schema import FRAME_ARRAYS, Flag, Sequence

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Recorded:
    """One sample of a recording: its time since the first one, the device's counter, what it holds."""

    time_ns: int
    index: int | None
    frame: np.ndarray | None
    arrays: Mapping[str, np.ndarray]


class SampleSource(Protocol):
    """A recording that can be read from its beginning any number of times."""

    @property
    def identity(self) -> Identity:
        """The device that recorded it."""
        ...

    def samples(self) -> Iterator[Recorded]:
        """All samples in order; their times rise from 0."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class PictureFolder:
    """All pictures below a folder, in the order of the numbers in their names.

    Args:
      path: the folder.
      rate_hz: at which they are replayed.
      sensor: whose pictures they are.
      kept: decoded pictures that are kept for the next round.
    """

    path: pathlib.Path
    rate_hz: float = 25.0
    sensor: str = "gelsight_mini"
    kept: int = 64

    def __post_init__(self) -> None:
        _require_rate(self.rate_hz)

    @property
    def identity(self) -> Identity:
        return Identity(sensor=self.sensor, product="pictures", where=str(self.path), period_s=1 / self.rate_hz)

    def samples(self) -> Iterator[Recorded]:
        paths = below(self.path, PICTURES)
        if not paths:
            raise DeviceNotFoundError(f"{self.path} holds no picture ({', '.join(PICTURES)}); give another folder")
        for i, path in enumerate(paths):
            frame = self._read(path)
            yield Recorded(time_ns=round(i * NS_PER_S / self.rate_hz), index=i, frame=frame, arrays={})

    @functools.cached_property
    def _read(self) -> Callable[[pathlib.Path], np.ndarray]:
        return functools.lru_cache(self.kept)(_read_picture)


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoFile:
    """The frames of a video file, at its own times; at its rate where its stamps do not rise."""

    path: pathlib.Path
    sensor: str = "gelsight_mini"

    @property
    def identity(self) -> Identity:
        return Identity(sensor=self.sensor, product="video", where=str(self.path), period_s=1 / self._rate_hz)

    @functools.cached_property
    def _rate_hz(self) -> float:
        capture = self._open()
        rate = float(capture.get(cv2.CAP_PROP_FPS))
        capture.release()
        if not 0 < rate <= NS_PER_S:
            raise DeviceNotFoundError(
                f"{self.path} states {rate:g} frames a second: must lie in (0, 10⁹]; write it anew with its true rate"
            )
        return rate

    def samples(self) -> Iterator[Recorded]:
        capture = self._open()
        try:
            count = time_ns = 0
            first_ms = last = 0.0
            stated = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
            while capture.grab():
                ok, image = capture.retrieve()
                if not ok:
                    break
                stamp_ms, last = capture.get(cv2.CAP_PROP_POS_MSEC), capture.get(cv2.CAP_PROP_PTS)
                if count == 0:
                    first_ms = stamp_ms
                else:
                    own_ns = round((stamp_ms - first_ms) * 1e6)
                    time_ns = own_ns if own_ns > time_ns else round(time_ns + NS_PER_S / self._rate_hz)
                yield Recorded(time_ns=time_ns, index=count, frame=cv2.cvtColor(image, cv2.COLOR_BGR2RGB), arrays={})
                count += 1
        finally:
            capture.release()
        if is_cut_off(self.path, stated, count, self._rate_hz, last):
            raise StreamEndedError(
                f"{self.path} is cut off: {count} of {max(stated, count + 1)} frames could be decoded and were "
                "replayed; put a whole copy back"
            )

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(path_text(self.path))
        if not capture.isOpened():
            raise DeviceNotFoundError(f"{self.path} does not open as a video; give another file")
        return capture


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordedContact:
    """One sequence of a data set, with all of its arrays.

    Args:
      path: directory of the records.
      contact: its number in the data set.
      sensor: which of the sensors that saw it.
    """

    path: pathlib.Path
    contact: int = 0
    sensor: str = "gelsight_mini"

    @property
    def identity(self) -> Identity:
        s = self._sequence
        period = float(np.median(np.diff(s.host_time_ns))) / NS_PER_S if len(s) > 1 else 0.0
        return Identity(
            sensor=s.sensor,
            serial=s.serial,
            product="records",
            where=str(self.path),
            settings=s.camera,
            period_s=period or None,
            mm_per_px=s.mm_per_px,
        )

    @functools.cached_property
    def _sequence(self) -> Sequence:
        store = RecordStore(self.path, allow_incomplete=True)
        if self.contact >= len(store):
            raise DeviceNotFoundError(
                f"{self.path}: contact is {self.contact}: must be < {len(store)}, the contacts there; name one of them"
            )
        contact = store.contact(self.contact)
        if self.sensor not in contact:
            raise DeviceNotFoundError(
                f"{self.path}: contact {self.contact} was seen by {', '.join(contact)}, not {self.sensor!r}; "
                "name one of these"
            )
        sequence = contact[self.sensor]
        times = _rising(sequence.host_time_ns, f"{self.path}: contact {self.contact}", "ns")
        return dataclasses.replace(sequence, host_time_ns=times)

    def samples(self) -> Iterator[Recorded]:
        s = self._sequence
        known = {n: a for n in FRAME_ARRAYS if n not in ("frames", "host_time_ns") and (a := getattr(s, n)) is not None}
        numbers = frame_numbers(s).tolist()
        for i, time in enumerate(s.host_time_ns - s.host_time_ns[0]):
            frame = None if s.frames is None else s.frames[i]
            arrays = {name: a[i] for name, a in known.items()}
            yield Recorded(time_ns=int(time), index=numbers[i], frame=frame, arrays=arrays)


def frame_numbers(sequence: Sequence) -> np.ndarray:
    """Counter of the frames of a sequence, int64 [N]; it skips those lost before a frame flagged `TIME_GAP`."""
    steps = np.diff(sequence.host_time_ns)
    periods = np.rint(steps / max(float(np.median(steps)), 1.0)) if len(steps) else steps
    lost = (sequence.flags[1:] & np.uint32(Flag.TIME_GAP)) > 0
    return np.cumsum([0, *np.where(lost, np.maximum(periods, 1), 1)]).astype(np.int64)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tac3dRecording:
    """A recording saved by the Tac3D software: a folder of .npy files, or the same arrays in one .npz.

    Times are those of the sensor's host, the counter is the sensor's, with its real gaps.
    """

    path: pathlib.Path

    @property
    def identity(self) -> Identity:
        _ = self._recorded  # read now: a reader takes what is raised later for a broken sample
        return Identity(sensor="tac3d", serial=self.path.stem, product="Tac3D recording", where=str(self.path))

    @functools.cached_property
    def _recorded(self) -> tac3d_messages.Tac3dArrays:
        try:
            recorded = tac3d_messages.load_recording(self.path)
            tac3d_messages.to_schema({name: a[0] for name, a in recorded.matrices.items()})
        except DeviceDataError as error:
            raise DeviceNotFoundError(str(error)) from error
        times = _rising(recorded.send_time_s, f"{self.path}: sendTimestamp", "s")
        return dataclasses.replace(recorded, send_time_s=times)

    def samples(self) -> Iterator[Recorded]:
        recorded = self._recorded
        start = recorded.send_time_s[0]
        for i, index in enumerate(recorded.index):
            fields = tac3d_messages.to_schema({name: a[i] for name, a in recorded.matrices.items()})
            time_ns = round((recorded.send_time_s[i] - start) * NS_PER_S)
            yield Recorded(time_ns=time_ns, index=int(index), frame=None, arrays=fields)


def _rising(times: np.ndarray, where: str, unit: str) -> np.ndarray:
    """Times [N], where one that runs back, as of two messages that were swapped, is the latest before it.

    Raises:
      DeviceNotFoundError: the last is not after the first.
    """
    if len(times) > 1 and not times[-1] > times[0]:
        raise DeviceNotFoundError(
            f"{where}: row {len(times) - 1} has {times[-1]} {unit}, row 0 {times[0]} {unit}: the last must be after "
            "the first; replay another recording"
        )
    return np.maximum.accumulate(times)


def _read_picture(path: pathlib.Path) -> np.ndarray:
    """RGB uint8, or the counts of a depth camera, uint16."""
    image = cv2.imread(path_text(path), cv2.IMREAD_UNCHANGED)
    if image is not None and image.ndim == 2 and image.dtype == np.uint16:
        return image
    try:
        return read_picture(path)
    except PictureError as error:
        raise DeviceNotFoundError(
            f"{path} cannot be decoded as a picture ({error}); take it out of the folder"
        ) from error


def _require_rate(rate_hz: float) -> None:
    if not rate_hz > 0:
        raise ValueError(f"rate_hz is {rate_hz}: must be > 0; give the rate of the recording")


def source_of(
    path: pathlib.Path, *, sensor: str = "gelsight_mini", rate_hz: float = 25.0, contact: int = 0
) -> SampleSource:
    """The recording at a path: records, what the Tac3D software saves, a video, or a folder of pictures.

    Args:
      path: of a directory or a file.
      sensor: whose pictures they are, where the recording does not say.
      rate_hz: of pictures.
      contact: number of the contact, of records.

    Raises:
      DeviceNotFoundError: there is nothing that can be replayed.
    """
    if not path.exists():
        raise DeviceNotFoundError(f"{path} does not exist; give a recording")
    if looks_like_records(path):
        return RecordedContact(path=path, contact=contact, sensor=sensor)
    if path.suffix == ".npz" or (path / "index.npy").is_file():
        return Tac3dRecording(path=path)
    if path.is_file():
        return VideoFile(path=path, sensor=sensor)
    return PictureFolder(path=path, rate_hz=rate_hz, sensor=sensor)
