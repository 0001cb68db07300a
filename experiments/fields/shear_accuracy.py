"""The shear and force panel: generated presses, slides and twists with the truth known, and Tac3D's own recordings."""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from experiments.core.charts import Point, speed_against_error
from experiments.core.context import Context
from experiments.core.results import Cell, Column, Picture, Requirement, Table
from experiments.core.timing import interleaved
from experiments.fields.generated_slides import NODES, Slide, cached_slides, node_grid
from experiments.fields.sections import FieldSection
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
MOTIONS = ("press", "slide_x", "slide_y", "twist")
FIRST_SEED = 200
"""Of objects and noise that are reported: the smoothness length was chosen on seed 5."""

_LEAST_FORCE_N = 0.5  # frames that press less have no shear to speak of

Shear = Callable[[Slide, int], np.ndarray]
"""From a frame of a slide to its shear [h, w, 2], mm."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShearConfig:
    """Kinds of objects, motions, frames of a sequence, every how many-th of which is scored, rounds of timing."""

    kinds: tuple[str, ...] = ("sphere", "rough", "patterned")
    motions: tuple[str, ...] = MOTIONS
    frames: int = 36
    stride: int = 3
    rounds: int = 9


def panel(config: ShearConfig, data_dir: pathlib.Path | None, context: Context) -> FieldSection:
    """Shear of every method on every sensor with markers; total force by inversion and by regression."""
    slides, errors, forces = {}, {}, {}
    for s in context.each("sensors", SENSORS):
        slides[s.name] = cached_slides(s, config.kinds, config.motions, config.frames, FIRST_SEED)
        errors[s.name] = shear_errors(s, slides[s.name], config.stride)
        forces[s.name] = force_errors(s, slides[s.name], config.stride)
    milliseconds = _milliseconds(TAC3D, slides[TAC3D.name][0], config.rounds)
    regressions = regression_rows(slides) + (recorded_rows(data_dir) if data_dir is not None else [])
    return FieldSection(
        verdict=_verdict(errors),
        requirements=_requirements(errors, forces),
        tables=(_shear_table(errors, milliseconds), _force_table(forces), _regression_table(regressions)),
        pictures=(_picture(errors[TAC3D.name], milliseconds),),
    )


def reader(sensor: SensorModel, gradient_free: bool = True) -> ShearReader:
    """The package's reader of a generated sensor."""
    config = InverseConfig(
        lateral_noise_mm=sensor.lateral_noise_mm, depth_noise_mm=sensor.depth_noise_mm, gradient_free=gradient_free
    )
    return ShearReader(sensor.gel, node_grid(sensor), config)


def methods(sensor: SensorModel) -> dict[str, Shear]:
    """Every reading of shear."""
    split, whole, grid = reader(sensor), reader(sensor, gradient_free=False), node_grid(sensor)

    def read(by: ShearReader, slide: Slide, f: int) -> ShearAndForce:
        return by.read(slide.deformation_mm[f], slide.depth_mm[f], slide.valid[f])

    return {
        MAIN: lambda slide, f: read(split, slide, f).shear_mm,
        WITH_GRADIENT: lambda slide, f: read(whole, slide, f).shear_mm,
        SUBTRACTED: lambda slide, f: read(whole, slide, f).subtracted_mm,
        BASELINE: lambda slide, f: decompose(slide.deformation_mm[f], grid.pitch_mm).shear,
        "deformation itself": lambda slide, f: slide.deformation_mm[f],
        "none": lambda slide, f: np.zeros_like(slide.deformation_mm[f]),
    }


def shear_errors(sensor: SensorModel, slides: Sequence[Slide], stride: int) -> dict[str, dict[str, float]]:
    """Root mean square distance from the true shear by method and motion, µm."""
    errors: dict[str, dict[str, list[float]]] = {}
    for name, shear in methods(sensor).items():
        for slide in slides:
            for f in pressing(slide)[::stride]:
                wrong = shear(slide, f) - slide.shear_mm[f]
                square = float((wrong**2).sum(-1).mean())
                errors.setdefault(name, {}).setdefault(slide.motion, []).append(square)
    return {name: {m: 1e3 * float(np.sqrt(np.mean(e))) for m, e in by.items()} for name, by in errors.items()}


