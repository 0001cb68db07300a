"""Lossless codecs of camera frames behind one interface, and their size, rates and exactness on some clips."""

import dataclasses
import functools
import itertools
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

Clips = Sequence[np.ndarray]  # sequences of frames, uint8 [N, H, W, 3] each

_SHAPE = struct.Struct("<4I16s")  # N, H, W, 3 and the name of a filter


@dataclasses.dataclass(frozen=True, kw_only=True)
class Codec:
    """Functions that write clips into a folder and read them again; `kind` groups variants in the chart."""

    name: str
    kind: str
    store: Callable[[Clips, Path], None]
    load: Callable[[Path], list[np.ndarray]]


OWN, PLAIN = "chosen zstd-1", "zstd-1"  # codec of the records, and that of their version 1

Transform = tuple[Callable[[np.ndarray, str], np.ndarray], Callable[[np.ndarray, tuple[int, ...], str], np.ndarray]]
"""Clip and filter → array to store; flat values, shape of the clip and filter → clip."""


def all_codecs() -> tuple[Codec, ...]:
    """Every codec, the records' own one under `OWN`."""
    return (
        _arrays("raw", "raw", "uncompressed", _UNCHANGED),
        *(_arrays(f"zstd-{n}", "zstd", f"zstd:{n}", _UNCHANGED) for n in (1, 3, 9)),
        _arrays("brotli-3", "other", "brotli:3", _UNCHANGED),
        _arrays("snappy", "other", "snappy", _UNCHANGED),
        *(_arrays(f"shuffle zstd-{n}", "shuffle + zstd", f"zstd:{n}", _PLANES) for n in (1, 3)),
        *(_arrays(f"{d} zstd-1", "difference + zstd", "zstd:1", _DELTAS, d) for d in ("time", "rows", "time+rows")),
        _arrays("columns zstd-1", "difference + zstd", "zstd:1", _COLUMNS),
        _arrays(OWN, "chosen difference + zstd", "zstd:1", _DELTAS, choose_filter),
        _arrays("chosen zstd-3", "chosen difference + zstd", "zstd:3", _DELTAS, choose_filter),
        *(_pictures(f"PNG-{n}", "PNG", ".png", (cv2.IMWRITE_PNG_COMPRESSION, n)) for n in (1, 3, 6)),
        _pictures("WebP", "WebP", ".webp", (cv2.IMWRITE_WEBP_QUALITY, 101)),  # above 100 is lossless
        _video("HuffYUV", "HFYU", ".avi"),
        _video("FFV1", "FFV1", ".mkv"),
    )


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


def _arrays(
    name: str, kind: str, options: str, transform: Transform, filter_of: str | Callable[[np.ndarray], str] = ""
) -> Codec:
    """Entries of transformed clips, behind their shape and filter, one filter for all or one chosen for each clip."""
    forward, backward = transform

    def encode(clip: np.ndarray) -> bytes:
        chosen = filter_of if isinstance(filter_of, str) else filter_of(clip)
        return _SHAPE.pack(*clip.shape, chosen.encode()) + forward(clip, chosen).tobytes()

    def decode(data: bytes) -> np.ndarray:
        *shape, chosen = _SHAPE.unpack_from(data)
        values = np.frombuffer(data, np.uint8, offset=_SHAPE.size)
        return backward(values, tuple(shape), chosen.rstrip(b"\0").decode())

    return _entries(name, kind, options, encode, decode)


_UNCHANGED: Transform = (lambda clip, _: clip, lambda flat, shape, _: flat.reshape(shape))
_DELTAS: Transform = (difference, lambda flat, shape, name: accumulate(flat.reshape(shape), name))
_COLUMNS: Transform = (  # each pixel less the one to its left
    lambda clip, _: np.diff(clip, axis=2, prepend=np.uint8(0)),
    lambda flat, shape, _: np.cumsum(flat.reshape(shape), axis=2, dtype=np.uint8),
)
_PLANES: Transform = (  # Blosc's byte shuffle for pixels of three bytes: all first bytes, all second, all third
    lambda clip, _: np.moveaxis(clip, -1, 0),
    lambda flat, shape, _: np.ascontiguousarray(np.moveaxis(flat.reshape(3, *shape[:3]), 0, -1)),
)


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
        clips = []
        for file in sorted(folder.iterdir()):
            capture = cv2.VideoCapture(str(file))
            read = (capture.read()[1] for _ in itertools.count())
            frames = list(itertools.takewhile(lambda frame: frame is not None, read))
            capture.release()
            clips.append(np.stack(frames) if frames else np.empty((0, 0, 0, 3), np.uint8))
        return clips

    return Codec(name=name, kind="video", store=store, load=load)


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
    """Every codec over the same clips, in interleaved rounds of timing; and why a codec is missing, by name."""
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
            loaded = codec.load(folders[codec.name])
            exact[codec.name] = len(loaded) == len(clips) and all(map(np.array_equal, loaded, clips))
            present.append(codec)
        calls: dict[str, Callable[[], Any]] = {}
        for codec in present:
            calls[f"write {codec.name}"] = functools.partial(codec.store, clips, folders[codec.name])
            calls[f"read {codec.name}"] = functools.partial(codec.load, folders[codec.name])
        timed = interleaved(calls, context.rounds("timing codecs", rounds))
        seconds = {name: float(np.median(s)) for name, s in timed.items()}
        rows = [
            CodecMeasurement(
                codec=codec,
                bytes=sum(file.stat().st_size for file in folders[codec.name].iterdir()) / frames,
                write_fps=frames / seconds[f"write {codec.name}"],
                read_fps=frames / seconds[f"read {codec.name}"],
                exact=exact[codec.name],
            )
            for codec in present
        ]
    return rows, missing


def chosen_filters(clips: Iterable[np.ndarray]) -> dict[str, int]:
    """Number of clips that choose each filter."""
    names = [choose_filter(clip) for clip in clips]
    return {name: names.count(name) for name in FILTERS}
