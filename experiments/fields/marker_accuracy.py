"""The marker panel: how far off is each point, does it survive a jump, and what does it cost."""

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from experiments.core.charts import Point, speed_against_error
from experiments.core.context import Context
from experiments.core.results import Cell, Column, Picture, Requirement, Table
from experiments.core.timing import interleaved
from experiments.fields.known_motion import REST_PICTURES, GelCamera
from experiments.fields.sections import FieldSection
from experiments.fields.tracked_gels import FIRST_SEED, JUMP_PX, NOISE_GREY, PEAK_PX, TrackedGel, grey
from experiments.fields.trackers import FOLLOWERS

MAIN, ALONE = "this", "this, affine alone"
LOST_PX = 1.0
_STEPS = 10  # pictures in which a motion is made, for methods that go from frame to frame


@dataclasses.dataclass(frozen=True, kw_only=True)
class MarkerConfig:
    """Motions drawn for each gel besides the published one; rounds of timing."""

    motions: int = 4
    rounds: int = 15

    def __post_init__(self) -> None:
        for name in ("motions", "rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: must be ≥ 1; raise it")


def panel(config: MarkerConfig, subjects: Sequence[TrackedGel], context: Context) -> FieldSection:
    """Errors and speeds of every method on every gel; a jump."""
    seeds = [None, *range(FIRST_SEED, FIRST_SEED + config.motions)]
    by_gel = {s.rest.name: errors_of(s, PEAK_PX, seeds) for s in context.each("following", subjects)}
    errors = {name: {gel: by[name] for gel, by in by_gel.items()} for name in FOLLOWERS}
    milliseconds = {s.rest.name: speeds(s, context.rounds(f"timing on {s.rest.name}", config.rounds)) for s in subjects}
    jumps = {s.rest.name: jump(s, seeds) for s in context.each("jumping", subjects)}
    return FieldSection(
        verdict=_verdict(errors, milliseconds, subjects),
        requirements=_requirements(errors, jumps, subjects),
        tables=(
            _error_table(errors, milliseconds, subjects),
            _jump_table(jumps),
        ),
        pictures=(_picture(errors, milliseconds, subjects[0].rest.name),),
    )


def errors_of(of: TrackedGel, peak_px: float, seeds: Sequence[int | None]) -> dict[str, np.ndarray]:
    """Distance of every point from the truth at the end of every motion, by method, pixels; infinite where it says
    lost.
    """
    found: dict[str, list[np.ndarray]] = {name: [] for name in FOLLOWERS}
    for seed in seeds:
        motion = of.motion(peak_px, seed)
        film = GelCamera(of.rest.picture, NOISE_GREY, FIRST_SEED if seed is None else seed)
        rest = grey(film.at_rest())
        shares = [step / _STEPS for step in range(1, _STEPS + 1)]
        pictures = [grey(film.under(motion.times(share), share)) for share in shares]
        true = of.points_px + motion.forward(of.points_px)
        for name, make in FOLLOWERS.items():
            follow = make(rest, of.points_px, of.half_px)
            points = [follow(picture) for picture in pictures][-1]
            error = np.hypot(*(points - true).T)[of.inside(true)]
            found[name].append(np.where(np.isfinite(error), error, np.inf))
    return {name: np.concatenate(errors) for name, errors in found.items()}


def speeds(of: TrackedGel, rounds: Iterable[object]) -> dict[str, float]:
    """Milliseconds a frame of every method on a picture under motion, median over rounds."""
    film = GelCamera(of.rest.picture, NOISE_GREY, 1)
    rest, motion = grey(film.at_rest()), of.motion(PEAK_PX / 2, None)
    pictures = [grey(film.under(motion.times(s), s)) for s in (0.9, 1.0)]
    calls = {}
    for name, make in FOLLOWERS.items():
        follow = make(rest, of.points_px, of.half_px)
        calls[name] = functools.partial(_both, follow, pictures)
        calls[name]()
    seconds = interleaved(calls, rounds)
    return {name: 1e3 / len(pictures) * float(np.median(s)) for name, s in seconds.items()}


def jump(of: TrackedGel, seeds: Sequence[int | None]) -> dict[str, list[float]]:
    """Share of points that are lost or more than a pixel off after one jump from rest, by method and motion."""
    shares: dict[str, list[float]] = {name: [] for name in FOLLOWERS}
    for seed in seeds:
        motion = of.motion(JUMP_PX, seed)
        film = GelCamera(of.rest.picture, NOISE_GREY, 3)
        rest, picture = grey(film.at_rest()), grey(film.under(motion))
        true = of.points_px + motion.forward(of.points_px)
        for name, make in FOLLOWERS.items():
            error = np.hypot(*(make(rest, of.points_px, of.half_px)(picture) - true).T)[of.inside(true)]
            shares[name].append(float(np.mean(~(error <= LOST_PX))))
    return shares


