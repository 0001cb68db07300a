"""Lossless codecs of camera frames behind one interface, and their size, rates and exactness on some clips."""

import dataclasses
import struct
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from array_record.python.array_record_module import ArrayRecordReader, ArrayRecordWriter

from experiments.core.context import Context
from experiments.core.timing import interleaved
from sensors_io.deltas import FILTERS, accumulate, choose_filter, difference

Clips = Sequence[np.ndarray]
"""Sequences of frames, uint8 [N, H, W, 3] each."""

_SHAPE = struct.Struct("<4I16s")  # N, H, W, 3 and the name of a filter


@dataclasses.dataclass(frozen=True, kw_only=True)
class Codec:
    """A way to keep clips.

    Args:
      name: of one point of the chart.
      kind: what it is a variant of.
      store: writes clips into a folder.
      load: reads them again.
    """

    name: str
    kind: str
    store: Callable[[Clips, Path], None]
    load: Callable[[Path], list[np.ndarray]]


def all_codecs() -> tuple[Codec, ...]:
    """Every codec, the records' own one under `OWN`."""
    return (
        _entries("raw", "raw", "uncompressed", _plain, _unplain),
        *(_entries(f"zstd-{n}", "zstd", f"zstd:{n}", _plain, _unplain) for n in (1, 3, 9)),
        _entries("brotli-3", "other", "brotli:3", _plain, _unplain),
        _entries("snappy", "other", "snappy", _plain, _unplain),
        *(_entries(f"shuffle zstd-{n}", "shuffle + zstd", f"zstd:{n}", _planes, _unplanes) for n in (1, 3)),
        *(_entries(f"{d} zstd-1", "difference + zstd", "zstd:1", *_differences(d)) for d in _FIXED),
        _entries("columns zstd-1", "difference + zstd", "zstd:1", _columns, _uncolumns),
        _entries(OWN, "chosen difference + zstd", "zstd:1", _chosen, _unchosen),
        _entries("chosen zstd-3", "chosen difference + zstd", "zstd:3", _chosen, _unchosen),
        *(_pictures(f"PNG-{n}", "PNG", ".png", (cv2.IMWRITE_PNG_COMPRESSION, n)) for n in (1, 3, 6)),
        _pictures("WebP", "WebP", ".webp", (cv2.IMWRITE_WEBP_QUALITY, 101)),  # above 100 is lossless
        _video("HuffYUV", "HFYU", ".avi"),
        _video("FFV1", "FFV1", ".mkv"),
    )


OWN, PLAIN = "chosen zstd-1", "zstd-1"
"""Codec of the records, and that of their version 1."""

_FIXED = ("time", "rows", "time+rows")


def stored_bytes(folder: Path) -> int:
    """Size of everything in a folder."""
    return sum(file.stat().st_size for file in folder.iterdir())


def _entries(
    name: str,
    kind: str,
    options: str,
    encode: Callable[[np.ndarray], bytes],
    decode: Callable[[bytes], np.ndarray],
) -> Codec:
    """One entry per clip in an ArrayRecord file, as records are kept."""

    def store(clips: Clips, folder: Path) -> None:
        writer = ArrayRecordWriter(str(folder / "clips.arrayrecord"), f"group_size:1,{options}")
        for clip in clips:
            writer.write(encode(clip))
        writer.close()

    def load(folder: Path) -> list[np.ndarray]:
        reader = ArrayRecordReader(str(folder / "clips.arrayrecord"))
        clips = [decode(reader.read([i])[0]) for i in range(reader.num_records())]
        reader.close()
        return clips

    return Codec(name=name, kind=kind, store=store, load=load)


def _header(clip: np.ndarray, note: str = "") -> bytes:
    return _SHAPE.pack(*clip.shape, note.encode())


def _parts(data: bytes) -> tuple[np.ndarray, str, tuple[int, ...]]:
    *shape, note = _SHAPE.unpack_from(data)
    return np.frombuffer(data, np.uint8, offset=_SHAPE.size), note.rstrip(b"\0").decode(), tuple(shape)


def _plain(clip: np.ndarray) -> bytes:
    return _header(clip) + clip.tobytes()


def _unplain(data: bytes) -> np.ndarray:
    values, _, shape = _parts(data)
    return values.reshape(shape)


def _planes(clip: np.ndarray) -> bytes:
    """Blosc's byte shuffle for pixels of three bytes: all first bytes, all second, all third."""
    return _header(clip) + np.moveaxis(clip, -1, 0).tobytes()


def _unplanes(data: bytes) -> np.ndarray:
    values, _, shape = _parts(data)
    return np.ascontiguousarray(np.moveaxis(values.reshape(3, *shape[:3]), 0, -1))


def _differences(name: str) -> tuple[Callable[[np.ndarray], bytes], Callable[[bytes], np.ndarray]]:
    """A fixed filter of `sensors_io.deltas`."""
    return lambda clip: _header(clip, name) + difference(clip, name).tobytes(), _unchosen


def _chosen(clip: np.ndarray) -> bytes:
    """The filter that the clip wants, as in records."""
    name = choose_filter(clip)
    return _header(clip, name) + difference(clip, name).tobytes()


def _unchosen(data: bytes) -> np.ndarray:
    values, name, shape = _parts(data)
    return accumulate(values.reshape(shape), name)


