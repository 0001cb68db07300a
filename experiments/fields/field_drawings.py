"""Fields of real pictures, drawn side by side."""

import dataclasses
import io
import textwrap
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import ndimage

from experiments.core.charts import LOOK

_DPI = 110
_FLAGS = 42  # letters of a line of flags


@dataclasses.dataclass(frozen=True, kw_only=True)
class DrawnFields:
    """One picture: change uint8 [H, W, 3], depth [H, W] and contact [H, W], deformation [h, w, 2], flags in words."""

    name: str
    change: np.ndarray
    depth_mm: np.ndarray | None
    contact: np.ndarray
    deformation_mm: np.ndarray | None
    flags: str


def field_rows(rows: Sequence[DrawnFields], mm_per_px: float) -> bytes:
    """A PNG of one row a picture: change of colour, depth with the outline of the contact, its profile, deformation."""
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(11, 2.2 * len(rows) + 0.3), layout="constrained")
        for panels, row in zip(figure.subplots(len(rows), 4, squeeze=False), rows, strict=True):
            _picture(panels[0], row)
            _depth(figure, panels[1], row, mm_per_px)
            _profile(panels[2], row, mm_per_px)
            _deformation(panels[3], row, mm_per_px)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
        return buffer.getvalue()


def _picture(axes: Axes, row: DrawnFields) -> None:
    axes.imshow(row.change)
    axes.set_title("\n".join((row.name, *textwrap.wrap(row.flags, _FLAGS))), fontsize=7, loc="left")
    axes.set_axis_off()


def _depth(figure: Figure, axes: Axes, row: DrawnFields, mm_per_px: float) -> None:
    height, width = row.contact.shape
    window = (0, width * mm_per_px, height * mm_per_px, 0)
    if row.depth_mm is None:
        axes.imshow(row.contact, cmap="Greys", extent=window)
        axes.set_title("contact, by colour", fontsize=7)
    else:
        shown = axes.imshow(row.depth_mm, cmap="cividis", vmin=0, extent=window)
        figure.colorbar(shown, ax=axes)
        axes.set_title("depth, mm", fontsize=7)
    if row.contact.any() and not row.contact.all():
        axes.contour(
            *(np.linspace(0, n * mm_per_px, n) for n in (width, height)), row.contact, [0.5], colors="w", linewidths=0.8
        )
    axes.grid(False)


def _profile(axes: Axes, row: DrawnFields, mm_per_px: float) -> None:
    """Depth along the row and the column of the deepest pixel, where possible of a contact inside the picture."""
    if row.depth_mm is None:
        axes.set_axis_off()
        return
    inner = _off_border(row.contact)
    y, x = np.unravel_index(int(np.where(inner, row.depth_mm, -np.inf).argmax()), row.depth_mm.shape)
    for values, label in ((row.depth_mm[y], "along x"), (row.depth_mm[:, x], "along y")):
        axes.plot(np.arange(len(values)) * mm_per_px, values, lw=1, label=label)
    axes.set(xlabel="mm", ylabel="depth, mm")
    axes.legend(fontsize=7)


def _off_border(contact: np.ndarray) -> np.ndarray:
    """Contacts that do not meet the border, [H, W]; all pixels if there are none."""
    labels, _ = ndimage.label(contact)
    at_border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    inner: np.ndarray = contact & ~np.isin(labels, at_border)
    return inner if inner.any() else np.ones_like(contact)


def _deformation(axes: Axes, row: DrawnFields, mm_per_px: float) -> None:
    if row.deformation_mm is None:
        axes.text(0.5, 0.5, "no markers:\nrefused", ha="center", va="center", fontsize=8, transform=axes.transAxes)
        axes.set_axis_off()
        return
    h, w = row.deformation_mm.shape[:2]
    height, width = row.contact.shape
    x, y = ((np.arange(n) + 0.5) / n * side * mm_per_px for n, side in ((w, width), (h, height)))
    axes.quiver(x, y, row.deformation_mm[..., 0], row.deformation_mm[..., 1], angles="xy", color="#0072b2")
    axes.set(aspect="equal", xlim=(0, width * mm_per_px), ylim=(height * mm_per_px, 0))
    axes.set_title(f"greatest {np.hypot(*np.moveaxis(row.deformation_mm, -1, 0)).max():.2f} mm", fontsize=7)
