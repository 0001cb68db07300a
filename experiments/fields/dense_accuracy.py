"""The dense panel: the displacement at every pixel between the markers, and what it costs."""

import functools
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np

from experiments.core.charts import Point, speed_against_error
from experiments.core.context import Context
from experiments.core.results import Column, Picture, Requirement, Table
from experiments.core.timing import interleaved
from experiments.fields.gels_at_rest import GelAtRest
from experiments.fields.known_motion import GelCamera
from experiments.fields.sections import FieldSection
from experiments.fields.tracked_gels import FIRST_SEED, NOISE_GREY, PEAK_PX, TrackedGel, grey, subject
from experiments.fields.trackers import farneback_flow
from sensors_io.fields.deformation import DeformationReader
from sensors_io.fields.spline import Densifier

MAIN = "this: markers, affine, spline"
_MARGIN = 0.1  # of height and width: within, the markers surround every pixel

Dense = Callable[[np.ndarray], np.ndarray]
"""From a picture, RGB, to its displacement field in pixels, [H, W, 2]."""


def panel(motions: int, rounds: int, rests: Sequence[GelAtRest], context: Context) -> FieldSection:
    """Errors and speeds of dense fields on every gel, and the speed of the spline alone."""
    seeds: list[int | None] = [None, *range(FIRST_SEED, FIRST_SEED + motions)]
    subjects = [subject(rest) for rest in rests]
    measured = {s.rest.name: _measure(s, seeds, rounds) for s in context.each("gels", subjects)}
    chosen = [s for s in subjects if s.rest.real] or subjects
    errors = [measured[s.rest.name][MAIN][0] / s.unit for s in chosen]
    hertz = spline_hertz(subjects[0], rounds)
    return FieldSection(
        verdict=(
            f"Between the markers the thin-plate spline is off by {np.mean(errors):.3f} px on average, and costs "
            f"{1e3 / hertz:.2f} ms.",
        ),
        requirements=(
            Requirement(
                name="dense field, mean error", measured=float(np.mean(errors)), bound=0.05, better="lower", unit="px"
            ),
            Requirement(name="markers → dense field", measured=hertz, bound=1000, better="higher", unit="Hz"),
        ),
        tables=(_table(measured),),
        pictures=(_picture(measured, subjects[0].rest.name),),
    )


def spline_hertz(of: TrackedGel, rounds: int) -> float:
    """Dense fields a second from markers that are found already, at the picture's size."""
    tracker = DeformationReader(of.rest.picture, mm_per_px=1.0).tracker
    densify = Densifier(tracker.spline, of.rest.picture.shape[:2])
    moved = of.motion(PEAK_PX, None).forward(of.points_px)
    call = functools.partial(densify, moved)
    call()
    return 1 / float(np.median(interleaved({"": call}, range(max(rounds, 30)))[""]))


def _measure(of: TrackedGel, seeds: Sequence[int | None], rounds: int) -> dict[str, tuple[float, float, float]]:
    """Mean error, 95th percentile, milliseconds of every method."""
    height, width = of.rest.picture.shape[:2]
    rows, columns = (slice(int(_MARGIN * n), n - int(_MARGIN * n)) for n in (height, width))
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float64)
    errors: dict[str, list[np.ndarray]] = {}
    for seed in seeds:
        motion = of.motion(PEAK_PX, seed)
        film = GelCamera(of.rest.picture, NOISE_GREY, 4)
        methods, picture = _methods(film.at_rest()), film.under(motion)
        true = motion.forward(pixels[rows, columns])
        for name, dense in methods.items():
            wrong = np.linalg.norm(dense(picture)[rows, columns] - true, axis=-1)
            errors.setdefault(name, []).append(wrong.ravel())
    calls = {name: functools.partial(dense, picture) for name, dense in methods.items()}
    seconds = interleaved(calls, range(rounds))
    pooled = {name: np.concatenate(e) for name, e in errors.items()}
    return {
        name: (float(e.mean()), float(np.quantile(e, 0.95)), 1e3 * float(np.median(seconds[name])))
        for name, e in pooled.items()
    }


def _methods(rest: np.ndarray) -> dict[str, Dense]:
    still = grey(rest)
    reader = DeformationReader(rest, mm_per_px=1.0)
    methods: dict[str, Dense] = {MAIN: lambda picture: reader.read(picture).displacement_mm}
    presets = {
        "DIS ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
        "DIS fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
        "DIS medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
    }
    for name, preset in presets.items():
        flow = cv2.DISOpticalFlow.create(preset)
        methods[name] = functools.partial(lambda flow, picture: flow.calc(still, grey(picture), None), flow)
    for window in (15, 45):
        methods[f"Farnebäck {window}"] = functools.partial(
            lambda window, picture: farneback_flow(still, grey(picture), window), window
        )
    return methods


def _table(measured: Mapping[str, Mapping[str, tuple[float, float, float]]]) -> Table:
    methods = list(next(iter(measured.values())))
    columns = [
        column
        for gel in measured
        for column in (
            Column(name=f"{gel}: mean", unit="px", format=".3f"),
            Column(name="95 %", unit="px", format=".3f"),
            Column(name="time", unit="ms", format=".2f"),
        )
    ]
    return Table(
        title="Dense displacement under known motion",
        columns=(Column(name="method"), *columns),
        rows=tuple((m, *(value for gel in measured.values() for value in gel[m])) for m in methods),
        note="Over the inner four fifths of height and width; the time is that from picture to field.",
    )


def _picture(measured: Mapping[str, Mapping[str, tuple[float, float, float]]], gel: str) -> Picture:
    groups: dict[str, list[Point]] = {}
    for method, (mean, high, ms) in measured[gel].items():
        groups.setdefault(method.split(" ")[0].rstrip(":"), []).append((method, ms, mean, high))
    return Picture(
        name="fields_dense",
        title=f"Dense field: speed against error, {gel}",
        caption="Mean distance from the truth; bars reach to the 95th percentile.",
        content=speed_against_error(groups, "error, px", None, legend=False),
    )
