"""The RGB-D view of an object: what it seems to be made of, drawn from the apparent material alone.

Nothing in the picture depends on the true properties: colour, texture, gloss and relief follow the material that the
object looks like.  An honest object looks like what it is, so the view shows as much as the odds of the material do.
"""

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np

from sensors_io.scenes.properties import PROTRUSION, ROUGHNESS

VIEW_MM = 45.0
"""Side of the view."""

CAMERA_MM = 300.0
"""From the camera to the table."""

TEXTURE_PX = 64
"""Side of the view in whose pixels the lengths of textures are given, so that they do not depend on its resolution."""

OUTLINE_POWER = (2.0, 5.0)
"""Range of a superellipse's exponent, from an ellipse to nearly a rectangle."""

HALF_AXES_MM = (15.0, 20.0), (11.0, 18.0)
"""Ranges of the half axes of the outline, which stays on a view of 45 mm."""

DOME_MM, EDGE = 12.0, 12.0
"""Height of the dome in the middle; steepness of the cover at the outline, per half axis: about two pixels of 64."""

RELIEF_PITCH_MM = (4.0, 7.0)
"""Range of the distance between the bumps that a camera sees, on the whole coarser than those that a gel feels."""

TABLE_SATURATION, TABLE_VALUE, TABLE_GRAIN = (0.0, 0.15), (0.3, 0.75), 0.03
"""Ranges of the table's colour, grey and neither black nor white, and the standard deviation of its grain."""

SHADOW, SHADOW_SHARPNESS = 0.35, 20.0
"""Share of light that the object's shadow takes from the table, and the side of the view over the shadow's blur."""

AMBIENT, LAMP, SHINE = 0.35, 0.7, 0.9
"""Light from everywhere, from the lamp, and in the highlight of a mirror: a lit flat side comes out at 0.93."""

LAMP_SIDE, LAMP_UP = 0.55, 0.835
"""Parts of the lamp's direction, of length 1, along the table and off it: 33° from the vertical."""

SHARPNESS = (8.0, 60.0)
"""Blinn–Phong exponent of a dull surface, and what gloss adds to it."""

PICTURE_NOISE, DEPTH_NOISE_MM = 0.012, 0.4
"""Standard deviations of an RGB-D camera's noise at this distance: three of 255 grey levels, 0.13 %."""

# These, the looks below and the numbers in their textures are set by eye: no measurement stands behind them, and
# nothing is asked of the pictures but that the materials differ in them.


Texture = Callable[[int, np.random.Generator], np.ndarray]
"""Draws a texture of about unit amplitude on [px, px]."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MaterialLook:
    """Appearance of a material: ranges of hue, saturation and value (0..1), gloss, texture and its share in the value.

    `clear` is the share of the background that shines through.
    """

    hue: tuple[float, float]
    saturation: tuple[float, float]
    value: tuple[float, float]
    gloss: float
    texture: Texture
    contrast: float
    clear: float = 0.0


def _smooth_noise(px: int, scale_64: float, rng: np.random.Generator) -> np.ndarray:
    """Unit-variance noise with a correlation length of `scale_64` pixels of a view of `TEXTURE_PX`."""
    noise = cv2.GaussianBlur(rng.standard_normal((px, px)), (0, 0), scale_64 * px / TEXTURE_PX)
    return noise / noise.std()


def _plain(px: int, rng: np.random.Generator) -> np.ndarray:
    return _smooth_noise(px, 6, rng)


def _mottle(px: int, rng: np.random.Generator) -> np.ndarray:
    return np.tanh(1.5 * _smooth_noise(px, 3, rng)) + 0.3 * _smooth_noise(px, 1, rng)


def _pebble(px: int, rng: np.random.Generator) -> np.ndarray:
    return 1 - 2.2 * np.exp(-(_smooth_noise(px, 1.6, rng) ** 2) / 0.15)


def _brushed(px: int, rng: np.random.Generator) -> np.ndarray:
    streaks = cv2.resize(rng.standard_normal((px, 3)), (px, px), interpolation=cv2.INTER_LINEAR)
    return streaks if rng.random() < 0.5 else streaks.T


def _weave(px: int, rng: np.random.Generator) -> np.ndarray:
    a, b = _turned_pixels(px, rng)
    pitch = rng.uniform(3.2, 5)
    return 0.7 * np.sign(np.sin(np.pi * a / pitch) * np.sin(np.pi * b / pitch)) + 0.3 * _smooth_noise(px, 1, rng)


def _grain(px: int, rng: np.random.Generator) -> np.ndarray:
    a, _ = _turned_pixels(px, rng)
    rings = np.sin(2 * np.pi * (a + 4 * _smooth_noise(px, 9, rng)) / rng.uniform(5, 9))
    return rings + 0.3 * _smooth_noise(px, 1, rng)


def _turned_pixels(px: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates along two random perpendicular axes, in pixels of a view of `TEXTURE_PX`."""
    turn, i = rng.uniform(0, np.pi), np.arange(px) * (TEXTURE_PX / px)
    c, s = np.cos(turn), np.sin(turn)
    return c * i[None, :] + s * i[:, None], c * i[:, None] - s * i[None, :]