def force_errors(sensor: SensorModel, slides: Sequence[Slide], stride: int) -> dict[str, float]:
    """Root mean square error of force, moment and traction by inversion, and the true ones'."""
    split = reader(sensor)
    wrong, true = [], []
    for slide in slides:
        for f in pressing(slide)[::stride]:
            found = split.read(slide.deformation_mm[f], slide.depth_mm[f], slide.valid[f])
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


def pressing(slide: Slide) -> np.ndarray:
    """Frames in which the object presses."""
    return np.flatnonzero(-slide.force_n[:, 2] > _LEAST_FORCE_N)


def regression_rows(slides: Mapping[str, Sequence[Slide]]) -> list[tuple[Cell, ...]]:
    """Ridge regression over generated sequences: blocks of time are then other objects and motions."""
    rows: list[tuple[Cell, ...]] = []
    for name, of in slides.items():
        fields = np.concatenate([np.concatenate([s.deformation_mm, s.depth_mm[..., None]], -1) for s in of])
        force = np.concatenate([s.force_n for s in of])
        model = total_force.fit(fields, force, blocks=len(of))
        rows.append((f"{name}, generated", len(force), *map(float, model.held_out_rmse), *_size(force)))
    return rows


def recorded_rows(data_dir: pathlib.Path) -> list[tuple[Cell, ...]]:
    """The same on the vendor's recordings; `force` there is the vendor's estimate, not a measured one.

    It comes later than the displacement that it belongs to.  By how much is told by the *other* recordings, so that
    the held-out blocks stay unseen; where none of them tells, by the recording itself, and the row says so.
    """
    recordings = [_recorded(path) for path in sorted((data_dir / "tac3d").glob("*.npz"))]
    rows: list[tuple[Cell, ...]] = []
    for one in recordings:
        others = [other.lag_s for other in recordings if other is not one and other.lag_s is not None]
        inputs = {"": (one.displacement_mm, one.force_n), ", with the inverted load": (one.loaded(), one.force_n)}
        if others:
            lag_s = float(np.mean(others))
            inputs[f", force read {-1e3 * lag_s:.0f} ms later"] = one.aligned(lag_s)
        elif one.lag_s is not None:
            inputs[f", force read {-1e3 * one.lag_s:.0f} ms later, by its own lag"] = one.aligned(one.lag_s)
        for how, (fields, force) in inputs.items():
            model = total_force.fit(fields, force)
            rows.append((f"{one.name}{how}", len(force), *map(float, model.held_out_rmse), *_size(force)))
    return rows


