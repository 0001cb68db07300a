"""Tracking of markers and dense displacement fields under known motion: error, survival of a jump, time."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from experiments.core.charts import Point, speed_against_error
from experiments.core.context import Context
from experiments.core.results import Cell, Column, Picture, ReportPart, Table, at_least, at_most
from experiments.core.timing import median_ms
from experiments.fields.known_motion import (
    FIRST_SEED,
    JUMP_PX,
    NOISE_GREY,
    PEAK_PX,
    REST_PICTURES,
    GelCamera,
    MarkerGel,
    grey,
)
from experiments.fields.trackers import FLOWS, FOLLOWERS, Follower
from sensors_io.fields.deformation import DeformationReader
from sensors_io.fields.spline import Densifier

MARKER_DEFAULT, UNSMOOTHED = "this", "this, affine alone"
DENSE_DEFAULT = "this: markers, affine, spline"
SEEDS = (None, *range(FIRST_SEED, FIRST_SEED + 4))  # of the motions of each gel; `None` is the published one
ROUNDS, LOST_PX = 15, 1.0  # rounds of timing of the markers; distance from which a marker counts as lost
_MARGIN = 0.1  # of height and width: within, the markers surround every pixel


def marker_errors(gel: MarkerGel, peak_px: float, steps: int, noise_seed: int | None) -> dict[str, list[np.ndarray]]:
    """Distance of every point from the truth at the end of every motion, by method, px; infinite if reported lost.

    A motion is made in `steps` pictures; without a `noise_seed` the camera's noise has the seed of the motion.
    """
    found: dict[str, list[np.ndarray]] = {name: [] for name in FOLLOWERS}
    for seed in SEEDS:
        motion = gel.motion(peak_px, seed)
        camera = GelCamera(gel.picture, NOISE_GREY, noise_seed or seed or FIRST_SEED)
        rest = grey(camera.at_rest())
        pictures = [grey(camera.under(motion.times(step / steps), step / steps)) for step in range(1, steps + 1)]
        true = gel.points_px + motion.forward(gel.points_px)
        for name, make in FOLLOWERS.items():
            follow = make(rest, gel.points_px, gel.half_px)
            error = np.hypot(*([follow(picture) for picture in pictures][-1] - true).T)[gel.inside(true)]
            found[name].append(np.where(np.isfinite(error), error, np.inf))
    return found


def marker_ms(gel: MarkerGel, rounds: Iterable[object]) -> dict[str, float]:
    """Milliseconds of every method for a picture under motion."""
    camera = GelCamera(gel.picture, NOISE_GREY, 1)
    rest, motion = grey(camera.at_rest()), gel.motion(PEAK_PX / 2, None)
    pictures = [grey(camera.under(motion.times(s), s)) for s in (0.9, 1.0)]

    def both(follow: Follower) -> None:
        for picture in pictures:
            follow(picture)

    calls = {name: functools.partial(both, make(rest, gel.points_px, gel.half_px)) for name, make in FOLLOWERS.items()}
    return {name: ms / len(pictures) for name, ms in median_ms(calls, rounds).items()}


def dense_fields(rest: np.ndarray) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """Every method of dense displacement from a picture at rest, from a picture, RGB, to its field in px [H, W, 2]."""
    still, reader = grey(rest), DeformationReader(rest, mm_per_px=1.0)
    of_grey = lambda flow, picture: flow(grey(picture))
    return {
        DENSE_DEFAULT: lambda picture: reader.read(picture).displacement_mm,
        **{name: functools.partial(of_grey, make_flow(still)) for name, make_flow in FLOWS.items()},
    }


def dense_errors(gel: MarkerGel, rounds: Iterable[object]) -> dict[str, tuple[float, float, float]]:
    """Mean error and 95th percentile in px within the margin, and milliseconds, of every dense method."""
    height, width = gel.picture.shape[:2]
    rows, columns = (slice(int(_MARGIN * n), n - int(_MARGIN * n)) for n in (height, width))
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float64)
    errors: dict[str, list[np.ndarray]] = {}
    for seed in SEEDS:
        motion = gel.motion(PEAK_PX, seed)
        camera = GelCamera(gel.picture, NOISE_GREY, 4)
        methods, picture = dense_fields(camera.at_rest()), camera.under(motion)
        true = motion.forward(pixels[rows, columns])
        for name, dense in methods.items():
            wrong = np.linalg.norm(dense(picture)[rows, columns] - true, axis=-1)
            errors.setdefault(name, []).append(wrong.ravel())
    ms = median_ms({name: functools.partial(dense, picture) for name, dense in methods.items()}, rounds)
    pooled = {name: np.concatenate(e) for name, e in errors.items()}
    return {name: (float(e.mean()), float(np.quantile(e, 0.95)), ms[name]) for name, e in pooled.items()}


def marker_section(gels: Sequence[MarkerGel], context: Context) -> list[ReportPart]:
    """Errors and speeds of every method on every gel; a jump."""
    errors, losses = {}, {}
    for g in context.each("following", gels):
        errors[g.name] = {m: np.concatenate(e) for m, e in marker_errors(g, PEAK_PX, 10, None).items()}
        jumps = marker_errors(g, JUMP_PX, 1, 3)
        losses[g.name] = {m: [float(np.mean(~(e <= LOST_PX))) for e in of] for m, of in jumps.items()}
    ms = {g.name: marker_ms(g, context.rounds(f"timing on {g.name}", ROUNDS)) for g in gels}
    median, high = quantiles(np.concatenate([errors[g.name][MARKER_DEFAULT] / g.unit for g in _real(gels)]))
    worst_jump, first = max(shares[MARKER_DEFAULT][0] for shares in losses.values()), gels[0].name
    markers = _gel_table(
        "Markers under known motion",
        {g: {m: (*map(_finite, quantiles(e)), ms[g][m]) for m, e in by.items()} for g, by in errors.items()},
        _accuracy_columns("median"),
        note=f"Peak {PEAK_PX:g} px on a picture 320 wide, shading of a contact, noise of {NOISE_GREY:g} grey levels, "
        f"at rest the mean of {REST_PICTURES} pictures; empty where a method reports more than 5 % as lost.",
    )
    lost = "markers lost or more than 1 px off, published motion"
    jump_table = _gel_table(
        f"A jump of {JUMP_PX:g} px in one frame",
        {gel: {m: (s[0], float(np.mean(s))) for m, s in by.items()} for gel, by in losses.items()},
        (Column(name="jump", format=".1%", meaning=lost), Column(name="all motions", format=".1%")),
    )
    return [
        f"Markers: median error {median:.3f} px, {1e3 / ms[first][MARKER_DEFAULT]:.0f} Hz on {first}.",
        at_most("marker error, median", median, 0.04, "px"),
        at_most("marker error, 95th percentile", high, 0.11, "px"),
        at_most("28 px jump: markers lost or > 1 px off, worst gel", worst_jump, 0.0),
        markers,
        jump_table,
        _picture(
            "fields_markers",
            f"Markers: speed against error, {first}",
            "Distance from the truth under known motion; bars reach from the median to the 95th percentile. Without "
            "smoothing this package's point does not move.",
            {m: (*quantiles(e), ms[first][m]) for m, e in errors[first].items() if m != UNSMOOTHED},
        ),
    ]


def _picture(name: str, title: str, caption: str, methods: Mapping[str, tuple[float, float, float]]) -> Picture:
    """Error, its 95th percentile and milliseconds of every method that does not lose most points."""
    groups: dict[str, list[Point]] = {}
    for method, (error, high, ms) in methods.items():
        if np.isfinite(error):
            top = high if np.isfinite(high) else 10 * error
            groups.setdefault(method.split(" ")[0].rstrip(",:"), []).append((method, ms, error, top))
    content = speed_against_error(groups, "error, px", None, legend=False)
    return Picture(name=name, title=title, caption=caption, content=content)


def dense_section(rounds: int, gels: Sequence[MarkerGel], context: Context) -> list[ReportPart]:
    """Errors and speeds of dense fields on every gel, and the speed of the spline alone."""
    measured = {g.name: dense_errors(g, range(rounds)) for g in context.each("gels", gels)}
    error = float(np.mean([measured[g.name][DENSE_DEFAULT][0] / g.unit for g in _real(gels)]))
    tracker, first = DeformationReader(gels[0].picture, mm_per_px=1.0).tracker, gels[0].name
    densify = Densifier(tracker.spline, gels[0].picture.shape[:2])
    moved = gels[0].motion(PEAK_PX, None).forward(gels[0].points_px)
    spline_ms = median_ms({"": functools.partial(densify, moved)}, range(max(rounds, 30)))[""]
    table = _gel_table(
        "Dense displacement under known motion",
        measured,
        _accuracy_columns("mean"),
        note="Over the inner four fifths of height and width; the time is that from picture to field.",
    )
    return [
        at_most("dense field, mean error", error, 0.05, "px"),
        at_least("markers → dense field", 1e3 / spline_ms, 1000, "Hz"),
        table,
        _picture(
            "fields_dense",
            f"Dense field: speed against error, {first}",
            "Mean distance from the truth; bars reach to the 95th percentile.",
            measured[first],
        ),
    ]


def quantiles(error: np.ndarray) -> tuple[float, float]:
    """Median and 95th percentile, infinite where a method reports so many points as lost."""
    return float(np.median(error)), float(np.quantile(error, 0.95, method="lower"))


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _real(gels: Sequence[MarkerGel]) -> list[MarkerGel]:
    """The real gels, or the generated ones if there are none."""
    return [g for g in gels if g.real] or list(gels)


def _accuracy_columns(middle: str) -> list[Column]:
    return [
        *(Column(name=name, unit="px", format=".3f") for name in (middle, "95 %")),
        Column(name="time", unit="ms", format=".2f"),
    ]


def _gel_table(
    title: str, cells: Mapping[str, Mapping[str, Sequence[Cell]]], columns: Sequence[Column], note: str = ""
) -> Table:
    """A row per method and a group of columns per gel, of which the first names the gel; cells by gel and method."""
    headings = [Column(name="method")]
    for gel in cells:
        headings += [dataclasses.replace(columns[0], name=f"{gel}: {columns[0].name}"), *columns[1:]]
    methods = next(iter(cells.values()))
    rows = tuple((m, *(value for by_method in cells.values() for value in by_method[m])) for m in methods)
    return Table(title=title, columns=tuple(headings), rows=rows, note=note)
