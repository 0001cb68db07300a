"""Size against rates, one chart per kind of clips."""

from collections.abc import Sequence

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from experiments.core.charts import LOOK, MARKERS, PALETTE, SHARED, svg
from experiments.core.names import Named, name_points
from experiments.scenes.storage_measure import CodecMeasurement, front


def size_against_rates(rows: Sequence[CodecMeasurement], own: str, need_fps: float) -> bytes:
    """Bytes a frame over the read rate and over the write rate; a line joins those that no other one beats.

    Args:
      rows: the codecs.
      own: name of the one that is ringed.
      need_fps: read rate drawn as a bound.
    """
    kinds = list(dict.fromkeys(row.codec.kind for row in rows))
    style = {k: (PALETTE[i % len(PALETTE)], MARKERS[i % len(MARKERS)]) for i, k in enumerate(kinds)}
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(11.0, 6.4), layout="constrained")
        reading, writing = figure.subplots(1, 2, sharey=True)
        for axes, rate, label in ((reading, "read_fps", "read"), (writing, "write_fps", "written")):
            _draw(axes, rows, rate, style, own)
            axes.set(xscale="log", yscale="log", xlabel=f"frames {label} a second of one core")
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
            axes.yaxis.set_minor_formatter(StrMethodFormatter("{x:,.0f}"))
        best = front(rows)
        reading.plot([r.read_fps for r in best], [r.bytes for r in best], color=SHARED, lw=0.8, zorder=1)
        reading.axvline(need_fps, color=SHARED, lw=1, ls=":")
        reading.set_ylabel("bytes a frame")
        handles, labels = reading.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8)
        for axes, rate in ((reading, "read_fps"), (writing, "write_fps")):
            name_points(axes, [_named(row, rate, style) for row in rows], size_pt=6.5)
        return svg(figure)


def _draw(axes: Axes, rows: Sequence[CodecMeasurement], rate: str, style: dict[str, tuple[str, str]], own: str) -> None:
    seen: set[str] = set()
    for row in rows:
        colour, marker = style[row.codec.kind]
        x, y = vars(row)[rate], row.bytes
        axes.plot(x, y, marker, color=colour, ms=6, label="" if row.codec.kind in seen else row.codec.kind)
        seen.add(row.codec.kind)
        if row.codec.name == own:
            axes.plot(x, y, "o", mfc="none", mec="black", ms=13)


def _named(row: CodecMeasurement, rate: str, style: dict[str, tuple[str, str]]) -> Named:
    name = row.codec.name.removesuffix(" zstd-1")
    return Named(name=name, x=vars(row)[rate], y=row.bytes, colour=style[row.codec.kind][0])
