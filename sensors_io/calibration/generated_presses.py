"""Generated presses of a ball, under the optics that calibration assumes and under lamps that it cannot model."""

import functools
from collections.abc import Callable

import cv2
import numpy as np

from sensors_io.calibration.presses import BallPresses
from sensors_io.layer import Layer
from sensors_io.scenes import fitting, photometric
from sensors_io.scenes.fitting import Profiles

WINDOW_PX, WINDOW_MM = 160, 15.2  # side of the pictures
AXIS_MM = (np.arange(WINDOW_PX) - (WINDOW_PX - 1) / 2) * (WINDOW_MM / WINDOW_PX)
"""Centres of the pixels along a side, from the window's centre."""

GEL = Layer(modulus_mpa=0.37, poisson=0.48, thickness_mm=4.5)

NOISE_GREY = 1.2  # standard deviation of the camera's noise in grey levels, fitted to the real camera
_WIDEST_RADII, _WIDEST_MM = 0.6, 2.2  # contact radius, in ball radii and at all

Optics = Callable[[Profiles, np.ndarray | None, np.ndarray], np.ndarray]
"""From the ball's profiles, a touch (x, y, contact radius; `None` at rest) and the pixels' axis [N], mm, to a picture
[N, N, 3] without noise, in which 1 is the brightest value of the camera.
"""

LAMP_ROWS = ((90.0, (1.0, 0.08, 0.05)), (210.0, (0.10, 1.0, 0.10)), (330.0, (0.05, 0.12, 1.0)))
"""Direction of each row of lamps from the window's centre, degrees, and its colour with the filters' crosstalk."""

_ROW_MM, _LAMPS, _HALF_ROW_MM = 11.0, 5, 6.0  # distance of a row from the centre, lamps in it, half its length
_LAMP_HEIGHT_MM, _CAMERA_MM = 7.0, 25.0  # over the gel at rest
_GLOSS, _GLOSS_EXPONENT = 0.25, 12.0  # of the coating (Blinn–Phong), against 1 of matte light
_FLAT, _GAMMA, _BLUR_PX = 0.35, 1.4, 1.0  # brightness of the untouched centre, the camera's curve, the lens


def fitted_optics(profiles: Profiles, touch: np.ndarray | None, axis_mm: np.ndarray) -> np.ndarray:
    """Optics of the generator, linear in (n_x, n_y, n_x², n_x n_y, n_y², u) and fitted to a real GelSight Mini."""
    flat = photometric.fields(photometric.MINI, len(axis_mm), WINDOW_MM)[0].transpose(1, 2, 0)
    return flat if touch is None else flat + fitting.change(photometric.MINI, profiles, touch, axis_mm, WINDOW_MM)


def near_lamps(profiles: Profiles, touch: np.ndarray | None, axis_mm: np.ndarray) -> np.ndarray:
    """Three rows of point lamps next to the window, over a glossy coating.

        I = (v Σ_lamps colour (max(0, n·l) + g max(0, n·h)^m) / d²)^(1/γ)

    n is the normal, l and d are direction and distance of a lamp from the *indented* surface, h lies half-way between
    l and the view, v is the vignette.  I is neither linear in n nor polynomial in the place; sides that face away are
    black.
    """
    x, y = axis_mm[None, :], axis_mm[:, None]
    depth, d_x, d_y = np.zeros((3, len(axis_mm), len(axis_mm))) if touch is None else profiles.field(touch, x, y)
    normal = np.stack([-d_x, -d_y, np.ones_like(depth)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    at = np.stack(np.broadcast_arrays(x, y, depth), -1)
    light = _light(at, normal) / _light(np.zeros(3), np.array([0.0, 0.0, 1.0])).max()
    vignette = (1 + (x**2 + y**2) / _CAMERA_MM**2) ** -2
    seen = (_FLAT * light * vignette[..., None]) ** (1 / _GAMMA)
    return cv2.GaussianBlur(seen, (0, 0), _BLUR_PX)


def _light(at_mm: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Light in three colours […, 3] from points […, 3] with unit normals […, 3] to the camera."""
    total = np.zeros(at_mm.shape)
    for degrees, colour in LAMP_ROWS:
        out = np.array([np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))])
        for along in np.linspace(-_HALF_ROW_MM, _HALF_ROW_MM, _LAMPS):
            lamp = np.array([*(_ROW_MM * out + along * np.array([-out[1], out[0]])), _LAMP_HEIGHT_MM])
            towards = lamp - at_mm
            square = (towards**2).sum(-1, keepdims=True)
            towards = towards / np.sqrt(square)
            half = towards + np.array([0.0, 0.0, 1.0])
            half /= np.linalg.norm(half, axis=-1, keepdims=True)
            matte, gloss = (np.maximum((normal * way).sum(-1, keepdims=True), 0) for way in (towards, half))
            total += (matte + _GLOSS * gloss**_GLOSS_EXPONENT) / square * np.array(colour)
    return total


def generated_presses(diameter_mm: float, count: int, seed: int, optics: Optics = fitted_optics) -> BallPresses:
    """Presses at random places of the window; the gel's shape is that of the solved elastic layer.

    Args:
      diameter_mm: of the ball.
      count: presses.
      seed: of touches and noise.
      optics: of the sensor.
    """
    rng = np.random.default_rng(seed)
    profiles = ball_profiles(diameter_mm)
    widest = min(_WIDEST_RADII * diameter_mm / 2, _WIDEST_MM)

    def picture() -> np.ndarray:
        touch = np.array([*rng.uniform(-5, 5, 2), rng.uniform(0.8, 1.0) * widest])
        shaded = 255 * optics(profiles, touch, AXIS_MM)
        return to_bytes(shaded + NOISE_GREY * rng.standard_normal(shaded.shape))

    return BallPresses(
        pictures=np.stack([picture() for _ in range(count)]),
        background=to_bytes(255 * optics(profiles, None, AXIS_MM)),
        radius_mm=diameter_mm / 2,
        mm_per_px=WINDOW_MM / WINDOW_PX,
    )


@functools.lru_cache(maxsize=8)
def ball_profiles(diameter_mm: float) -> Profiles:
    """Shapes of the gel under a ball at every contact radius, solved once for each ball."""
    return fitting.ball_profiles(GEL, diameter_mm / 2)


def to_bytes(picture: np.ndarray) -> np.ndarray:
    """Grey levels as a camera stores them, uint8."""
    return np.clip(picture, 0, 255).round().astype(np.uint8)