def _both(follow: object, pictures: list[np.ndarray]) -> None:
    for picture in pictures:
        follow(picture)  # type: ignore[operator]


def _quantiles(error: np.ndarray) -> tuple[float, float]:
    return float(np.median(error)), float(np.quantile(error, 0.95, method="lower"))


def known(error: np.ndarray) -> tuple[float | None, float | None]:
    """Median and 95th percentile, `None` where a method says of so many points that they are lost."""
    median, high = (value if np.isfinite(value) else None for value in _quantiles(error))
    return median, high


def _pooled(errors: Mapping[str, np.ndarray], subjects: Sequence[TrackedGel]) -> np.ndarray:
    """Errors on the real gels; on the generated ones where there are none; in pixels of a picture 320 wide."""
    chosen = [s for s in subjects if s.rest.real] or list(subjects)
    return np.concatenate([errors[s.rest.name] / s.unit for s in chosen])


def _requirements(
    errors: Mapping[str, Mapping[str, np.ndarray]],
    jumps: Mapping[str, Mapping[str, list[float]]],
    subjects: Sequence[TrackedGel],
) -> tuple[Requirement, ...]:
    median, high = _quantiles(_pooled(errors[MAIN], subjects))
    published = max(shares[MAIN][0] for shares in jumps.values())
    return (
        Requirement(name="marker error, median", measured=median, bound=0.04, better="lower", unit="px"),
        Requirement(name="marker error, 95th percentile", measured=high, bound=0.11, better="lower", unit="px"),
        Requirement(
            name="28 px jump: markers lost or > 1 px off, worst gel", measured=published, bound=0.0, better="lower"
        ),
    )


def _verdict(
    errors: Mapping[str, Mapping[str, np.ndarray]],
    milliseconds: Mapping[str, Mapping[str, float]],
    subjects: Sequence[TrackedGel],
) -> tuple[str, ...]:
    median, high = _quantiles(_pooled(errors[MAIN], subjects))
    first = subjects[0].rest.name
    return (
        f"The affine fit anchored to the picture at rest is off by {median:.3f} px in the median and {high:.3f} px in "
        f"95 of 100 markers, at {1e3 / milliseconds[first][MAIN]:.0f} Hz on {first}.",
    )


def _error_table(
    errors: Mapping[str, Mapping[str, np.ndarray]],
    milliseconds: Mapping[str, Mapping[str, float]],
    subjects: Sequence[TrackedGel],
) -> Table:
    names = [s.rest.name for s in subjects]
    rows: list[tuple[Cell, ...]] = [
        (method, *(value for gel in names for value in (*known(errors[method][gel]), milliseconds[gel][method])))
        for method in FOLLOWERS
    ]
    columns = [
        column
        for gel in names
        for column in (
            Column(name=f"{gel}: median", unit="px", format=".3f"),
            Column(name="95 %", unit="px", format=".3f"),
            Column(name="time", unit="ms", format=".2f"),
        )
    ]
    return Table(
        title="Markers under known motion",
        columns=(Column(name="method"), *columns),
        rows=tuple(rows),
        note=f"Peak {PEAK_PX:g} px on a picture 320 wide, shading of a contact, noise of {NOISE_GREY:g} grey levels, "
        f"at rest the mean of {REST_PICTURES} pictures; empty where a method says that more than 5 % are lost.",
    )


def _jump_table(jumps: Mapping[str, Mapping[str, list[float]]]) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (method, *(v for shares in jumps.values() for v in (shares[method][0], float(np.mean(shares[method])))))
        for method in FOLLOWERS
    ]
    columns = [
        column
        for gel in jumps
        for column in (
            Column(name=f"{gel}: jump", format=".1%", meaning="markers lost or more than 1 px off, published motion"),
            Column(name="all motions", format=".1%"),
        )
    ]
    return Table(
        title=f"A jump of {JUMP_PX:g} px in one frame",
        columns=(Column(name="method"), *columns),
        rows=tuple(rows),
    )


def _picture(
    errors: Mapping[str, Mapping[str, np.ndarray]], milliseconds: Mapping[str, Mapping[str, float]], gel: str
) -> Picture:
    groups: dict[str, list[Point]] = {}
    for method in FOLLOWERS:
        median, high = _quantiles(errors[method][gel])
        if np.isfinite(median) and method != ALONE:  # which lies on the first
            kind = "this package" if method.startswith("this") else method.split(" ")[0].rstrip(",")
            top = high if np.isfinite(high) else 10 * median
            groups.setdefault(kind, []).append((method, milliseconds[gel][method], median, top))
    return Picture(
        name="fields_markers",
        title=f"Markers: speed against error, {gel}",
        caption="Distance from the truth under known motion; bars reach from the median to the 95th percentile.  "
        "Without smoothing this package's point stays where it is.",
        content=speed_against_error(groups, "error, px", None, legend=False),
    )
