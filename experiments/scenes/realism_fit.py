"""Real and generated pictures of the same touches: recordings of a GelSight Mini, the fit, renderings, shadows."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np

from experiments.core.context import Context
from experiments.core.errors import ResultsError, require
from sensors_io.calibration import circles
from sensors_io.calibration.presses import BallPresses as Recorded
from sensors_io.scenes import fitting, mini_optics, optics, photometric
from sensors_io.scenes.fitting import BallPictures, Noise, Profiles
from sensors_io.scenes.optics import DeformedGel, Lamp, Light
from sensors_io.scenes.photometric import PhotometricOptics
from sensors_io.scenes.sensors import GELSIGHT_MINI, Renderer

BY_EYE = (
    Lamp(colour=(1, 0.04, 0.06), angle_deg=90, floor=0.16, peak=0.35, width=(0.9, 0.5)),
    Lamp(colour=(0.04, 1, 0.08), angle_deg=210, floor=0.28, peak=0.10, width=(0.8, 0.9)),
    Lamp(colour=(0.04, 0.10, 1), angle_deg=330, floor=0.22, peak=0.30, centre=(0, -0.2), width=(1.0, 0.65)),
)
"""The earlier optics of the generator: lamps set by eye to published pictures, with the noise below."""

BALL, DIAMETER_MM, MM_PER_PX = "6.310mm", 6.31, 0.0634
"""Folder and diameter of the ball of the recordings, and their pixel."""

BY_EYE_NOISE = Noise(read=(0.004,) * 3, shot=(0.008,) * 3, grain=(0.0,) * 3, shared=0.0)


class RenderCandidate(NamedTuple):
    """A renderer and its noise."""

    render: Renderer
    noise: Noise


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressFit:
    """The held-out presses and what was fitted to the others."""

    presses: BallPictures
    profiles: Profiles
    touches: np.ndarray
    held_out: np.ndarray
    fitted: PhotometricOptics
    noise: Noise


def read(data_dir: Path | None, image_px: int) -> BallPictures:
    """The square middles of the recordings in `data_dir`, shrunk by area to `image_px` pixels a side.

    Raises:
      ResultsError: no directory, a file that is missing or no picture, too few presses, frames that are not landscape.
    """
    fix = "give --data-dir the folder that holds background.png"
    if data_dir is None:
        raise ResultsError(f"data_dir is None: must name the folder of the recordings; {fix}")
    paths = sorted((data_dir / BALL).glob("*/gelsight.png"), key=lambda path: int(path.parent.name))
    found = f"{len(paths)} pictures {BALL}/<i>/gelsight.png"
    require(len(paths) >= 16, f"data_dir {data_dir}", found, "must hold at least 16", fix)
    pictures = [_square(path, image_px) for path in [data_dir / "background.png", *paths]]
    height = _read(paths[0]).shape[0]
    return BallPictures(
        pictures=np.stack(pictures[1:]),
        background=pictures[0],
        radius_mm=DIAMETER_MM / 2,
        mm_per_px=MM_PER_PX * height / image_px,
    )


def fit(presses: BallPictures, context: Context) -> PressFit:
    """Fit to the even presses, align the odd ones."""
    with context.progress("fitting", 2 + fitting.ROUNDS + 1) as advance:
        profiles = fitting.ball_profiles(GELSIGHT_MINI.gel, presses.radius_mm)
        advance(note="the ball is solved")
        train = np.arange(0, len(presses.pictures), 2)
        begun = located(presses, train)
        advance(note="circles are found")
        fitted, touches = fitting.fit_jointly(presses, profiles, begun, train, lambda done, total: advance())
    chosen = dataclasses.replace(presses, pictures=presses.pictures[train])
    return PressFit(
        presses=presses,
        profiles=profiles,
        touches=touches,
        held_out=np.arange(1, len(presses.pictures), 2),
        fitted=fitted,
        noise=fitting.measure_noise(chosen, touches[train], fitted),
    )


def located(presses: BallPictures, train: np.ndarray) -> np.ndarray:
    """Touches (x, y, contact radius), mm, [P, 3], by calibration's finder; held-out ones by the others' optics."""
    whole = Recorded(
        pictures=np.round(255 * presses.pictures).astype(np.uint8),
        background=np.round(255 * presses.background).astype(np.uint8),
        radius_mm=presses.radius_mm,
        mm_per_px=presses.mm_per_px,
    )
    found = circles.find_circles(whole.chosen(train))
    rows = circles.align_circles(whole, found.optics).touches.stacked()
    rows[train] = found.touches.stacked()
    rows[:, :2] -= (len(presses.axis_mm) - 1) / 2
    return rows * presses.mm_per_px


def candidates(study: PressFit) -> dict[str, RenderCandidate]:
    """Renderers to compare, from the first optics to the fit of this run."""
    stored = Noise(
        read=GELSIGHT_MINI.read_noise,
        shot=GELSIGHT_MINI.shot_noise,
        grain=mini_optics.GRAIN,
        shared=mini_optics.GRAIN_SHARED,
    )
    by_eye = lambda gel, light: optics.shade(gel, light, BY_EYE, slope_gain=2.0)
    fitted = lambda gel, light: photometric.shade(gel, light, study.fitted)
    return {
        "lamps by eye": RenderCandidate(by_eye, BY_EYE_NOISE),
        "fitted optics, old noise": RenderCandidate(fitted, BY_EYE_NOISE),
        "fitted optics and noise": RenderCandidate(fitted, dataclasses.replace(study.noise, grain=(0.0,) * 3)),
        "fitted, with grain": RenderCandidate(fitted, study.noise),
        "as stored in the generator": RenderCandidate(photometric.gelsight_mini, stored),
    }


def render(study: PressFit, candidate: RenderCandidate) -> np.ndarray:
    """The held-out presses by one candidate, uint8 [P, N, N, 3]; one unit, whose grain they share."""
    rng, n = np.random.default_rng(0), study.presses.pictures.shape[1]
    light = _light(photometric.grain(rng, n, candidate.noise.grain, candidate.noise.shared))
    made = []
    for touch in study.touches[study.held_out]:
        noise = jnp.asarray(rng.standard_normal((n, n, 3), np.float32))
        image = candidate.render(gel(study, touch), light)
        made.append(np.asarray(optics.expose(image, noise, candidate.noise.read, candidate.noise.shot)))
    return np.stack(made)


def gel(study: PressFit, touch: np.ndarray) -> DeformedGel:
    """The gel under the ball at one touch."""
    axis = study.presses.axis_mm
    depth, _, _ = study.profiles.field(touch, axis[None, :], axis[:, None])
    still = jnp.zeros(depth.shape, jnp.float32)
    return DeformedGel(
        depth_mm=jnp.asarray(depth, jnp.float32),
        marker_x_mm=still,
        marker_y_mm=still,
        marker_depth_mm=still,
        window_mm=study.presses.window_mm,
    )


def clean(study: PressFit, model: PhotometricOptics) -> np.ndarray:
    """Held-out presses without noise or grain."""
    light = _light(np.zeros((2, 2), np.float32))
    return np.stack([photometric.shade(gel(study, t), light, model) for t in study.touches[study.held_out]])


def source(fitted: PhotometricOptics, noise: Noise, presses: BallPictures) -> str:
    """The constants as a Python module."""
    scalars: dict[str, object] = {"HALF_WINDOW_MM": fitted.half_window_mm, "MAX_TILT": fitted.max_tilt}
    scalars |= {"READ_NOISE": noise.read, "SHOT_NOISE": noise.shot, "GRAIN": noise.grain, "GRAIN_SHARED": noise.shared}
    lines = [f"{name} = {round(v, 4) if isinstance(v, float) else v}" for name, v in scalars.items()]
    for name in ("depth", "slope", "flat"):
        rows = "".join(f"    {row},\n" for row in getattr(fitted, name))
        lines.append(f"{name.upper()} = (\n{rows})")
    doc = SOURCE_DOC.format(presses=(len(presses.pictures) + 1) // 2, ball=2 * presses.radius_mm)
    return doc + "\n".join(lines) + "\n"


SOURCE_DOC = '''"""Constants of a real GelSight Mini, fitted by `python -m experiments scene_realism`; not to be edited.

