"""From presses of a ball to a calibration with its held-out error, or a refusal that says what is wrong."""

import dataclasses
from collections.abc import Callable

import numpy as np

from sensors_io.calibration.circles import Circles, find_circles
from sensors_io.calibration.coverage import coverage
from sensors_io.calibration.fit import prepare, solve_map
from sensors_io.calibration.presses import BallPresses, Touches
from sensors_io.calibration.validate import BallErrors, cross_validate
from sensors_io.fields.contact import ContactConfig, steepest_change
from sensors_io.fields.types import Calibration, CalibrationError

_STRIDE, _STRONG = 4, 8.0  # pixels that the colours are judged by: every so many, of changes beyond noise, grey levels


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrateConfig:
    """Requirements on a set of presses.

    Args:
      least_presses: that remain after bad ones are left out.
      folds, repeats: of the held-out errors, by press; the presses are divided anew in each repeat.
      most_misfit: share of a press's change that a ball may leave unexplained.
      most_saturated: share of the contact's pixels with a channel at 255.
      most_drift: grey levels that a picture may differ from the background by its median, which contact hardly moves.
      window_mm: between which the longer side of the pictures must lie at their pitch; the four sensors show 15 to 31
        mm, and of 14 to 30 mm a pitch that is wrong by a factor of 3 makes too little or too much.
      least_colours: rms of the second principal component of the changes of colour against that of the first; eleven
        recordings of lamps of several colours have 0.41 to 0.96, two sensors of one light 0.08 to 0.10.
      contact_radii: between which the median contact radius must lie, in ball radii.
      most_depth_um, most_radius: held-out errors beyond which nothing was learnt.
      sure_depth_um, sure_radius, sure_bias: held-out errors of depth and radius, and the part of the latter that all
        presses share, beyond which a warning says that the map will not transfer to other objects.
      sure_cover: share of the window that presses must cover, below which a warning says where to press.
    """

    least_presses: int = 8
    folds: int = 5
    repeats: int = 8
    most_misfit: float = 0.7
    most_saturated: float = 0.5
    most_drift: float = 40.0
    window_mm: tuple[float, float] = (10.0, 40.0)
    least_colours: float = 0.2
    contact_radii: tuple[float, float] = (0.15, 0.95)
    most_depth_um: float = 60.0
    most_radius: float = 0.25
    sure_depth_um: float = 20.0
    sure_radius: float = 0.05
    sure_bias: float = 0.03
    sure_cover: float = 0.8
    seed: int = 0

    def __post_init__(self) -> None:
        least = {"least_presses": 2, "folds": 2, "repeats": 1}
        for name, value in dataclasses.asdict(self).items():
            if isinstance(value, tuple) and not 0 <= value[0] < value[1]:
                raise ValueError(f"{name} is {value}: must be two numbers that rise from 0 or above; correct it")
            if not isinstance(value, tuple) and not value >= least.get(name, 0):
                raise ValueError(f"{name} is {value}: must be ≥ {least.get(name, 0)}; raise it")


@dataclasses.dataclass(frozen=True, kw_only=True)
class UnusedPress:
    """A press that was not used, and why."""

    name: str
    reason: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class CalibrationReport:
    """Origin of a calibration: presses used and left out, their contacts, λ of the prior, errors on unseen presses.

    `warnings` say why the map may not transfer to other objects or places, and what to do.
    """

    kept: tuple[str, ...]
    left_out: tuple[UnusedPress, ...]
    touches: Touches
    misfit: np.ndarray
    ridge: float
    errors: BallErrors
    warnings: tuple[str, ...] = ()


