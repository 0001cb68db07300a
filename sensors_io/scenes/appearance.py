"""The RGB-D view of an object: what it seems to be made of, drawn from the apparent material alone.

Nothing in the picture depends on the true properties: colour, texture, gloss and relief follow the material that the
object looks like.  An honest object looks like what it is, so the view tells as much as the material's odds do.
"""

import dataclasses

import cv2
import numpy as np

from sensors_io.scenes.objects import PROTRUSION, ROUGHNESS
from sensors_io.schema import MATERIALS

VIEW_MM = 45.0
"""Side of the view."""

CAMERA_MM = 300.0
"""From the camera to the table."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Look:
    """How a material looks: ranges of hue, saturation and value (0..1), gloss, and the share of its texture in the value.

    `texture` names the drawing: plain, brushed, weave, mottle, pebble or grain.  `clear` is the share of background
    that shines through.
    """

    hue: tuple[float, float]
    saturation: tuple[float, float]
    value: tuple[float, float]
    gloss: float
    texture: str
    contrast: float
    clear: float = 0.0


LOOKS = {
    "plastic": Look(hue=(0, 1), saturation=(0.6, 0.95), value=(0.6, 0.95), gloss=0.5, texture="plain", contrast=0.02),
    "metal": Look(
        hue=(0.52, 0.66), saturation=(0.0, 0.1), value=(0.5, 0.75), gloss=0.9, texture="brushed", contrast=0.12
    ),
    "fabric": Look(hue=(0, 1), saturation=(0.25, 0.65), value=(0.35, 0.8), gloss=0.0, texture="weave", contrast=0.3),
    "food": Look(
        hue=(0.0, 0.28), saturation=(0.55, 0.9), value=(0.55, 0.9), gloss=0.25, texture="mottle", contrast=0.3
    ),
    "paper": Look(
        hue=(0.08, 0.16), saturation=(0.02, 0.2), value=(0.85, 0.98), gloss=0.03, texture="mottle", contrast=0.05
    ),
    "glass": Look(
        hue=(0.42, 0.58),
        saturation=(0.1, 0.3),
        value=(0.75, 0.95),
        gloss=1.0,
        texture="plain",
        contrast=0.01,
        clear=0.6,
    ),
    "leather": Look(
        hue=(0.02, 0.08), saturation=(0.4, 0.7), value=(0.15, 0.45), gloss=0.2, texture="pebble", contrast=0.35
    ),
    "wood": Look(hue=(0.06, 0.11), saturation=(0.4, 0.65), value=(0.45, 0.75), gloss=0.08, texture="grain", contrast=0.35),
    "other": Look(hue=(0, 1), saturation=(0.0, 0.5), value=(0.2, 0.9), gloss=0.2, texture="mottle", contrast=0.18),
}


def view(material: int, px: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Picture and depth map of an object that looks like `material`, seen from above.

    Args:
      material: index into `MATERIALS`.
      px: side of the view.
      rng: draws outline, colour, texture and the relief that is typical of the material.

    Returns:
      RGB uint8 [px, px, 3] and the distance from the camera, mm, float32 [px, px].
    """
    look = LOOKS[MATERIALS[material]]
    x = ((np.arange(px) + 0.5) / px - 0.5) * VIEW_MM
    height, inside = _shape(material, x[None, :], x[:, None], rng)
    albedo = _albedo(look, px, rng)
    table = _hsv(rng.random(), rng.uniform(0, 0.15), rng.uniform(0.3, 0.75)) * (1 + 0.03 * _smooth_noise(px, 3, rng))[..., None]
    body = look.clear * table + (1 - look.clear) * albedo
    lit = _light(body, height, look.gloss, rng)
    cover = inside[..., None]
    image = cover * lit + (1 - cover) * table * (1 - 0.35 * _shadow(inside))[..., None]
    noisy = image + 0.012 * rng.standard_normal(image.shape)
    depth = CAMERA_MM - height + 0.4 * rng.standard_normal(height.shape)
    return np.round(255 * np.clip(noisy, 0, 1)).astype(np.uint8), depth.astype(np.float32)


