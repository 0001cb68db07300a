"""Image formation behind the gel: lamps over a gel, patterns on it, the camera's response.

A renderer turns the deformed gel, sampled on the image grid, and the light of the unit into RGB [H, W, 3] in 0..1.
Patterns are warped backwards: the picture at r shows the pattern at r − v, v = u − (u·∇)u, the second-order inverse of
r = r₀ + u(r₀), u the apparent motion.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, UInt8

Rgb = tuple[float, float, float]

CAMERA_DISTANCE_MM = 25.0
"""From the pupil to the gel surface: indentation brings markers nearer, which magnifies them about the centre."""


@struct.dataclass
class DeformedGel:
    """The gel on the image grid: indentation of the surface, and displacement (x, y, depth) of the marker plane, mm."""

    depth_mm: Float[Array, "H W"]
    marker_x_mm: Float[Array, "H W"]
    marker_y_mm: Float[Array, "H W"]
    marker_depth_mm: Float[Array, "H W"]
    window_mm: float = struct.field(pytree_node=False)

    @property
    def spacing_mm(self) -> float:
        """Pixel size."""
        return self.window_mm / self.depth_mm.shape[0]


@struct.dataclass
class Light:
    """Illumination of one unit at one time: overall exposure, gain of each of its three lights, printed pattern.

    The texture is that of the print or, where nothing is printed, the relative grain of the coating, per channel.
    """

    exposure: Float[Array, ""]
    led_gain: Float[Array, "3"]
    pattern_shift_mm: Float[Array, "2"]
    texture: Float[Array, "*C T T"]


def cubic_matrix(rows: int, columns: int) -> Array:
    """Separable cubic resampling from `columns` to `rows` samples of the same window, [rows, columns]."""
    return jax.image.resize(jnp.eye(columns, dtype=jnp.float32), (rows, columns), "cubic")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lamp:
    """One of the three lights inside a sensor.

    It brightens gel that rises along `angle_deg` (image frame), and lights the flat gel by
    floor + peak · exp(−(x−x₀)²/2w_x² − (y−y₀)²/2w_y²) in window coordinates −1..1.
    """

    colour: Rgb
    angle_deg: float
    floor: float
    peak: float = 0.0
    centre: tuple[float, float] = (0.0, 0.0)
    width: tuple[float, float] = (1.0, 1.0)


SOFT_LAMPS = (
    Lamp(colour=(0.50, 0.24, 0.22), angle_deg=0, floor=0.35, peak=0.25, centre=(0.6, 0.0)),
    Lamp(colour=(0.24, 0.46, 0.24), angle_deg=120, floor=0.35, peak=0.25, centre=(-0.3, 0.5)),
    Lamp(colour=(0.24, 0.26, 0.48), angle_deg=240, floor=0.35, peak=0.25, centre=(-0.3, -0.5)),
)
"""Coloured lamps at 120° of each other, each brighter on its own side: set by eye."""

WHITE_LAMPS = (
    Lamp(colour=(0.35, 0.33, 0.32), angle_deg=30, floor=0.65, peak=0.2),
    Lamp(colour=(0.32, 0.35, 0.32), angle_deg=150, floor=0.65, peak=0.2),
    Lamp(colour=(0.33, 0.33, 0.36), angle_deg=270, floor=0.65, peak=0.2),
)
"""Nearly white lamps, even over the gel: set by eye."""

DOT_PITCH_MM = (19.4 / 14, 30.8 / 26)
"""Between the dots of a Xense's print along x and y: the area over the grid of 14 × 26, margins being unpublished."""

DOT_RADIUS_MM, DOT_INK = 0.28, 0.86
"""Radius of a dot, a fifth to a quarter of the pitch, and the share of light that it takes: by eye."""

DOT_EDGE_PX = 0.5
"""Softness of a dot's edge: the blur of one pixel's area."""

SPECKLE_SPAN = 1.5
"""Side of a speckle texture in windows: a margin for all that shear and shift bring into view."""

SPECKLE_CONTRAST, SPECKLE_HARDNESS = 0.8, 1.8
"""Share of light that black speckle takes; how far the noise is driven into black and white: by eye."""

SPECKLE_BAND = 0.3
"""Width of the speckle's band of spatial frequencies, as a standard deviation, over the frequency of its grain."""

DOT_SLOPE_GAIN, SPECKLE_SLOPE_GAIN = 1.1, 0.5
"""Brightening of the gel by a slope towards a lamp; flatter light shows less relief: set by eye."""

BRIGHTEST = 3.0
"""Bound of a lamp's light on a slope, over that on the flat gel, that keeps a steep edge from outshining all else."""


def dots(
    gel: DeformedGel, light: Light, pitch_mm: tuple[float, float] = DOT_PITCH_MM, radius_mm: float = DOT_RADIUS_MM
) -> Float[Array, "H W 3"]:
    """Printed grid of dark dots over a softly lit gel (Xense): 14 × 26 on 19.4 × 30.8 mm."""
    skin = shade(gel, light, SOFT_LAMPS, slope_gain=DOT_SLOPE_GAIN)
    x, y = _pattern_coordinates(gel, light)
    away = jnp.hypot(*(c - p * jnp.round(c / p) for c, p in zip((x, y), pitch_mm, strict=True)))
    softness = DOT_EDGE_PX * gel.spacing_mm
    ink = jax.nn.sigmoid((radius_mm - away) / softness)[..., None]
    return skin * (1 - DOT_INK * ink)