LOOKS = (
    MaterialLook(hue=(0, 1), saturation=(0.6, 0.95), value=(0.6, 0.95), gloss=0.5, texture=_plain, contrast=0.02),
    MaterialLook(hue=(0.52, 0.66), saturation=(0, 0.1), value=(0.5, 0.75), gloss=0.9, texture=_brushed, contrast=0.12),
    MaterialLook(hue=(0, 1), saturation=(0.25, 0.65), value=(0.35, 0.8), gloss=0.0, texture=_weave, contrast=0.3),
    MaterialLook(hue=(0, 0.28), saturation=(0.55, 0.9), value=(0.55, 0.9), gloss=0.25, texture=_mottle, contrast=0.3),
    MaterialLook(
        hue=(0.08, 0.16), saturation=(0.02, 0.2), value=(0.85, 0.98), gloss=0.03, texture=_mottle, contrast=0.05
    ),
    MaterialLook(
        hue=(0.42, 0.58), saturation=(0.1, 0.3), value=(0.75, 0.95), gloss=1, texture=_plain, contrast=0.01, clear=0.6
    ),
    MaterialLook(
        hue=(0.02, 0.08), saturation=(0.4, 0.7), value=(0.15, 0.45), gloss=0.2, texture=_pebble, contrast=0.35
    ),
    MaterialLook(
        hue=(0.06, 0.11), saturation=(0.4, 0.65), value=(0.45, 0.75), gloss=0.08, texture=_grain, contrast=0.35
    ),
    MaterialLook(hue=(0, 1), saturation=(0, 0.5), value=(0.2, 0.9), gloss=0.2, texture=_mottle, contrast=0.18),
)
"""In the order of `MATERIALS`: plastic, metal, fabric, food, paper, glass, leather, wood, other."""


def view(material: int, px: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Picture and depth map of an object that looks like `material`, seen from above.

    Args:
      material: index into `schema.MATERIALS`.
      px: side of the view.
      rng: draws outline, colour, texture and the relief that is typical of the material.

    Returns:
      RGB uint8 [px, px, 3] and the distance from the camera, mm, float32 [px, px].
    """
    look = LOOKS[material]
    x = ((np.arange(px) + 0.5) / px - 0.5) * VIEW_MM
    height, inside = _shape(material, x[None, :], x[:, None], rng)
    albedo = _albedo(look, px, rng)
    table = _hsv(rng.random(), rng.uniform(*TABLE_SATURATION), rng.uniform(*TABLE_VALUE))
    table = table * (1 + TABLE_GRAIN * _smooth_noise(px, 3, rng))[..., None]
    body = look.clear * table + (1 - look.clear) * albedo
    lit = _light(body, height, look.gloss, rng)
    cover = inside[..., None]
    image = cover * lit + (1 - cover) * table * (1 - SHADOW * _shadow(inside))[..., None]
    noisy = image + PICTURE_NOISE * rng.standard_normal(image.shape)
    depth = CAMERA_MM - height + DEPTH_NOISE_MM * rng.standard_normal(height.shape)
    return np.round(255 * np.clip(noisy, 0, 1)).astype(np.uint8), depth.astype(np.float32)


def _shape(material: int, x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Height, mm, and soft cover 0..1 of a domed superellipse with the relief typical of the material."""
    turn, power = rng.uniform(0, np.pi), rng.uniform(*OUTLINE_POWER)
    a = np.cos(turn) * x + np.sin(turn) * y
    b = np.cos(turn) * y - np.sin(turn) * x
    half_a, half_b = (rng.uniform(*span) for span in HALF_AXES_MM)
    radius = (np.abs(a / half_a) ** power + np.abs(b / half_b) ** power) ** (1 / power)
    inside = np.clip((1 - radius) * EDGE + 0.5, 0, 1)
    relief = PROTRUSION.value(PROTRUSION.means[material] + PROTRUSION.spread * rng.standard_normal())
    rough = ROUGHNESS.value(ROUGHNESS.means[material] + ROUGHNESS.spread * rng.standard_normal())
    pitch = rng.uniform(*RELIEF_PITCH_MM)
    bumps = 0.25 * (1 + np.cos(2 * np.pi * a / pitch)) * (1 + np.cos(2 * np.pi * b / pitch))
    px = inside.shape[0]
    height = DOME_MM * np.sqrt(np.clip(1 - radius**2, 0, 1)) + relief * bumps + 2 * rough * _smooth_noise(px, 1, rng)
    return inside * height, inside


def _albedo(look: MaterialLook, px: int, rng: np.random.Generator) -> np.ndarray:
    """Colour without light, [px, px, 3]."""
    colour = _hsv(rng.uniform(*look.hue), rng.uniform(*look.saturation), rng.uniform(*look.value))
    return colour * (1 + look.contrast * look.texture(px, rng))[..., None]


def _light(albedo: np.ndarray, height: np.ndarray, gloss: float, rng: np.random.Generator) -> np.ndarray:
    """Lambert plus Blinn–Phong under one lamp and an ambient, [px, px, 3]."""
    d_y, d_x = np.gradient(height, VIEW_MM / height.shape[0])
    normal = np.stack([-d_x, -d_y, np.ones_like(d_x)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    azimuth = rng.uniform(0, 2 * np.pi)
    lamp = np.array([LAMP_SIDE * np.cos(azimuth), LAMP_SIDE * np.sin(azimuth), LAMP_UP])
    halfway = lamp + np.array([0.0, 0.0, 1.0])
    halfway /= np.linalg.norm(halfway)
    diffuse = AMBIENT + LAMP * np.clip(normal @ lamp, 0, 1)
    shine = SHINE * gloss * np.clip(normal @ halfway, 0, 1) ** (SHARPNESS[0] + SHARPNESS[1] * gloss)
    return albedo * diffuse[..., None] + shine[..., None]


def _shadow(inside: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(inside, (0, 0), inside.shape[0] / SHADOW_SHARPNESS)


def _hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    pixel = np.array([[[360 * hue, saturation, value]]], np.float32)
    return cv2.cvtColor(pixel, cv2.COLOR_HSV2RGB)[0, 0].astype(np.float64)
