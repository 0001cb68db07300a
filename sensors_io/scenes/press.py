"""One press by one sensor, a single compiled program: skin → contact at every force → fields → pictures."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, UInt8

from sensors_io.scenes import contact, layer, optics, surface
from sensors_io.scenes.sensors import BODY, SensorModel

FIELD_GRID = 20
LOST_NODE_SHARE = 0.004
"""Share of field nodes that a frame cannot read."""


@struct.dataclass
class Unit:
    """One physical sensor: its gel's modulus relative to the model's, its light, the gains of its calibration."""

    modulus_factor: Float[Array, ""]
    light: optics.Light
    lateral_gain: Float[Array, ""]
    depth_gain: Float[Array, ""]


@struct.dataclass
class Press:
    """What is pressed: skin, pose, the object's effective modulus, the forces, the drift of exposure over the press."""

    skin: surface.Skin
    pose: surface.Pose
    modulus_mpa: Float[Array, ""]
    force_n: Float[Array, "F"]
    exposure_drift: Float[Array, ""]


@struct.dataclass
class Noise:
    """Unit normal noise of one press, drawn on the host, where it is faster, and which field nodes are lost.

    `pixels` is `None` without a camera; `nodes` is that of the fields' five channels, `plane` that of the depth field's
    zero plane: offset and two slopes.
    """

    pixels: Float[Array, "F H W 3"] | None
    nodes: Float[Array, "F 5 h w"]
    plane: Float[Array, "F 3"]
    lost: Bool[Array, "F h w"]