@dataclasses.dataclass(frozen=True, kw_only=True)
class ForceRecording:
    """A vendor recording: displacement [N, 400, 3], resultant force [N, 3], times of the frames int64 [N]."""

    name: str
    displacement_mm: np.ndarray
    force_n: np.ndarray
    time_ns: np.ndarray

    @functools.cached_property
    def lag_s(self) -> float | None:
        """By how much displacement comes later than force, from their rates of change; `None` where these disagree."""
        moved = np.sqrt((self.displacement_mm**2).mean((1, 2)))
        try:
            return estimate_lag(self.time_ns, moved, self.time_ns, np.linalg.norm(self.force_n, axis=1)).seconds
        except ForceError:
            return None

    def aligned(self, lag_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Displacement, and the force of its own time, where readings cover it."""
        found = at_frames(self.time_ns, self.time_ns, self.force_n, lag_s=lag_s)
        return self.displacement_mm[found.covered], found.value[found.covered]

    def loaded(self) -> np.ndarray:
        """Displacement with the total force that the layer's compliance gives it."""
        return _with_load(self.displacement_mm)


def _recorded(path: pathlib.Path) -> ForceRecording:
    with np.load(path) as file:
        return ForceRecording(
            name=path.stem,
            displacement_mm=file["3D_Displacements"],
            force_n=file["3D_ResultantForce"].reshape(-1, 3),
            time_ns=np.rint(file["sendTimestamp"].ravel() * NS_PER_S).astype(np.int64),
        )


def _with_load(displacement: np.ndarray) -> np.ndarray:
    """Displacements [N, h w, 3] with the total force that the layer's compliance gives them, of equal weight.

    The gel is taken for the generated Tac3D's.  The recordings' grid runs against x and y, and u_z points out of the
    gel: the picture is turned by half a turn, depth is −u_z.
    """
    inverse = LayerInverse(TAC3D.gel, node_grid(TAC3D))
    fields = displacement.reshape(len(displacement), NODES, NODES, 3)[:, ::-1, ::-1]
    load = [inverse.contact(f[..., :2], -f[..., 2]).traction_mpa for f in fields]
    total = np.array([total_traction(traction, node_grid(TAC3D).pitch_mm) for traction in load])
    flat = displacement.reshape(len(displacement), -1)
    return np.hstack([flat, total * np.linalg.norm(flat) / np.linalg.norm(total)])


def _size(force: np.ndarray) -> tuple[float, ...]:
    return tuple(float(v) for v in np.abs(force).max(0))


def _milliseconds(sensor: SensorModel, slide: Slide, rounds: int) -> dict[str, float]:
    f = int(pressing(slide)[-1])
    calls = {name: functools.partial(shear, slide, f) for name, shear in methods(sensor).items()}
    for call in calls.values():
        call()
    return {name: 1e3 * float(np.median(s)) for name, s in interleaved(calls, range(rounds)).items()}


def _mean(errors: Mapping[str, float]) -> float:
    return float(np.mean(list(errors.values())))


def _requirements(
    errors: Mapping[str, Mapping[str, Mapping[str, float]]], forces: Mapping[str, Mapping[str, float]]
) -> tuple[Requirement, ...]:
    ratio = max(_mean(by[MAIN]) / _mean(by[BASELINE]) for by in errors.values())
    force = max(by["force"] / by["force, true"] for by in forces.values())
    return (
        Requirement(name="shear error over Helmholtz–Hodge's, worst sensor", measured=ratio, bound=1.0, better="lower"),
        Requirement(
            name="total force by inversion, relative, worst sensor", measured=force, bound=0.15, better="lower"
        ),
    )


def _verdict(errors: Mapping[str, Mapping[str, Mapping[str, float]]]) -> tuple[str, ...]:
    return tuple(
        f"{sensor}: shear by the layer's compliance is off by {_mean(by[MAIN]):.1f} µm ({_mean(by[WITH_GRADIENT]):.1f} "
        f"with the gradient part of the motion), with the deformation's noise left in by {_mean(by[SUBTRACTED]):.1f} "
        f"µm, by Helmholtz–Hodge {_mean(by[BASELINE]):.1f} µm."
        for sensor, by in errors.items()
    )


def _shear_table(errors: Mapping[str, Mapping[str, Mapping[str, float]]], milliseconds: Mapping[str, float]) -> Table:
    motions = list(next(iter(next(iter(errors.values())).values())))
    columns = [Column(name=f"{sensor} {m}", unit="µm", format=".1f") for sensor in errors for m in motions]
    return Table(
        title="Shear on generated presses, slides and twists",
        columns=(Column(name="method"), Column(name="time", unit="ms", format=".2f"), *columns),
        rows=tuple(
            (name, ms, *(errors[sensor][name][m] for sensor in errors for m in motions))
            for name, ms in milliseconds.items()
        ),
        note="Root mean square distance from the part of the displacement that traction makes.",
    )


def _force_table(forces: Mapping[str, Mapping[str, float]]) -> Table:
    names = list(next(iter(forces.values())))
    return Table(
        title="Load by inversion of the layer's compliance",
        columns=(Column(name="sensor"), *(Column(name=n, format=".3f") for n in names)),
        rows=tuple((sensor, *(by[n] for n in names)) for sensor, by in forces.items()),
        note="Root mean squares: force in N, moment in N mm, traction over the true one's.",
    )


def _regression_table(rows: Sequence[tuple[Cell, ...]]) -> Table:
    axes = [Column(name=f"{a}: error", unit="N", format=".3f") for a in "xyz"]
    sizes = [Column(name=f"{a}: greatest", unit="N", format=".2f") for a in "xyz"]
    return Table(
        title="Force from displacement by ridge regression, on blocks of time that it has not seen",
        columns=(Column(name="recording"), Column(name="frames", format="d"), *axes, *sizes),
        rows=tuple(rows),
        note="On vendor recordings the force is the vendor's estimate, which comes later than its displacement; by how "
        "much is estimated on the other recording where it tells. Pressing is z < 0.",
    )


def _picture(errors: Mapping[str, Mapping[str, float]], milliseconds: Mapping[str, float]) -> Picture:
    points: dict[str, list[Point]] = {}
    for name, by in errors.items():
        points[name] = [(name, milliseconds[name], _mean(by), max(by.values()))]
    return Picture(
        name="fields_shear",
        title="Shear: speed against error, Tac3D's gel",
        caption="Mean over the motions; bars reach to the worst motion.",
        content=speed_against_error(points, "error, µm", None, legend=False),
    )
