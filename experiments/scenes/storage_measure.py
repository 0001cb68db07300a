"""Size, rates and exactness of every codec on some clips."""

import dataclasses
import pathlib
import tempfile
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from experiments.core.context import Context
from experiments.core.timing import interleaved
from experiments.scenes.storage_codecs import Clips, Codec, stored_bytes
from sensors_io.deltas import FILTERS, choose_filter


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
        folders = {codec.name: pathlib.Path(root) / str(n) for n, codec in enumerate(codecs)}
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
    """How many clips want each filter."""
    names = [choose_filter(clip) for clip in clips]
    return {name: names.count(name) for name in FILTERS}


def _bind(call: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    return lambda: call(*arguments)


def _same(loaded: Sequence[np.ndarray], clips: Clips) -> bool:
    return len(loaded) == len(clips) and all(map(np.array_equal, loaded, clips))