def speckle(gel: DeformedGel, light: Light, contrast: float = SPECKLE_CONTRAST) -> Float[Array, "H W 3"]:
    """Dense random pattern over a nearly white, evenly lit gel (DM-Tac)."""
    skin = shade(gel, light, WHITE_LAMPS, slope_gain=SPECKLE_SLOPE_GAIN)
    size = light.texture.shape[0]
    x, y = _pattern_coordinates(gel, light)
    to_texel = (size - 1) / (SPECKLE_SPAN * gel.window_mm)
    at = [jnp.clip((c + SPECKLE_SPAN / 2 * gel.window_mm) * to_texel, 0, size - 1.001) for c in (y, x)]
    ink = jax.scipy.ndimage.map_coordinates(light.texture, at, order=1)[..., None]
    return skin * (1 - contrast * ink)


def speckle_texture(rng: np.random.Generator, size: int, grain_texels: float) -> np.ndarray:
    """Random pattern in 0..1, float32 [size, size]: band-limited noise, pushed towards black and white."""
    q = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None])
    band = np.exp(-((q * grain_texels - 1) ** 2) / (2 * SPECKLE_BAND**2))
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * band, s=(size, size))
    return (0.5 + 0.5 * np.tanh(SPECKLE_HARDNESS * noise / noise.std())).astype(np.float32)


def expose(
    image: Float[Array, "... H W 3"],
    noise: Float[Array, "... H W 3"],
    read_noise: Rgb | float,
    shot_noise: Rgb | float,
) -> UInt8[Array, "... H W 3"]:
    """Camera response: noise of standard deviation read + shot √I for unit normal `noise`, clipped to uint8.

    Both are of one channel each, or one number for all three.
    """
    read, shot = jnp.asarray(read_noise, jnp.float32), jnp.asarray(shot_noise, jnp.float32)
    noisy = image + (read + shot * jnp.sqrt(jnp.maximum(image, 0))) * noise
    return jnp.round(255 * jnp.clip(noisy, 0, 1)).astype(jnp.uint8)


def shade(gel: DeformedGel, light: Light, lamps: tuple[Lamp, ...], slope_gain: float) -> Float[Array, "H W 3"]:
    """Sum over lamps of gain · flat-field light · (n_z + slope_gain (l + l³/5) − |n_t|²/4) · colour.

    l is the component of the in-plane normal n_t along the lamp, n_z its component out of the plane.
    """
    d_y, d_x = jnp.gradient(gel.depth_mm, gel.spacing_mm)
    up = jax.lax.rsqrt(1 + d_x**2 + d_y**2)
    n_x, n_y = d_x * up, d_y * up
    x, y = _unit_coordinates(gel)
    image = jnp.zeros((*gel.depth_mm.shape, 3), jnp.float32)
    for lamp, gain in zip(lamps, light.led_gain, strict=True):
        angle = np.deg2rad(lamp.angle_deg)
        along = float(np.cos(angle)) * n_x + float(np.sin(angle)) * n_y
        away = ((x - lamp.centre[0]) / lamp.width[0]) ** 2 + ((y - lamp.centre[1]) / lamp.width[1]) ** 2
        flat = lamp.floor + lamp.peak * jnp.exp(-away / 2)
        lit = up + slope_gain * (along + along**3 / 5) - (n_x**2 + n_y**2) / 4
        image = image + (gain * flat * jnp.clip(lit, 0, BRIGHTEST))[..., None] * jnp.array(lamp.colour, jnp.float32)
    return light.exposure * image


def _unit_coordinates(gel: DeformedGel) -> tuple[Array, Array]:
    """x [1, W] and y [H, 1] in −1..1."""
    n = gel.depth_mm.shape[0]
    x = (jnp.arange(n, dtype=jnp.float32) + 0.5) * (2 / n) - 1
    return x[None, :], x[:, None]


def _pattern_coordinates(gel: DeformedGel, light: Light) -> tuple[Array, Array]:
    """Coordinates on the undeformed gel, in mm from its centre, that each pixel shows."""
    x, y = (c * (gel.window_mm / 2) for c in _unit_coordinates(gel))
    magnified = gel.marker_depth_mm / CAMERA_DISTANCE_MM
    u, v = gel.marker_x_mm + magnified * x, gel.marker_y_mm + magnified * y
    u_y, u_x = jnp.gradient(u, gel.spacing_mm)
    v_y, v_x = jnp.gradient(v, gel.spacing_mm)
    back_x, back_y = u - u * u_x - v * u_y, v - u * v_x - v * v_y
    return x - back_x - light.pattern_shift_mm[0], y - back_y - light.pattern_shift_mm[1]
