"""Size against rates, one chart per kind of clips."""

from collections.abc import Sequence
from typing import Any

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.look import SHARED
from experiments.scenes.storage_measure import CodecMeasurement, front


def size_against_rates(rows: Sequence[CodecMeasurement], own: str, need_fps: float) -> bytes:
    """Bytes a frame over the read rate and over the write rate; a line joins those that no other one beats.

    Args:
      rows: the codecs.
      own: name of the one that is ringed.
      need_fps: read rate drawn as a bound.
    """
    best = front(rows)
    line = Series(x=[r.read_fps for r in best], y=[r.bytes for r in best], marker="", colour=SHARED, width=0.8)
    scales: dict[str, Any] = {"x_scale": "log", "y_scale": "log", "y_format": "{x:,.0f}"}
    reading = Panel(
        [line, *_kinds(rows, "read_fps", own)],
        x_label="frames read a second of one core",
        y_label="bytes a frame",
        rules=[Rule(x=need_fps, colour=SHARED)],
        **scales,
    )
    writing = Panel(_kinds(rows, "write_fps", own), x_label="frames written a second of one core", **scales)
    return draw([reading, writing], size=(11.0, 6.4), share_y=True)


def _kinds(rows: Sequence[CodecMeasurement], rate: str, own: str) -> list[Series]:
    """A series for each kind of codec, and a ring."""
    series = []
    for kind in dict.fromkeys(row.codec.kind for row in rows):
        of = [row for row in rows if row.codec.kind == kind]
        names = [row.codec.name.removesuffix(" zstd-1") for row in of]
        at: dict[str, Any] = {"x": [vars(row)[rate] for row in of], "y": [row.bytes for row in of]}
        series.append(Series(kind, **at, line="", labels=names))
    ringed = [row for row in rows if row.codec.name == own]
    at = {"x": [vars(row)[rate] for row in ringed], "y": [row.bytes for row in ringed]}
    return [*series, Series(**at, line="", hollow=True, colour="black", size=170)]