def calibrate(
    presses: BallPresses,
    names: tuple[str, ...],
    sensor: str,
    config: CalibrateConfig | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Calibration, CalibrationReport]:
    """Find circles, leave bad presses out, fit the map, measure it on held-out presses.

    The result is the same, bit by bit, whatever the order of the presses.

    Args:
      presses: the pictures.
      names: of the presses, for the report.
      sensor: canonical name that the calibration is for.
      config: limits.
      progress: called with the number of fits done and of all: one of all presses, one for each fold.

    Raises:
      CalibrationError: a set that nothing can be learnt from; it says why and what to do.
    """
    config = config or CalibrateConfig()
    _check_window(presses, config)
    _check_colours(presses, config)
    bad = _copies(presses, names) | {i: why for i in range(len(presses)) if (why := _unusable(presses, i, config))}
    good = _enough(presses, names, bad, config)
    circles = find_circles(presses.chosen(good))
    bad |= {int(good[i]): reason for i, reason in _misfits(presses.chosen(good), circles, config).items()}
    if len(remaining := _enough(presses, names, bad, config)) < len(good):
        circles = find_circles(presses.chosen(remaining))
    kept = presses.chosen(remaining)
    _check_size(kept, circles.touches, config)
    config = dataclasses.replace(config, folds=min(config.folds, len(kept)))
    equations = prepare(kept, circles.touches, seed=config.seed, folds=config.folds)
    colours, ridge = solve_map(equations.grams, seed=config.seed, folds=config.folds)
    progress(1, fits := 1 + config.folds * config.repeats)
    errors = cross_validate(
        kept,
        sensor,
        folds=config.folds,
        repeats=config.repeats,
        seed=config.seed,
        equations=equations,
        progress=lambda done: progress(1 + done, fits),
    )
    _check_errors(errors, config)
    report = CalibrationReport(
        kept=tuple(names[i] for i in remaining),
        left_out=tuple(UnusedPress(name=names[i], reason=reason) for i, reason in sorted(bad.items())),
        touches=Touches.of(equations.touches.stacked()[equations.given]),
        misfit=circles.misfit,
        ridge=ridge,
        errors=errors,
        warnings=_warnings(errors, equations.touches, kept.shape, config),
    )
    made_from = {"ball_diameter_mm": 2 * presses.radius_mm, **{f"held-out {k}": v for k, v in errors.figures().items()}}
    made = Calibration(
        sensor=sensor, background=presses.background, mm_per_px=presses.mm_per_px, colours=colours, made_from=made_from
    )
    return made, report


def _copies(presses: BallPresses, names: tuple[str, ...]) -> dict[int, str]:
    """Presses that are there already: a copy would be held out from a map that has seen it."""
    first: dict[bytes, int] = {}
    copies = {i: first[key] for i, key in enumerate(presses.hashes()) if first.setdefault(key, i) != i}
    return {i: f"is a copy of {names[of]}" for i, of in copies.items()}


def _unusable(presses: BallPresses, i: int, config: CalibrateConfig) -> str:
    """Why a picture is no press at all, empty if it may be one."""
    picture, contact = presses.pictures[i], ContactConfig()
    drift = float(np.abs(np.median(picture.astype(np.int16) - presses.background, axis=(0, 1))).max())
    if drift > config.most_drift:
        return f"differs from the background by {drift:.0f} grey levels everywhere: must be ≤ {config.most_drift:.0f}"
    steep = steepest_change(picture, presses.background, presses.mm_per_px, contact.smoothing_mm)
    if steep < contact.steepness:
        return f"shows no contact: its steepest change is {steep:.0f} grey levels/mm, must be ≥ {contact.steepness:.0f}"
    return ""


def _misfits(presses: BallPresses, circles: Circles, config: CalibrateConfig) -> dict[int, str]:
    """Presses that no ball explains, or whose contact is saturated."""
    y, x = np.mgrid[: presses.shape[0], : presses.shape[1]]
    found = {}
    for i, (row, misfit) in enumerate(zip(circles.touches.stacked(), circles.misfit, strict=True)):
        inside = np.hypot(x - row[0], y - row[1]) < row[2]
        share = float((presses.pictures[i][inside] == 255).any(-1).mean()) if inside.any() else 0.0
        if not inside.any():
            found[i] = "has its contact outside the picture"
        elif misfit > config.most_misfit:
            found[i] = f"is no ball: {misfit:.0%} of its change stay unexplained, must be ≤ {config.most_misfit:.0%}"
        elif share > config.most_saturated:
            found[i] = f"is saturated in {share:.0%} of its contact: must be ≤ {config.most_saturated:.0%}"
    return found


def _enough(presses: BallPresses, names: tuple[str, ...], bad: dict[int, str], config: CalibrateConfig) -> np.ndarray:
    """Indices of the presses that are left.

    Raises:
      CalibrationError: too few, with the reasons of those left out.
    """
    good = np.array([i for i in range(len(presses)) if i not in bad], np.int64)
    if len(good) < config.least_presses:
        reasons = "".join(f"\n  {names[i]} {reason}" for i, reason in sorted(bad.items()))
        raise CalibrationError(
            f"{len(good)} of {len(presses)} presses can be used: must be ≥ {config.least_presses}; press the ball "
            f"{config.least_presses} times or more, all over the window{reasons}"
        )
    return good