def _shape(material: int, x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Height above the table, mm, and soft cover 0..1 of a domed superellipse with the relief typical of the material."""
    turn, power = rng.uniform(0, np.pi), rng.uniform(2, 5)
    a = np.cos(turn) * x + np.sin(turn) * y
    b = np.cos(turn) * y - np.sin(turn) * x
    radius = (np.abs(a / rng.uniform(15, 20)) ** power + np.abs(b / rng.uniform(11, 18)) ** power) ** (1 / power)
    inside = np.clip((1 - radius) * 12 + 0.5, 0, 1)
    relief = PROTRUSION.value(PROTRUSION.means[material] + PROTRUSION.spread * rng.standard_normal())
    rough = ROUGHNESS.value(ROUGHNESS.means[material] + ROUGHNESS.spread * rng.standard_normal())
    pitch = rng.uniform(4, 7)
    bumps = 0.25 * (1 + np.cos(2 * np.pi * a / pitch)) * (1 + np.cos(2 * np.pi * b / pitch))
    px = inside.shape[0]
    height = 12 * np.sqrt(np.clip(1 - radius**2, 0, 1)) + relief * bumps + 2 * rough * _smooth_noise(px, 1, rng)
    return inside * height, inside


def _albedo(look: Look, px: int, rng: np.random.Generator) -> np.ndarray:
    """Colour without light, [px, px, 3]."""
    colour = _hsv(rng.uniform(*look.hue), rng.uniform(*look.saturation), rng.uniform(*look.value))
    return colour * (1 + look.contrast * _texture(look.texture, px, rng))[..., None]


def _texture(name: str, px: int, rng: np.random.Generator) -> np.ndarray:
    """Texture of about unit amplitude, [px, px]."""
    turn = rng.uniform(0, np.pi)
    i = np.arange(px) * (64 / px)
    a = np.cos(turn) * i[None, :] + np.sin(turn) * i[:, None]
    b = np.cos(turn) * i[:, None] - np.sin(turn) * i[None, :]
    if name == "plain":
        return _smooth_noise(px, 6, rng)
    if name == "brushed":
        streaks = cv2.resize(rng.standard_normal((px, 3)), (px, px), interpolation=cv2.INTER_LINEAR)
        return streaks if turn < np.pi / 2 else streaks.T
    if name == "weave":
        pitch = rng.uniform(3.2, 5)
        return np.sign(np.sin(np.pi * a / pitch) * np.sin(np.pi * b / pitch)) * 0.7 + 0.3 * _smooth_noise(px, 1, rng)
    if name == "mottle":
        return np.tanh(1.5 * _smooth_noise(px, 3, rng)) + 0.3 * _smooth_noise(px, 1, rng)
    if name == "pebble":
        return 1 - 2.2 * np.exp(-(_smooth_noise(px, 1.6, rng) ** 2) / 0.15)
    if name == "grain":
        return np.sin(2 * np.pi * (a + 4 * _smooth_noise(px, 9, rng)) / rng.uniform(5, 9)) + 0.3 * _smooth_noise(px, 1, rng)
    raise ValueError(f"texture is {name!r}: must be plain, brushed, weave, mottle, pebble or grain; correct the look")


def _light(albedo: np.ndarray, height: np.ndarray, gloss: float, rng: np.random.Generator) -> np.ndarray:
    """Lambert plus Blinn–Phong under one lamp and an ambient, [px, px, 3]."""
    d_y, d_x = np.gradient(height, VIEW_MM / height.shape[0])
    normal = np.stack([-d_x, -d_y, np.ones_like(d_x)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    azimuth = rng.uniform(0, 2 * np.pi)
    lamp = np.array([0.55 * np.cos(azimuth), 0.55 * np.sin(azimuth), 0.835])
    halfway = (lamp + [0, 0, 1]) / np.linalg.norm(lamp + [0, 0, 1])
    diffuse = 0.35 + 0.7 * np.clip(normal @ lamp, 0, 1)
    shine = 0.9 * gloss * np.clip(normal @ halfway, 0, 1) ** (8 + 60 * gloss)
    return albedo * diffuse[..., None] + shine[..., None]


def _shadow(inside: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(inside, (0, 0), inside.shape[0] / 20)


def _smooth_noise(px: int, scale_64: float, rng: np.random.Generator) -> np.ndarray:
    """Unit-variance noise with a correlation length of `scale_64` pixels of a 64-pixel view."""
    noise = cv2.GaussianBlur(rng.standard_normal((px, px)), (0, 0), scale_64 * px / 64)
    return noise / noise.std()


def _hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    pixel = np.array([[[360 * hue, saturation, value]]], np.float32)
    return cv2.cvtColor(pixel, cv2.COLOR_HSV2RGB)[0, 0].astype(np.float64)
