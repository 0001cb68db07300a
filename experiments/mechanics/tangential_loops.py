"""Load–unload loops of real presses: does the force lag behind the displacement, or does the gel lose energy?"""

from pathlib import Path

import numpy as np

from experiments.core.errors import require
from experiments.core.results import Cell, Column, Table
from sensors_io.scenes import history

RECORDING = "example_1_AD2-0065L.npz"
"""The vendor's longer recording, 20 × 20 markers, frames 32.7 ms apart."""

LAGS_S = (0.0, 0.03, 0.06, 0.09)
TOUCHES_N = 0.05
"""Force above which the sensor is touched."""


def loop_table(data_dir: Path) -> Table:
    """Area of the loop of force over mean indentation, relative to the work of loading, for every press.

    An elastic gel makes 0, a lossy one a positive area, a force that is read before the displacement a negative one.

    Args:
      data_dir: holds `RECORDING`.

    Raises:
      ResultsError: no such file.
    """
    path = data_dir / RECORDING
    require(path.is_file(), "data_dir", data_dir, f"must hold {RECORDING}", "give the folder of the recordings")
    with np.load(path) as recording:
        force = -recording["3D_ResultantForce"].reshape(-1, 3)[:, 2]
        depth = -recording["3D_Displacements"][..., 2].mean(1)
        time = recording["sendTimestamp"].ravel() - recording["sendTimestamp"].ravel()[0]
    rows: list[tuple[Cell, ...]] = []
    for press in presses(force):
        t = time[press]
        returned = (history.returned_share(np.interp(t + lag, time, force), depth[press]) for lag in LAGS_S)
        areas = (100 * (1 - share) for share in returned)
        rows.append((f"{t[0]:.1f}–{t[-1]:.1f} s", float(force[press].max()), *areas))
    return Table(
        title="Loops of force over indentation in real presses",
        columns=(
            Column(name="press"),
            Column(name="peak", unit="N", format=".2f"),
            *(Column(name=f"force read {1000 * lag:.0f} ms later", unit="%", format=".1f") for lag in LAGS_S),
        ),
        rows=tuple(rows),
        note="Area over the work of loading, by a Tac3D's own force and mean indentation; positive: energy is lost.",
    )


def presses(force_n: np.ndarray) -> list[slice]:
    """Frames of every press that begins and ends within a recording, one untouched frame included on either side."""
    edges = np.diff((force_n > TOUCHES_N).astype(int))
    begins, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    return [slice(int(b), int(ends[ends > b][0]) + 2) for b in begins if np.any(ends > b)]