def _columns(clip: np.ndarray) -> bytes:
    """Each pixel less the one to its left."""
    residual = clip.copy()
    residual[:, :, 1:] -= clip[:, :, :-1]
    return _header(clip) + residual.tobytes()


def _uncolumns(data: bytes) -> np.ndarray:
    values, _, shape = _parts(data)
    return np.cumsum(values.reshape(shape), axis=2, dtype=np.uint8)


def _pictures(name: str, kind: str, suffix: str, settings: tuple[int, int]) -> Codec:
    """Each frame as a picture, behind its length."""

    def encode(clip: np.ndarray) -> bytes:
        pictures = [cv2.imencode(suffix, frame, settings)[1].tobytes() for frame in clip]
        return b"".join(struct.pack("<I", len(picture)) + picture for picture in pictures)

    def decode(data: bytes) -> np.ndarray:
        frames: list[np.ndarray] = []
        start = 0
        while start < len(data):
            (length,) = struct.unpack_from("<I", data, start)
            frame = cv2.imdecode(np.frombuffer(data, np.uint8, length, start + 4), cv2.IMREAD_COLOR)
            if frame is None:
                raise RuntimeError(f"a stored {kind} picture of {length} bytes does not open")
            frames.append(frame)
            start += 4 + length
        return np.stack(frames)

    return _entries(name, kind, "uncompressed", encode, decode)


def _video(name: str, fourcc: str, suffix: str) -> Codec:
    """Each clip as a video file."""

    def store(clips: Clips, folder: Path) -> None:
        for n, clip in enumerate(clips):
            size = clip.shape[2], clip.shape[1]
            writer = cv2.VideoWriter(str(folder / f"{n:04d}{suffix}"), cv2.VideoWriter.fourcc(*fourcc), 30.0, size)
            if not writer.isOpened():
                raise RuntimeError(f"OpenCV cannot write {fourcc} here: its build needs FFmpeg with that encoder")
            for frame in clip:
                writer.write(frame)
            writer.release()

    def load(folder: Path) -> list[np.ndarray]:
        return [_decode(cv2.VideoCapture(str(file))) for file in sorted(folder.iterdir())]

    return Codec(name=name, kind="video", store=store, load=load)


def _decode(capture: cv2.VideoCapture) -> np.ndarray:
    frames = []
    while True:
        ok, frame = capture.read()
        if not ok:
            break
        frames.append(frame)
    capture.release()
    return np.stack(frames) if frames else np.empty((0, 0, 0, 3), np.uint8)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CodecMeasurement:
    """One codec on some clips: bytes a frame, frames a second written and read, whether all bits came back."""

    codec: Codec
    bytes: float
    write_fps: float
    read_fps: float
    exact: bool


def measure(
    codecs: Sequence[Codec], clips: Clips, rounds: int, context: Context
) -> tuple[list[CodecMeasurement], dict[str, str]]:
    """Every codec over the same clips, in turn within each round; and why a codec is missing, by name.

    Args:
      codecs: what to measure.
      clips: what they store.
      rounds: of timing; rates are medians.
      context: shows how far it is.
    """
    frames = sum(map(len, clips))
    with tempfile.TemporaryDirectory() as root:
        folders = {codec.name: Path(root) / str(n) for n, codec in enumerate(codecs)}
        present, exact, missing = [], {}, {}
        for codec in context.each("codecs", codecs):
            folders[codec.name].mkdir()
            try:
                codec.store(clips, folders[codec.name])
            except RuntimeError as error:
                missing[codec.name] = str(error)
                continue
            exact[codec.name] = _same(codec.load(folders[codec.name]), clips)
            present.append(codec)
        calls: dict[str, Callable[[], Any]] = {}
        for codec in present:
            calls[f"write {codec.name}"] = _bind(codec.store, clips, folders[codec.name])
            calls[f"read {codec.name}"] = _bind(codec.load, folders[codec.name])
        timed = interleaved(calls, context.rounds("timing codecs", rounds))
        seconds = {name: float(np.median(s)) for name, s in timed.items()}
        rows = [
            CodecMeasurement(
                codec=codec,
                bytes=stored_bytes(folders[codec.name]) / frames,
                write_fps=frames / seconds[f"write {codec.name}"],
                read_fps=frames / seconds[f"read {codec.name}"],
                exact=exact[codec.name],
            )
            for codec in present
        ]
    return rows, missing


def front(rows: Sequence[CodecMeasurement]) -> list[CodecMeasurement]:
    """Those that no other one beats in size and in read rate, by size."""
    ordered = sorted(rows, key=lambda row: (row.bytes, -row.read_fps))
    best, kept = 0.0, []
    for row in ordered:
        if row.read_fps > best:
            kept.append(row)
            best = row.read_fps
    return kept


def chosen_filters(clips: Iterable[np.ndarray]) -> dict[str, int]:
    """Number of clips for which each filter is chosen."""
    names = [choose_filter(clip) for clip in clips]
    return {name: names.count(name) for name in FILTERS}


def _bind(call: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    return lambda: call(*arguments)


def _same(loaded: Sequence[np.ndarray], clips: Clips) -> bool:
    return len(loaded) == len(clips) and all(map(np.array_equal, loaded, clips))
