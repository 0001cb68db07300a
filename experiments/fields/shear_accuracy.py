"""Shear, force and moment on generated presses, slides and twists, whose truth is known; also with a wrong layer.

Total force is also read by ridge regression on displacement, there and on the vendor's Tac3D recordings.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from experiments.core.charts import Point, speed_against_error
from experiments.core.context import Context
from experiments.core.results import Cell, Picture, ReportPart, Table, at_most, named_table
from experiments.core.timing import median_ms
from experiments.fields.generated_slides import NODES, Slide, cached_slides, make_slides, node_grid, pressing
from experiments.mechanics.tangential_scenes import KINDS
from sensors_io.arrays import load_arrays
from sensors_io.clock import NS_PER_S
from sensors_io.fields import total_force
from sensors_io.fields.compliance import total_force as total_traction
from sensors_io.fields.helmholtz import decompose
from sensors_io.fields.inversion import InverseConfig, LayerInverse
from sensors_io.fields.shear import ShearAndForce, ShearReader
from sensors_io.force import ForceError, at_frames, estimate_lag
from sensors_io.scenes.sensors import DMTAC_X, TAC3D, XENSE, SensorModel

MAIN, WITH_GRADIENT = "layer model, gradient-free", "layer model, all of the motion"
SUBTRACTED, BASELINE = "less the pressure's part", "Helmholtz–Hodge"
SENSORS = (TAC3D, XENSE, DMTAC_X)
FIRST_SEED, LAYER_SEED = 200, 600
"""Of objects and noise in the reports on sensors and on wrong layers: the smoothness length was chosen on seed 5, the
gradient-free reading on seeds 700 and 800.
"""

LAYERS = ((1.0, 0.48), (1.0, 0.45), (0.7, 0.48), (0.7, 0.45), (1.3, 0.48), (1.3, 0.45))
"""True thickness over the assumed one, and true Poisson ratio; the readings assume (1, 0.48)."""

MOTIONS, FRAMES = ("press", "slide_x", "slide_y", "twist"), 36
"""Contacts and frames of the slides."""

STRIDE, ROUNDS = 3, 9  # every how many-th frame is scored; rounds of timing
ShearMethod = Callable[[Slide, int], np.ndarray]  # from a slide and the index of a frame to its shear [h, w, 2], mm

ShearErrors = Mapping[str, Mapping[str, float]]  # method → motion → root mean square distance from the true shear, µm


@functools.lru_cache(maxsize=32)
def shear_reader(sensor: SensorModel, gradient_free: bool) -> Callable[[Slide, int], ShearAndForce]:
    """The package's reader for a generated sensor, called with a slide and the index of a frame."""
    config = InverseConfig(
        lateral_noise_mm=sensor.lateral_noise_mm, depth_noise_mm=sensor.depth_noise_mm, gradient_free=gradient_free
    )
    reader = ShearReader(sensor.gel, node_grid(sensor), config)
    return lambda slide, f: reader.read(slide.deformation_mm[f], slide.depth_mm[f], slide.valid[f])


def shear_methods(sensor: SensorModel) -> dict[str, ShearMethod]:
    """All readings of shear that assume this sensor."""
    grid = node_grid(sensor)
    split, whole = (shear_reader(sensor, gradient_free=gradient_free) for gradient_free in (True, False))
    return {
        MAIN: lambda slide, f: split(slide, f).shear_mm,
        WITH_GRADIENT: lambda slide, f: whole(slide, f).shear_mm,
        SUBTRACTED: lambda slide, f: whole(slide, f).subtracted_mm,
        BASELINE: lambda slide, f: decompose(slide.deformation_mm[f], grid.pitch_mm).shear,
        "deformation itself": lambda slide, f: slide.deformation_mm[f],
        "none": lambda slide, f: np.zeros_like(slide.deformation_mm[f]),
    }


def scored_frames(slides: Sequence[Slide]) -> Iterator[tuple[Slide, int]]:
    """Slides and indices of their frames that are scored."""
    return ((slide, f) for slide in slides for f in pressing(slide)[::STRIDE])


def shear_errors(sensor: SensorModel, slides: Sequence[Slide]) -> dict[str, dict[str, float]]:
    """Errors of all readings; see `ShearErrors`."""
    errors: dict[str, dict[str, list[float]]] = {}
    for name, shear in shear_methods(sensor).items():
        for slide, f in scored_frames(slides):
            square = float(((shear(slide, f) - slide.shear_mm[f]) ** 2).sum(-1).mean())
            errors.setdefault(name, {}).setdefault(slide.motion, []).append(square)
    return {name: {m: 1e3 * float(np.sqrt(np.mean(e))) for m, e in by.items()} for name, by in errors.items()}


def force_errors(sensor: SensorModel, slides: Sequence[Slide]) -> dict[str, float]:
    """Root mean square errors of force, moment and traction by inversion, and root mean squares of the true ones."""
    split = shear_reader(sensor, gradient_free=True)
    wrong, true = [], []
    for slide, f in scored_frames(slides):
        found = split(slide, f)
        traction = np.linalg.norm(found.traction_mpa - slide.traction_mpa[f], axis=-1)
        measured = (found.force_n - slide.force_n[f], found.moment_nmm - slide.moment_nmm[f], traction.ravel())
        wrong.append([np.sum(m**2) for m in measured] + [(found.force_n[2] - slide.force_n[f, 2]) ** 2])
        true.append([np.sum(m**2) for m in (slide.force_n[f], slide.moment_nmm[f], slide.traction_mpa[f])])
    error, size = (np.sqrt(np.mean(a, 0)) for a in (wrong, true))
    return {
        "force": float(error[0]),
        "normal force": float(error[3]),
        "force, true": float(size[0]),
        "moment": float(error[1]),
        "moment, true": float(size[1]),
        "traction, relative": float(error[2] / size[2]),
    }