@struct.dataclass
class Recording:
    """What comes out, F frames: pictures, fields on the 20 × 20 grid, and the solver's account of every frame.

    `strain` is the greatest indentation over the gel's thickness; `border` says that contact reached the window's edge.
    """

    frames: UInt8[Array, "F H W 3"] | None
    deformation_mm: Float[Array, "F h w 2"]
    shear_mm: Float[Array, "F h w 2"]
    depth_mm: Float[Array, "F h w"]
    valid: Bool[Array, "F h w"]
    strain: Float[Array, "F"]
    border: Bool[Array, "F"]
    converged: Bool[Array, "F"]
    residual: Float[Array, "F"]
    iterations: Int[Array, "F"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Grid:
    """Sides of the contact grid and of the picture, in pixels."""

    contact_grid: int
    image_px: int


@struct.dataclass
class Kernels:
    """Spectra of one gel on its padded contact grid [M, M//2 + 1], mm/MPa, and the resampling matrices."""

    gel: Array
    body: Array
    marker_depth: Array
    marker_x: Array
    marker_y: Array
    to_image: Array
    to_field: Array


def padded_size(grid: int, window_mm: float, thickness_mm: float) -> int:
    """Least even 5-smooth number of pixels that leaves 2h between periodic images of the window."""
    size = int(np.ceil(grid * (1 + 2 * thickness_mm / window_mm)))
    while size % 2 or not _is_smooth(size):
        size += 1
    return size


@functools.lru_cache(maxsize=16)
def make_kernels(sensor: SensorModel, grid: Grid) -> Kernels:
    """Host-side float64 kernels of a sensor, stored float32.

    Odd kernels (lateral displacement) vanish at the Nyquist wave number, where they have no real representation.
    """
    spacing = sensor.window_mm / grid.contact_grid
    size = padded_size(grid.contact_grid, sensor.window_mm, sensor.gel.thickness_mm)
    q_y, q_x = layer.wave_numbers(size, spacing)
    q = np.hypot(q_y, q_x)
    markers = layer.depth_response(q, sensor.gel, sensor.marker_depth_mm or 0.0)
    nyquist = np.pi / spacing * (1 - 1e-9)
    odd = 1j * markers.lateral_pressure / np.where(q > 0, q, 1) * ((np.abs(q_y) < nyquist) & (q_x < nyquist))
    return Kernels(
        gel=jnp.asarray(layer.normal_compliance(q, sensor.gel), jnp.float32),
        body=jnp.asarray(layer.normal_compliance(q, BODY), jnp.float32),
        marker_depth=jnp.asarray(markers.normal_pressure, jnp.float32),
        marker_x=jnp.asarray(odd * q_x, jnp.complex64),
        marker_y=jnp.asarray(odd * q_y, jnp.complex64),
        to_image=optics.cubic_matrix(grid.image_px, grid.contact_grid),
        to_field=jnp.asarray(_node_matrix(grid.contact_grid)),
    )


def draw_noise(rng: np.random.Generator, frames: int, sensor: SensorModel, image_px: int) -> Noise:
    """Noise of one press of F frames."""
    cells = (FIELD_GRID, FIELD_GRID)
    shape = (frames, image_px, image_px, 3)
    return Noise(
        pixels=jnp.asarray(rng.standard_normal(shape, np.float32)) if sensor.render is not None else None,
        nodes=jnp.asarray(rng.standard_normal((frames, 5, *cells), np.float32)),
        plane=jnp.asarray(rng.standard_normal((frames, 3), np.float32)),
        lost=jnp.asarray(rng.random((frames, *cells), np.float32) < LOST_NODE_SHARE),
    )


@functools.partial(jax.jit, static_argnames=("sensor", "grid"))
def record(
    press: Press,
    unit: Unit,
    kernels: Kernels,
    noise: Noise,
    sensor: SensorModel,
    grid: Grid,
    tolerance: float = contact.TOLERANCE,
    max_iterations: int = contact.MAX_ITERATIONS,
) -> Recording:
    """Press, measure and photograph.

    Args:
      press: what is pressed, with F forces, N.
      unit: the physical sensor.
      kernels: `make_kernels(sensor, grid)`.
      noise: `draw_noise`.
      sensor: the sensor type.
      grid: sizes.
      tolerance: of the contact solver.
      max_iterations: its cap, past which `converged` is false.
    """
    spacing = sensor.window_mm / grid.contact_grid
    x = (jnp.arange(grid.contact_grid, dtype=jnp.float32) + 0.5) * spacing - sensor.window_mm / 2
    gap = surface.gap(press.skin, press.pose, x)
    gel, body = kernels.gel / unit.modulus_factor, kernels.body / press.modulus_mpa

    def solve(force: Array) -> contact.Contact:
        return contact.solve(gap, force, gel, body, spacing, tolerance, max_iterations)

    solved = jax.lax.map(solve, press.force_n)
    plane = _marker_plane(solved, kernels, unit, sensor)
    deformation, shear, depth = _measure(plane, unit, kernels, noise, sensor)
    edge = jnp.ones(gap.shape, bool).at[1:-1, 1:-1].set(False)
    return Recording(
        frames=_photograph(solved.displacement_mm, plane, press, unit, kernels, noise, sensor),
        deformation_mm=deformation,
        shear_mm=shear,
        depth_mm=depth,
        valid=~noise.lost,
        strain=jnp.max(solved.displacement_mm, (1, 2)) / sensor.gel.thickness_mm,
        border=jnp.any((solved.pressure_mpa > 0) & edge, (1, 2)),
        converged=solved.converged,
        residual=solved.residual,
        iterations=solved.iterations,
    )


def _marker_plane(solved: contact.Contact, kernels: Kernels, unit: Unit, sensor: SensorModel) -> Array:
    """Displacement (x, y, depth) of the marker plane, [F, 3, N, N]; a gel without markers has only its surface."""
    if sensor.marker_depth_mm is None:
        still = jnp.zeros_like(solved.displacement_mm)
        return jnp.stack([still, still, solved.displacement_mm], 1)
    spectra = jnp.stack([kernels.marker_x, kernels.marker_y, kernels.marker_depth.astype(jnp.complex64)])

    def respond(p: Array) -> Array:
        n, m = p.shape[0], spectra.shape[1]
        return jnp.fft.irfft2(jnp.fft.rfft2(p, s=(m, m)) * spectra, s=(m, m))[:, :n, :n] / unit.modulus_factor

    return jax.lax.map(respond, solved.pressure_mpa)


def _photograph(
    depth: Array, plane: Array, press: Press, unit: Unit, kernels: Kernels, noise: Noise, sensor: SensorModel
) -> Array | None:
    """Pictures [F, H, W, 3] uint8, `None` without a camera."""
    render = sensor.render
    if render is None or noise.pixels is None:
        return None
    frames = depth.shape[0]
    progress = jnp.arange(frames) / max(frames - 1, 1)

    def one(scene: tuple[Array, Array, Array, Array]) -> Array:
        depth, plane, progress, pixels = scene
        up = functools.partial(_resample, kernels.to_image)
        gel = optics.DeformedGel(
            depth_mm=up(depth),
            marker_x_mm=up(plane[0]),
            marker_y_mm=up(plane[1]),
            marker_depth_mm=up(plane[2]),
            window_mm=sensor.window_mm,
        )
        exposure = unit.light.exposure * (1 + press.exposure_drift * progress)
        light = dataclasses.replace(unit.light, exposure=exposure)
        return optics.expose(render(gel, light), pixels, sensor.read_noise, sensor.shot_noise)

    return jax.lax.map(one, (depth, plane, progress, noise.pixels))


def _measure(
    plane: Array, unit: Unit, kernels: Kernels, noise: Noise, sensor: SensorModel
) -> tuple[Array, Array, Array]:
    """Deformation, shear and depth as the sensor reports them: with its gains, drifting zero, noise and lost nodes.

    No tangential load acts, so the shear field holds noise alone.
    """
    nodes = _resample(kernels.to_field, plane)  # [F, 3, h, w]
    deformation = nodes[:, :2] * unit.lateral_gain + sensor.lateral_noise_mm * noise.nodes[:, :2]
    shear = sensor.lateral_noise_mm * noise.nodes[:, 2:4]
    x = jnp.linspace(-1, 1, FIELD_GRID)
    offset, slope_x, slope_y = 0.5 * sensor.depth_noise_mm * noise.plane.T[..., None, None]
    zero = offset + slope_x * x + slope_y * x[:, None]
    depth = nodes[:, 2] * unit.depth_gain + zero + sensor.depth_noise_mm * noise.nodes[:, 4]
    deformation, shear = (jnp.where(noise.lost[..., None], 0, jnp.moveaxis(f, 1, -1)) for f in (deformation, shear))
    return deformation, shear, jnp.where(noise.lost, 0, depth)


def _resample(matrix: Array, field: Array) -> Array:
    return matrix @ field @ matrix.T


def _node_matrix(grid: int) -> np.ndarray:
    """Linear interpolation from pixel centres to the centres of FIELD_GRID cells, [h, N] float32."""
    at = np.clip((np.arange(FIELD_GRID) + 0.5) * grid / FIELD_GRID - 0.5, 0, grid - 1)
    return np.maximum(1 - np.abs(at[:, None] - np.arange(grid)), 0).astype(np.float32)


def _is_smooth(size: int) -> bool:
    for prime in (2, 3, 5):
        while size % prime == 0:
            size //= prime
    return size == 1