From {presses} presses of a ball of {ball:.2f} mm and one picture of the gel at rest, 320 × 240 px of 0.0634 mm, shrunk
to 112 px a side: github.com/rpl-cmu/gelslam at e0ea7ded95c2288fcb8dc18bc806fce270fac483, MIT licence.  They are
documented in `photometric` and `fitting.Noise`.
"""

'''


def _square(path: Path, px: int) -> np.ndarray:
    image = _read(path)
    height, width = image.shape[:2]
    require(width >= height, "picture", f"{path} {width} × {height}", "must be landscape", "turn it")
    left = (width - height) // 2
    middle = image[:, left : left + height, ::-1].astype(np.float32) / 255
    return cv2.resize(middle, (px, px), interpolation=cv2.INTER_AREA).astype(np.float64)


def _read(path: Path) -> np.ndarray:
    """BGR uint8 [H, W, 3]."""
    image = cv2.imread(str(path))
    if image is None:
        raise ResultsError(f"picture is {path}: it is missing or no picture; restore the file")
    return image


def _light(texture: np.ndarray) -> Light:
    return Light(
        exposure=jnp.ones(()), led_gain=jnp.ones(3), pattern_shift_mm=jnp.zeros(2), texture=jnp.asarray(texture)
    )


ELEVATIONS_DEG = (10.0, 20.0, 35.0)
DIRECTIONS = 8
REACH_MM = np.linspace(0.25, 4.0, 12)  # distances along the ray to the lamp at which the gel may stand in its way


def shadow_gain(study: PressFit, context: Context) -> dict[str, float]:
    """Regress the residual on shadow depths from eight sides and three elevations, and test on the held-out presses.

        s_θα(r) = max_t (u(r + t θ) − u(r) − t tan α)₊

    is the height of the gel above the ray from r to a lamp in direction θ at elevation α.  Each channel may darken
    by any combination of them, which is more than lamps at fixed places could do: the share is an upper bound.

    Returns:
      `explained`, the share of the residual variance of the held-out presses; `residual_levels` and `left_levels`, its
      standard deviation without and with shadows, in grey levels.
    """
    size = DIRECTIONS * len(ELEVATIONS_DEG)
    normal, right, held_out = np.zeros((size, size)), np.zeros((size, 3)), []
    for i, touch in context.each("shadows", enumerate(study.touches)):
        rows, left = _shadows(study, touch), residual(study, i)
        if i in study.held_out:
            held_out.append((rows, left))
        else:
            normal, right = normal + rows.T @ rows, right + rows.T @ left
    ridge = fitting.RIDGE * np.trace(normal) * np.eye(len(normal))
    weights = np.linalg.solve(normal + ridge, right)
    before = np.concatenate([left for _, left in held_out])
    after = np.concatenate([left - rows @ weights for rows, left in held_out])
    return {
        "explained": float(1 - after.var() / before.var()),
        "residual_levels": float(255 * before.std()),
        "left_levels": float(255 * after.std()),
    }


def _shadows(study: PressFit, touch: np.ndarray) -> np.ndarray:
    """s at the pixels near a touch, [n, directions × elevations]."""
    x, y = fitting.points(study.presses.axis_mm, touch)
    here = study.profiles.field(touch, x, y)[0]
    found = []
    for angle in 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS:
        ray = x + REACH_MM[:, None] * np.cos(angle), y + REACH_MM[:, None] * np.sin(angle)
        above = study.profiles.field(touch, *ray)[0] - here
        tangents = np.tan(np.deg2rad(ELEVATIONS_DEG))
        found += [np.maximum(above - REACH_MM[:, None] * tangent, 0).max(0) for tangent in tangents]
    return np.stack(found, -1)


def residual(study: PressFit, i: int) -> np.ndarray:
    """Change near touch `i` that the fitted optics do not explain, [n, 3]."""
    presses, touch = study.presses, study.touches[i]
    made = fitting.change(study.fitted, study.profiles, touch, presses.axis_mm, presses.window_mm)
    return (presses.pictures[i] - presses.background - made)[fitting.near(presses.axis_mm, touch)]
