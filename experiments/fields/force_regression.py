"""Total force from displacement by ridge regression, on generated slides and on the vendor's Tac3D recordings."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from experiments.core.results import Cell, Table, named_table
from experiments.fields.generated_slides import NODES, Slide, node_grid
from sensors_io.clock import NS_PER_S
from sensors_io.fields import total_force
from sensors_io.fields.compliance import total_force as total_traction
from sensors_io.fields.inversion import LayerInverse
from sensors_io.force import ForceError, at_frames, estimate_lag
from sensors_io.scenes.sensors import TAC3D

RegressionRow = dict[str, Cell]


def generated_rows(slides: Mapping[str, Sequence[Slide]]) -> list[RegressionRow]:
    """Regression over the slides of each sensor: held-out blocks of time are then other objects and motions."""
    rows = []
    for name, of in slides.items():
        fields = np.concatenate([np.concatenate([s.deformation_mm, s.depth_mm[..., None]], -1) for s in of])
        force = np.concatenate([s.force_n for s in of])
        rows.append(_row(f"{name}, generated", force, total_force.fit(fields, force, blocks=len(of))))
    return rows


def recorded_rows(data_dir: pathlib.Path) -> list[RegressionRow]:
    """Regression on the vendor's recordings, whose force is the vendor's estimate, not a measured one.

    The force comes later than the displacement that it belongs to.  The lag is estimated on the *other* recordings, so
    that the held-out blocks stay unseen; where none of them gives it, on the recording itself, as the row's name says.
    """
    recordings = [_load(path) for path in sorted((data_dir / "tac3d").glob("*.npz"))]
    lags, rows = [_lag_s(one) for one in recordings], []
    for one, own in zip(recordings, lags, strict=True):
        others = [lag for other, lag in zip(recordings, lags, strict=True) if other is not one and lag is not None]
        inputs = {"": (one.displacement_mm, one.force_n), ", with the inverted load": (_with_load(one), one.force_n)}
        if others:
            lag_s = float(np.mean(others))
            inputs[f", force read {-1e3 * lag_s:.0f} ms later"] = _aligned(one, lag_s)
        elif own is not None:
            inputs[f", force read {-1e3 * own:.0f} ms later, by its own lag"] = _aligned(one, own)
        rows += [_row(f"{one.name}{how}", f, total_force.fit(u, f)) for how, (u, f) in inputs.items()]
    return rows


def regression_table(rows: Sequence[RegressionRow]) -> Table:
    """Held-out error and greatest force of every recording."""
    errors, sizes = ([f"{axis}: {what}" for axis in "xyz"] for what in ("error", "greatest"))
    return named_table(
        "Force from displacement by ridge regression, on blocks of time that it has not seen",
        rows,
        formats={"frames": "d", **dict.fromkeys(errors, ".3f"), **dict.fromkeys(sizes, ".2f")},
        units=dict.fromkeys([*errors, *sizes], "N"),
        note="On vendor recordings the force is the vendor's estimate, which comes later than its displacement; the "
        "lag is estimated on the other recording where possible. Pressing is z < 0.",
    )


def _row(name: str, force: np.ndarray, model: total_force.ForceModel) -> RegressionRow:
    errors, sizes = model.held_out_rmse, np.abs(force).max(0)
    row: RegressionRow = {"recording": name, "frames": len(force)}
    row |= {f"{axis}: error": float(e) for axis, e in zip("xyz", errors, strict=True)}
    return row | {f"{axis}: greatest": float(s) for axis, s in zip("xyz", sizes, strict=True)}


class ForceRecording(NamedTuple):
    """A vendor recording: displacement [N, 400, 3], resultant force [N, 3], times of the frames int64 [N]."""

    name: str
    displacement_mm: np.ndarray
    force_n: np.ndarray
    time_ns: np.ndarray


def _load(path: pathlib.Path) -> ForceRecording:
    with np.load(path) as file:
        force = file["3D_ResultantForce"].reshape(-1, 3)
        time_ns = np.rint(file["sendTimestamp"].ravel() * NS_PER_S).astype(np.int64)
        return ForceRecording(path.stem, file["3D_Displacements"], force, time_ns)


def _lag_s(one: ForceRecording) -> float | None:
    """Lag of displacement behind force, from their rates of change; `None` where these disagree."""
    moved = np.sqrt((one.displacement_mm**2).mean((1, 2)))
    try:
        return estimate_lag(one.time_ns, moved, one.time_ns, np.linalg.norm(one.force_n, axis=1)).seconds
    except ForceError:
        return None


def _aligned(one: ForceRecording, lag_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Displacement, and the force of its own time, where readings cover it."""
    found = at_frames(one.time_ns, one.time_ns, one.force_n, lag_s=lag_s)
    return one.displacement_mm[found.covered], found.value[found.covered]


def _with_load(one: ForceRecording) -> np.ndarray:
    """Displacements [N, 400 · 3] and the total force that the layer's compliance gives them, with equal weight.

    The gel is assumed to be the generated Tac3D's.  The recordings' grid runs against x and y, and u_z points out of
    the gel: the picture is turned by half a turn, depth is −u_z.
    """
    inverse, count = LayerInverse(TAC3D.gel, node_grid(TAC3D)), len(one.displacement_mm)
    fields = one.displacement_mm.reshape(count, NODES, NODES, 3)[:, ::-1, ::-1]
    load = [inverse.contact(f[..., :2], -f[..., 2]).traction_mpa for f in fields]
    total = np.array([total_traction(traction, node_grid(TAC3D).pitch_mm) for traction in load])
    flat = one.displacement_mm.reshape(count, -1)
    return np.hstack([flat, total * np.linalg.norm(flat) / np.linalg.norm(total)])