def unexplained(sensor: SensorModel, slides: Sequence[Slide]) -> float:
    """Root mean square of the motion that no load on the assumed layer explains, over that of the noise."""
    whole, squares = shear_reader(sensor, gradient_free=False), []
    for slide, f in scored_frames(slides):
        found = whole(slide, f)
        squares.append(((found.subtracted_mm - found.shear_mm)[slide.valid[f]] ** 2).mean())
    return float(np.sqrt(np.mean(squares)) / sensor.lateral_noise_mm)


def shear_section(data_dir: pathlib.Path | None, context: Context) -> list[ReportPart]:
    """Shear of every method on every sensor with markers; total force by inversion and by regression."""
    slides, errors, forces = {}, {}, {}
    for s in context.each("sensors", SENSORS):
        slides[s.name] = cached_slides(s, KINDS, MOTIONS, FRAMES, FIRST_SEED)
        errors[s.name] = shear_errors(s, slides[s.name])
        forces[s.name] = force_errors(s, slides[s.name])
    timed = slides[TAC3D.name][0]
    frame = int(pressing(timed)[-1])
    calls = {name: functools.partial(shear, timed, frame) for name, shear in shear_methods(TAC3D).items()}
    ms = median_ms(calls, range(ROUNDS))
    regressions = generated_rows(slides) + (recorded_rows(data_dir) if data_dir is not None else [])
    ratio = max(_mean(by[MAIN]) / _mean(by[BASELINE]) for by in errors.values())
    force = max(by["force"] / by["force, true"] for by in forces.values())
    loads = named_table(
        "Load by inversion of the layer's compliance",
        [{"sensor": sensor, **by} for sensor, by in forces.items()],
        formats=dict.fromkeys(forces[TAC3D.name], ".3f"),
        note="Root mean squares: force in N, moment in N mm, traction over the true one.",
    )
    points: dict[str, list[Point]] = {
        name: [(name, ms[name], _mean(by), max(by.values()))] for name, by in errors[TAC3D.name].items()
    }
    picture = Picture(
        name="fields_shear",
        title="Shear: speed against error, Tac3D's gel",
        caption="Mean over the motions; bars reach to the worst motion.",
        content=speed_against_error(points, "error, µm", None, legend=False),
    )
    return [
        *(
            f"{sensor}: error of shear {_mean(by[MAIN]):.1f} µm, with Helmholtz–Hodge {_mean(by[BASELINE]):.1f} µm."
            for sensor, by in errors.items()
        ),
        at_most("shear error over Helmholtz–Hodge's, worst sensor", ratio, 1.0),
        at_most("total force by inversion, relative, worst sensor", force, 0.15),
        _shear_table(errors, ms),
        loads,
        regression_table(regressions),
        picture,
    ]


def layer_section() -> list[ReportPart]:
    """Errors of every reading that assumes the nominal layer, on slides of other layers."""
    means: dict[str, dict[str, float]] = {}
    for factor, poisson in LAYERS:
        gel = dataclasses.replace(TAC3D.gel, thickness_mm=factor * TAC3D.gel.thickness_mm, poisson=poisson)
        slides = make_slides(dataclasses.replace(TAC3D, gel=gel), KINDS, MOTIONS, FRAMES, LAYER_SEED)
        by_method = {name: _mean(by) for name, by in shear_errors(TAC3D, slides).items()}
        row = "unexplained over noise, layer model with all of the motion"
        means[f"{factor:g} × thick, ν {poisson:g}"] = by_method | {row: unexplained(TAC3D, slides)}
    ratio = max(by[MAIN] / by[BASELINE] for by in means.values())
    table = named_table(
        "Shear with wrong parameters of the gel (Tac3D, generated)",
        [{"method": name, **{layer: by[name] for layer, by in means.items()}} for name in next(iter(means.values()))],
        formats=dict.fromkeys(means, ".1f"),
        units=dict.fromkeys(means, "µm"),
        note="Root mean square distance from the truth, mean over motions. The last row is a ratio: a wrong layer "
        "leaves hardly more unexplained than the right one, so it cannot be noticed there.",
    )
    return [
        at_most("shear error over Helmholtz–Hodge's, worst wrong layer", ratio, 1.0),
        table,
    ]


def _mean(errors: Mapping[str, float]) -> float:
    return float(np.mean(list(errors.values())))


def _shear_table(errors: Mapping[str, ShearErrors], ms: Mapping[str, float]) -> Table:
    cells = {
        f"{sensor} {motion}": {name: by[motion] for name, by in by_method.items()}
        for sensor, by_method in errors.items()
        for motion in by_method[MAIN]
    }
    return named_table(
        "Shear on generated presses, slides and twists",
        [{"method": name, "time": time, **{c: by[name] for c, by in cells.items()}} for name, time in ms.items()],
        formats={"time": ".2f", **dict.fromkeys(cells, ".1f")},
        units={"time": "ms", **dict.fromkeys(cells, "µm")},
        note="Root mean square distance from the part of the displacement that traction causes.",
    )


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
    file = load_arrays(path)
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
