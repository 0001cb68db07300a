"""The drift panel: what grows when points are followed for long, and what is the noise of a single picture.

A motion swings through rest and back in 90 pictures.  The published figures, 0.03 px from frame to frame and 0.006 px
anchored to the picture at rest, are the median distance of a GelSight Mini's markers from the truth after 900 pictures,
when the gel is at rest again, in pixels of a picture 320 wide; the picture at rest is a single one, as noisy as the
others.  The same is measured here on every gel, and for longer on the first.  What is matched to the picture at rest is
off by as much on a pair of still pictures, and no unbiased reading of one window by less than its Cramér–Rao bound;
only neighbours that move together tell more.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, PALETTE, svg
from experiments.core.results import Cell, Column, Picture, Requirement, Table
from experiments.fields.known_motion import REST_PICTURES, GelCamera
from experiments.fields.sections import FieldSection
from experiments.fields.tracked_gels import NOISE_GREY, PEAK_PX, TrackedGel, grey
from experiments.fields.trackers import FOLLOWERS

METHODS = ("this", "this, affine alone", "this, LK alone", "LK frame to frame")
MAIN, ALONE, PEER = METHODS[0], METHODS[1], METHODS[-1]
PERIOD, PUBLISHED = 90, 10
"""Pictures of a cycle; cycles of the published figures."""

BOUND_PX = 0.006

_FIRST_SEED = 450
_LUMA = (0.299, 0.587, 0.114)  # weights of the colours in grey
_ROUNDING = 1 / 12  # variance of rounding to whole grey levels
_RAYLEIGH = float(np.sqrt(np.log(2)))  # median length of an isotropic plane Gaussian over its root mean square


@dataclasses.dataclass(frozen=True, kw_only=True)
class DriftConfig:
    """Cycles after which the first gel is looked at; those of the others; pairs of still pictures."""

    cycles: tuple[int, ...] = (1, 2, 5, 10, 30)
    cycles_of_others: tuple[int, ...] = (1, 10)
    pairs: int = 10

    def __post_init__(self) -> None:
        for name in ("cycles", "cycles_of_others"):
            cycles = getattr(self, name)
            if not {1, PUBLISHED} <= set(cycles):
                raise ValueError(f"{name} is {cycles}: must hold 1 and {PUBLISHED}, which are compared; add them")


@dataclasses.dataclass(frozen=True, kw_only=True)
class StillErrors:
    """Medians on still pictures, px: all points together and each alone, with one picture at rest and with the mean of
    some, and the bounds of each alone.
    """

    one: float
    mean: float
    alone_one: float
    alone_mean: float
    bound_motion: float
    bound_all: float


Followed = Mapping[str, Mapping[int, np.ndarray]]
"""Method → cycles → distance of every point from the truth [P], px of a picture 320 wide."""


def panel(config: DriftConfig, subjects: Sequence[TrackedGel]) -> FieldSection:
    """Drift on every gel, long on the first; the noise of still pictures and its bounds."""
    followed = {subjects[0].rest.name: follow(subjects[0], config.cycles, METHODS)}
    followed |= {s.rest.name: follow(s, config.cycles_of_others, (MAIN,)) for s in subjects[1:]}
    still = {s.rest.name: still_error(s, config.pairs) for s in subjects}
    first = subjects[0].rest.name
    return FieldSection(
        verdict=(_verdict(followed, still, first),),
        requirements=_requirements(followed, still, first),
        tables=(_cycle_table(followed[first], first), _noise_table(followed, still)),
        pictures=(_picture(followed[first], still[first], first),),
    )


def follow(of: TrackedGel, cycles: Sequence[int], methods: Sequence[str]) -> Followed:
    """Methods through the last of the cycles, looked at after each of them."""
    film, motion = GelCamera(of.rest.picture, NOISE_GREY, _FIRST_SEED), of.motion(PEAK_PX, None)
    rest = grey(film.at_rest(1))
    followers = {name: FOLLOWERS[name](rest, of.points_px, of.half_px) for name in methods}
    shares = np.sin(2 * np.pi * np.arange(PERIOD) / PERIOD)
    cycle = [film.clean(motion.times(float(share)), abs(float(share))).astype(np.float32) for share in shares]
    errors: dict[str, dict[int, np.ndarray]] = {name: {} for name in methods}
    for i in range(1, PERIOD * max(cycles) + 1):
        picture = grey(film.exposed(cycle[i % PERIOD]))
        points = {name: one(picture) for name, one in followers.items()}
        if i % PERIOD == 0 and i // PERIOD in cycles:
            for name, at in points.items():
                errors[name][i // PERIOD] = np.hypot(*(at - of.points_px).T) / of.unit
    return errors


def still_error(of: TrackedGel, pairs: int) -> StillErrors:
    """What the package reads on pictures of a gel that does not move, and the least that it can be off by."""
    film = GelCamera(of.rest.picture, NOISE_GREY, _FIRST_SEED + 1)
    (one, alone_one), (mean, alone_mean) = (_pairs(of, film, n, pairs) for n in (1, REST_PICTURES))
    return StillErrors(
        one=one,
        mean=mean,
        alone_one=alone_one,
        alone_mean=alone_mean,
        bound_motion=bound_px(of, light_and_strain=False),
        bound_all=bound_px(of, light_and_strain=True),
    )


def bound_px(of: TrackedGel, light_and_strain: bool) -> float:
    """Cramér–Rao bound on a window's displacement between two noisy pictures, median over the windows, px.

        Cov d ≥ 2σ² [(Σ_r J_r J_rᵀ)⁻¹]_dd,   J = (∇I, and with unknown light and strain: ∇I ⊗ r, 1, r, I)

    Args:
      of: the gel; sums run over the windows that the package takes.
      light_and_strain: whether strain, brightness, its slope and contrast of the window are unknown too.

    Source: Kay, Fundamentals of Statistical Signal Processing I, 1993, ch. 3.
    """
    picture = (of.rest.picture.astype(np.float64) @ np.array(_LUMA)).round()
    side = np.arange(-of.half_px, of.half_px + 1)
    y, x = (a.ravel() for a in np.meshgrid(side, side, indexing="ij"))
    columns, rows = np.round(of.points_px).astype(int).T
    at = rows[:, None] + y, columns[:, None] + x
    down, across, level = (a[at] for a in (*np.gradient(picture), picture))
    unknown = [across, down]
    if light_and_strain:
        one = np.ones_like(level)
        unknown += [across * x, across * y, down * x, down * y, one, one * x, one * y, level]
    design = np.stack(unknown, -1)
    inverse = np.linalg.pinv(design.transpose(0, 2, 1) @ design, rcond=1e-12, hermitian=True)
    noise = (NOISE_GREY**2 + _ROUNDING) * float(np.sum(np.square(_LUMA))) + _ROUNDING
    spread = np.sqrt(2 * noise * np.trace(inverse[:, :2, :2], axis1=1, axis2=2))
    return float(_RAYLEIGH * np.median(spread)) / of.unit


def _pairs(of: TrackedGel, film: GelCamera, at_rest: int, pairs: int) -> list[float]:
    """Of all points together and of each alone, with the mean of so many pictures at rest."""
    errors: dict[str, list[np.ndarray]] = {MAIN: [], ALONE: []}
    for _ in range(pairs):
        rest, still = grey(film.at_rest(at_rest)), grey(film.at_rest(1))
        for name, found in errors.items():
            points = FOLLOWERS[name](rest, of.points_px, of.half_px)(still)
            found.append(np.hypot(*(points - of.points_px).T) / of.unit)
    return [float(np.nanmedian(found)) for found in errors.values()]


def _median(followed: Followed, method: str, cycles: int) -> float:
    return float(np.nanmedian(followed[method][cycles]))


def _pooled(followed: Mapping[str, Followed], method: str, cycles: int) -> float:
    return float(np.nanmedian(np.concatenate([by[method][cycles] for by in followed.values()])))


def _verdict(followed: Mapping[str, Followed], still: Mapping[str, StillErrors], first: str) -> str:
    by, last = followed[first], max(followed[first][MAIN])
    own, alone, peer = ([_median(by, name, c) for c in (1, PUBLISHED, last)] for name in (MAIN, ALONE, PEER))
    return (
        f"After 1, {PUBLISHED} and {last} cycles {first}'s markers are off by {own[0]:.4f}, {own[1]:.4f} and "
        f"{own[2]:.4f} px, each alone by {alone[0]:.4f}, {alone[1]:.4f} and {alone[2]:.4f}: no drift, but the noise of "
        f"a pair of pictures, which leaves each alone {still[first].bound_motion:.4f} at best.  From frame to frame "
        f"they are off by {peer[0]:.3f}, {peer[1]:.3f} and {peer[2]:.3f}."
    )


def _requirements(
    followed: Mapping[str, Followed], still: Mapping[str, StillErrors], first: str
) -> tuple[Requirement, ...]:
    growth = _pooled(followed, MAIN, PUBLISHED) - _pooled(followed, MAIN, 1)
    return (
        Requirement(
            name=f"off after 900 pictures, as published ({first}, one picture at rest)",
            measured=_median(followed[first], MAIN, PUBLISHED),
            bound=BOUND_PX,
            better="lower",
            unit="px",
            note=f"each marker alone {_median(followed[first], ALONE, PUBLISHED):.4f}, with the mean of "
            f"{REST_PICTURES} pictures at rest {still[first].alone_mean:.4f}",
        ),
        Requirement(
            name="growth from the first cycle to the tenth, all gels' markers",
            measured=growth,
            bound=BOUND_PX,
            better="lower",
            unit="px",
            note=f"after ten {_pooled(followed, MAIN, PUBLISHED):.4f}",
        ),
    )


def _cycle_table(followed: Followed, gel: str) -> Table:
    cycles = list(followed[MAIN])
    rows: list[tuple[Cell, ...]] = [
        (name, *(float(np.nanmedian(by[c])) for c in cycles), float(np.nanquantile(by[cycles[-1]], 0.95)))
        for name, by in followed.items()
    ]
    return Table(
        title=f"Off after so many cycles of {PERIOD} pictures, {gel}",
        columns=(
            Column(name="method"),
            *(Column(name=f"{c}", unit="px", format=".4f") for c in cycles),
            Column(name=f"{cycles[-1]}, 95 %", unit="px", format=".4f"),
        ),
        rows=tuple(rows),
        note="Median over markers, the gel at rest again; motion, noise and picture set nothing in the tracker.",
    )


def _noise_table(followed: Mapping[str, Followed], still: Mapping[str, StillErrors]) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (gel, *(_median(by, MAIN, c) for c in (1, PUBLISHED)), *dataclasses.astuple(still[gel]))
        for gel, by in followed.items()
    ]
    heads = (
        ("1 cycle", ""),
        ("10 cycles", ""),
        ("still", "pairs of still pictures, one of them at rest"),
        ("still, mean at rest", f"the picture at rest the mean of {REST_PICTURES}; recordings keep that of up to 100"),
        ("each alone, still", "without smoothing over the neighbours"),
        ("each alone, mean at rest", ""),
        ("bound of each alone", "Cramér–Rao, light and strain known"),
        ("the same, all unknown", "light and strain told from the same window"),
    )
    return Table(
        title="What is drift and what is noise",
        columns=(
            Column(name="gel"),
            *(Column(name=name, unit="px", format=".4f", meaning=meaning) for name, meaning in heads),
        ),
        rows=tuple(rows),
        note=f"Median over markers, pixels of a picture 320 wide; noise of {NOISE_GREY:g} grey levels.",
    )


def _picture(followed: Followed, still: StillErrors, gel: str) -> Picture:
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(6.6, 3.4), layout="constrained")
        axes = figure.subplots()
        for (name, by), colour in zip(followed.items(), PALETTE, strict=False):
            low, middle, high = np.array([np.nanquantile(e, (0.25, 0.5, 0.75)) for e in by.values()]).T
            axes.plot(list(by), middle, "o-", color=colour, ms=4, lw=1.4, label=name)
            axes.fill_between(list(by), low, high, color=colour, alpha=0.15, lw=0)
        axes.axhline(still.bound_motion, color="k", lw=1, ls=":", label="Cramér–Rao bound of each marker alone")
        axes.set(xscale="log", yscale="log", xlabel=f"cycles of {PERIOD} pictures", ylabel="off, px")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.legend(loc="best", fontsize=8)
        content = svg(figure)
    return Picture(
        name="fields_drift",
        title=f"What grows with time, {gel}",
        caption="Median and quartiles over the markers, the gel at rest again after every cycle.",
        content=content,
    )