def _check_window(presses: BallPresses, config: CalibrateConfig) -> None:
    """A window of the size of a coin or of a hand is a wrong pitch, such as that of pictures of another resolution.

    Measure the sensing window; images alone do not determine scale.
    """
    low, high = config.window_mm
    rows_mm, columns_mm = (side * presses.mm_per_px for side in presses.shape)
    if not low <= max(rows_mm, columns_mm) <= high:
        raise CalibrationError(
            f"pictures of {presses.shape[1]} × {presses.shape[0]} px show {columns_mm:.1f} × {rows_mm:.1f} mm at "
            f"--mm-per-px {presses.mm_per_px:g}: the longer side must lie in [{low:g}, {high:g}] mm; measure the "
            "window and divide by the pixels of these pictures, or set --window-mm for a sensor of another size"
        )


def _check_colours(presses: BallPresses, config: CalibrateConfig) -> None:
    """Under lamps of one colour all channels change alike, and a change does not show the direction of a slope."""
    change = presses.pictures[:, ::_STRIDE, ::_STRIDE].astype(np.float32) - presses.background[::_STRIDE, ::_STRIDE]
    change = change.reshape(-1, 3) - np.median(change, axis=(0, 1, 2))
    strong = change[np.abs(change).max(1) > _STRONG]
    if not len(strong):
        return  # no contact at all, which is reported for each press
    _, second, first = np.sqrt(np.maximum(np.linalg.eigvalsh(strong.T @ strong / len(strong)), 0))
    if second < config.least_colours * first:
        raise CalibrationError(
            f"the colours of the presses change alike: their second component is {second / first:.2f} of the first, "
            f"must be ≥ {config.least_colours:g}; slopes need lamps of several colours from several sides. A sensor of "
            "one light shows depth as darkness: read it by its maker's table from grey level to depth, or by one from "
            "a press of a ball, as sensors_io/README.md says; here `extract` gives its contacts without a calibration, "
            "and its shear where the gel has markers"
        )


def _check_size(presses: BallPresses, touches: Touches, config: CalibrateConfig) -> None:
    """A contact nearly as wide as the ball, or a speck, means a wrong diameter or pitch.

    A diameter that is wrong by less passes: it scales all slopes and depths alike, and the pictures stay as well
    explained.  Presses of four real sensors, taken for balls of 0.7 to 1.4 times their diameter, left least unexplained
    anywhere between 0.7 and 1.2.
    """
    share = float(np.median(touches.radius_px)) * presses.mm_per_px / presses.radius_mm
    low, high = config.contact_radii
    if not low <= share <= high:
        raise CalibrationError(
            f"contact radius is {share:.2f} ball radii (median): must lie in [{low}, {high}]; "
            f"check --ball-diameter-mm ({2 * presses.radius_mm:g}) and --mm-per-px ({presses.mm_per_px:g})"
        )


def _warnings(errors: BallErrors, touches: Touches, shape: tuple[int, int], config: CalibrateConfig) -> tuple[str, ...]:
    """Why the map may not transfer, and what to do about it."""
    figures, problems = errors.figures(), []
    radius, bias = (figures[f"radius error {name}, %"] / 100 for name in ("median", "of the median"))
    depth_um = figures["depth rmse median, um"]
    if radius > config.sure_radius or depth_um > config.sure_depth_um:
        problems.append(
            f"the map will not transfer: unseen presses have a radius error of {radius:.1%} and a depth error of "
            f"{depth_um:.0f} um, must be ≤ {config.sure_radius:.1%} and ≤ {config.sure_depth_um:.0f} um; press more "
            "often, all over the window, with contacts of several sizes, none wider than 0.8 ball radii"
        )
    if abs(bias) > config.sure_bias:
        problems.append(
            f"slopes are {'steep' if bias < 0 else 'flat'}: unseen balls come out {abs(bias):.1%} too "
            f"{'small' if bias < 0 else 'large'}, must be ≤ {config.sure_bias:.1%}; check the ball's diameter, and "
            "that camera, lamps and background are those of the presses"
        )
    seen = coverage(touches, shape)
    if seen.share < config.sure_cover:
        problems.append(
            f"presses cover {seen.share:.0%} of the window, must be ≥ {config.sure_cover:.0%}: the map is extrapolated "
            f"in {seen.where()}; press there, at about ({seen.next_px[0]:.0f}, {seen.next_px[1]:.0f}) px"
        )
    return tuple(problems)


def _check_errors(errors: BallErrors, config: CalibrateConfig) -> None:
    figures = errors.figures()
    depth, radius = figures["depth rmse median, um"], figures["radius error median, %"]
    if not (depth <= config.most_depth_um and radius <= 100 * config.most_radius):
        raise CalibrationError(
            f"held-out balls come out with a depth error of {depth:.0f} um and a radius error of {radius:.0f} %: must "
            f"be ≤ {config.most_depth_um:.0f} um and ≤ {100 * config.most_radius:.0f} %; press one rigid ball, keep "
            "the lamps and the camera's settings as they were, record the background anew"
        )
