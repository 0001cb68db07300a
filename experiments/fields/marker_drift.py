"""Drift of tracked markers over long sequences, separated from the noise of single pictures.

A motion swings through rest and back in 90 pictures.  The published figures, 0.03 px from frame to frame and 0.006 px
anchored to the picture at rest, are the median distance of a GelSight Mini's markers from the truth after 900 pictures,
when the gel is at rest again, in pixels of a picture 320 wide; the picture at rest is a single one, as noisy as the
others.  The same is measured here on every gel, and for longer on the first.  A method anchored to the picture at rest
has the same error on a pair of still pictures.  No unbiased reading of one window can fall below its Cramér–Rao bound;
only neighbours that move together add information.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from experiments.core.results import ReportPart, Table, at_most, named_table
from experiments.fields.known_motion import NOISE_GREY, PEAK_PX, REST_PICTURES, GelCamera, MarkerGel, grey
from experiments.fields.trackers import FOLLOWERS

METHODS = ("this", "this, affine alone", "this, LK alone", "LK frame to frame")
MAIN, UNSMOOTHED, FRAME_TO_FRAME = METHODS[0], METHODS[1], METHODS[-1]
PERIOD, PUBLISHED = 90, 10  # pictures of a cycle; cycles of the published figures
CYCLES, OTHERS_CYCLES = (1, 2, 5, PUBLISHED, 30), (1, PUBLISHED)
"""Numbers of cycles after which the first gel and the others are measured."""

PAIRS, BOUND_PX = 10, 0.006  # pairs of still pictures; bound of the published error and of its growth
_FIRST_SEED = 450
_LUMA = (0.299, 0.587, 0.114)  # weights of the colours in grey
_ROUNDING = 1 / 12  # variance of rounding to whole grey levels
_RAYLEIGH = float(np.sqrt(np.log(2)))  # median length of an isotropic plane Gaussian over its root mean square

DriftErrors = Mapping[str, Mapping[int, np.ndarray]]
"""Method → cycles → distance of every point from the truth [P], px of a picture 320 wide."""


def drift_errors(gel: MarkerGel, cycles: Sequence[int], methods: Sequence[str], period: int = PERIOD) -> DriftErrors:
    """Errors of the methods after each of the given numbers of cycles, in one sequence of pictures."""
    camera, motion = GelCamera(gel.picture, NOISE_GREY, _FIRST_SEED), gel.motion(PEAK_PX, None)
    rest = grey(camera.at_rest(1))
    followers = {name: FOLLOWERS[name](rest, gel.points_px, gel.half_px) for name in methods}
    shares = np.sin(2 * np.pi * np.arange(period) / period)
    cycle = [camera.clean(motion.times(float(share)), abs(float(share))).astype(np.float32) for share in shares]
    errors: dict[str, dict[int, np.ndarray]] = {name: {} for name in methods}
    for i in range(1, period * max(cycles) + 1):
        picture = grey(camera.exposed(cycle[i % period]))
        points = {name: follow(picture) for name, follow in followers.items()}
        if i % period == 0 and i // period in cycles:
            for name, at in points.items():
                errors[name][i // period] = np.hypot(*(at - gel.points_px).T) / gel.unit
    return errors


def still_errors(gel: MarkerGel, pairs: int) -> dict[str, float]:
    """Median errors of the package on pictures of a gel that does not move, and their lower bounds, px."""
    camera = GelCamera(gel.picture, NOISE_GREY, _FIRST_SEED + 1)
    (one, alone_one), (mean, alone_mean) = (_pair_errors(gel, camera, n, pairs) for n in (1, REST_PICTURES))
    return {
        "still": one,
        "still, mean at rest": mean,
        "each alone, still": alone_one,
        "each alone, mean at rest": alone_mean,
        "bound of each alone": bound_px(gel, light_and_strain=False),
        "the same, all unknown": bound_px(gel, light_and_strain=True),
    }


def _pair_errors(gel: MarkerGel, camera: GelCamera, at_rest: int, pairs: int) -> list[float]:
    """Median errors with and without smoothing, with the mean of so many pictures at rest."""
    errors: dict[str, list[np.ndarray]] = {MAIN: [], UNSMOOTHED: []}
    for _ in range(pairs):
        rest, still = grey(camera.at_rest(at_rest)), grey(camera.at_rest(1))
        for name, found in errors.items():
            points = FOLLOWERS[name](rest, gel.points_px, gel.half_px)(still)
            found.append(np.hypot(*(points - gel.points_px).T) / gel.unit)
    return [float(np.nanmedian(found)) for found in errors.values()]


def bound_px(gel: MarkerGel, light_and_strain: bool) -> float:
    """Cramér–Rao bound on a window's displacement between two noisy pictures, median over the windows, px.

        Cov d ≥ 2σ² [(Σ_r J_r J_rᵀ)⁻¹]_dd,   J = (∇I, and with unknown light and strain: ∇I ⊗ r, 1, r, I)

    Sums run over the windows that the package takes; with `light_and_strain` their strain, brightness, its slope and
    contrast are unknown too.

    Source: Kay, Fundamentals of Statistical Signal Processing I, 1993, ch. 3.
    """
    picture = (gel.picture.astype(np.float64) @ np.array(_LUMA)).round()
    side = np.arange(-gel.half_px, gel.half_px + 1)
    y, x = (a.ravel() for a in np.meshgrid(side, side, indexing="ij"))
    columns, rows = np.round(gel.points_px).astype(int).T
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
    return float(_RAYLEIGH * np.median(spread)) / gel.unit


def drift_section(
    gels: Sequence[MarkerGel], cycles: Sequence[int] = CYCLES, pairs: int = PAIRS, period: int = PERIOD
) -> list[ReportPart]:
    """Drift on every gel, long on the first; the noise of still pictures and its bounds."""
    first = gels[0].name
    drift = {first: drift_errors(gels[0], cycles, METHODS, period)}
    drift |= {g.name: drift_errors(g, OTHERS_CYCLES, (MAIN,), period) for g in gels[1:]}
    still = {g.name: still_errors(g, pairs) for g in gels}
    bound = still[first]["bound of each alone"]
    medians = {m: [_median(drift[first], m, c) for c in (1, PUBLISHED, max(cycles))] for m in METHODS}
    own, alone, peer = (medians[name] for name in (MAIN, UNSMOOTHED, FRAME_TO_FRAME))
    pooled = lambda cycles: float(np.nanmedian(np.concatenate([errors[MAIN][cycles] for errors in drift.values()])))
    return [
        f"After 1 and {max(cycles)} cycles the drift of {first}'s markers is {own[0]:.4f} and {own[2]:.4f} px (lower "
        f"bound of a single marker's noise {bound:.4f} px); tracking from frame to frame drifts by {peer[0]:.3f} and "
        f"{peer[2]:.3f} px.",
        at_most(
            f"off after 900 pictures, as published ({first}, one picture at rest)",
            own[1],
            BOUND_PX,
            "px",
            note=f"each marker alone {alone[1]:.4f}, with the mean of {REST_PICTURES} pictures at rest "
            f"{still[first]['each alone, mean at rest']:.4f}",
        ),
        at_most(
            "growth from the first cycle to the tenth, all gels' markers",
            pooled(PUBLISHED) - pooled(1),
            BOUND_PX,
            "px",
            note=f"after ten {pooled(PUBLISHED):.4f}",
        ),
        _cycle_table(drift[first], first),
        _noise_table(drift, still),
    ]


def _median(errors: DriftErrors, method: str, cycles: int) -> float:
    return float(np.nanmedian(errors[method][cycles]))


def _cycle_table(errors: DriftErrors, gel: str) -> Table:
    last = max(errors[MAIN])
    rows = [
        {f"{c}": _median(errors, name, c) for c in by_cycle}
        | {f"{last}, 95 %": float(np.nanquantile(by_cycle[last], 0.95))}
        for name, by_cycle in errors.items()
    ]
    return named_table(
        f"Drift after cycles of {PERIOD} pictures, {gel}",
        [{"method": name, **row} for name, row in zip(errors, rows, strict=True)],
        formats=dict.fromkeys(rows[0], ".4f"),
        units=dict.fromkeys(rows[0], "px"),
        note="Median over markers, the gel at rest again; none of the tracker's settings was chosen on this motion, "
        "noise or picture.",
    )


def _noise_table(drift: Mapping[str, DriftErrors], still: Mapping[str, Mapping[str, float]]) -> Table:
    rows = [
        {"1 cycle": _median(errors, MAIN, 1), "10 cycles": _median(errors, MAIN, PUBLISHED), **still[gel]}
        for gel, errors in drift.items()
    ]
    return named_table(
        "What is drift and what is noise",
        [{"gel": gel, **row} for gel, row in zip(drift, rows, strict=True)],
        formats=dict.fromkeys(rows[0], ".4f"),
        units=dict.fromkeys(rows[0], "px"),
        meanings={
            "still": "pairs of still pictures, one of them at rest",
            "still, mean at rest": f"the picture at rest is the mean of {REST_PICTURES}; recordings keep that of up to "
            "100",
            "each alone, still": "without smoothing over the neighbours",
            "bound of each alone": "Cramér–Rao, light and strain known",
            "the same, all unknown": "light and strain estimated from the same window",
        },
        note=f"Median over markers, pixels of a picture 320 wide; noise of {NOISE_GREY:g} grey levels.",
    )
