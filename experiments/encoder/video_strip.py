"""Rows of frames beside each other as one picture."""

import dataclasses
import io
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.core.charts import LOOK

SIDE_IN, DPI = 1.5, 150


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrameStrip:
    """One row: its title, and frames [H, W, 3] in [0, 1] by name."""

    title: str
    frames: Mapping[str, np.ndarray]


def video_strip(strips: Sequence[FrameStrip]) -> bytes:
    """All rows as a PNG; names stand above the first row."""
    columns = max(len(strip.frames) for strip in strips)
    with mpl.rc_context(LOOK | {"axes.grid": False}):
        size = (SIDE_IN * columns + 0.4, SIDE_IN * len(strips) + 0.3)
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(len(strips), columns, squeeze=False)
        for i, (row, strip) in enumerate(zip(grid, strips, strict=True)):
            for axes, (name, frame) in zip(row, strip.frames.items(), strict=True):
                axes.imshow(np.clip(frame, 0, 1), interpolation="nearest")
                axes.set(xticks=[], yticks=[])
                axes.spines[:].set_visible(False)
                if i == 0:
                    axes.set_title(name, fontsize=9)
            row[0].set_ylabel(strip.title, fontsize=8.5)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
        return buffer.getvalue()
