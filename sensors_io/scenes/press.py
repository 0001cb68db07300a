"""One contact by one sensor over time, a single compiled program: skin → pressure → traction → fields → pictures."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Complex, Float, Int, UInt8, UInt32

from sensors_io import layer
from sensors_io.scenes import contact, drag, failures, motions, noise, readout, surface, traction
from sensors_io.scenes.readout import FrameFields, Gel, Resampling, Unit
from sensors_io.scenes.sensors import BODY, SensorModel


@struct.dataclass
class Path:
    """Path of the hand over F frames, in the gel's frame; the arrays are those of `motions.Plan`.

    `force_n` is the elastic force, at which the contact is solved; 0 where nothing touches.
    """

    force_n: Float[Array, "F"]
    slide_mm: Float[Array, "F 2"]
    twist_rad: Float[Array, "F"]
    tilt_rad: Float[Array, "F 2"]


@struct.dataclass
class Press:
    """Touched object: skin, pose, effective modulus and friction, path, drift of exposure over it."""

    skin: surface.Skin
    pose: surface.SensorPose
    modulus_mpa: Float[Array, ""]
    friction: Float[Array, ""]
    path: Path
    exposure_drift: Float[Array, ""]


@struct.dataclass
class SensorRecording:
    """Result of F frames: pictures, fields on the 20 × 20 grid, load, and the solver's report on every frame.

    Force and moment act on the gel, about the window's centre.  `strain` is the greatest indentation over the gel's
    thickness; `failures` are the bits of `failures.flags`.
    """

    frames: UInt8[Array, "F H W 3"] | None
    fields: FrameFields
    force_n: Float[Array, "F 3"]
    moment_nmm: Float[Array, "F 3"]
    strain: Float[Array, "F"]
    failures: UInt32[Array, "F"]
    converged: Bool[Array, "F"]
    residual: Float[Array, "F"]
    iterations: Int[Array, "F"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class GridSizes:
    """Sides of the contact grid and of the picture, in pixels."""

    contact_grid: int
    image_px: int


@struct.dataclass
class Kernels:
    """Spectra of one gel on its padded contact grid, mm/MPa, of the object per MPa, and the resampling matrices.

    `gel_lateral` and `body_lateral`, the displacement along the surface by pressure, couple friction to the pressure;
    `None` leaves that out.
    """

    gel: Float[Array, "M K"]
    body: Float[Array, "M K"]
    gel_shear: traction.Compliance
    body_shear: traction.Compliance
    gel_lateral: Complex[Array, "M M"] | None
    body_lateral: Complex[Array, "M M"] | None
    markers: traction.Response
    resampling: Resampling


def padded_size(grid: int, window_mm: float, thickness_mm: float) -> int:
    """Least even 5-smooth number of pixels that leaves 2h between periodic images of the window."""
    size = int(np.ceil(grid * (1 + 2 * thickness_mm / window_mm)))
    while size % 2 or not _is_smooth(size):
        size += 1
    return size


@functools.lru_cache(maxsize=16)
def make_kernels(sensor: SensorModel, grid: GridSizes, *, coupled: bool = False) -> Kernels:
    """Kernels of a sensor, made in float64 on the host and kept in float32; `coupled` as in `SceneConfig`."""
    spacing = sensor.window_mm / grid.contact_grid
    size = padded_size(grid.contact_grid, sensor.window_mm, sensor.gel.thickness_mm)
    q = np.hypot(*layer.wave_numbers(size, spacing))
    return Kernels(
        gel=jnp.asarray(layer.normal_compliance(q, sensor.gel), jnp.float32),
        body=jnp.asarray(layer.normal_compliance(q, BODY), jnp.float32),
        gel_shear=traction.make_compliance(sensor.gel, size, spacing),
        body_shear=traction.make_compliance(BODY, size, spacing),
        gel_lateral=traction.make_coupling(sensor.gel, size, spacing) if coupled else None,
        body_lateral=traction.make_coupling(BODY, size, spacing) if coupled else None,
        markers=traction.make_response(sensor.gel, size, spacing, sensor.marker_depth_mm or 0.0),
        resampling=readout.make_resampling(grid.contact_grid, grid.image_px),
    )


@functools.partial(jax.jit, static_argnames=("sensor", "grid", "moving"))
def record(
    press: Press,
    unit: Unit,
    kernels: Kernels,
    key: UInt32[Array, "2"],
    sensor: SensorModel,
    grid: GridSizes,
    tolerance: float = contact.TOLERANCE,
    max_iterations: int = contact.MAX_ITERATIONS,
    *,
    moving: bool = False,
) -> SensorRecording:
    """Touch, measure and photograph.

    Args:
      press: what is touched, with a path of F frames.
      unit: the physical sensor.
      kernels: `make_kernels(sensor, grid)`; coupled ones let also a press that stands feel friction, if `moving`.
      key: of all noise, `noise.key`.
      sensor: the sensor type.
      grid: sizes.
      tolerance: of the contact solver.
      max_iterations: its cap, past which `converged` is false.
      moving: whether the object slides, twists or rolls.  Without, it is taken to stand where it was put, and what
        little traction the spreading gel feels is left out.
    """
    scene = Scene(press, unit, kernels, sensor, grid, (tolerance, max_iterations))
    count = press.path.force_n.shape[0]
    exposure = 1 + press.exposure_drift * jnp.arange(count) / max(count - 1, 1)
    keys = jax.vmap(noise.fold, (None, 0))(key, jnp.arange(count))
    if not moving:
        gap = scene.gap(jax.tree.map(lambda leaf: leaf[0], press.path))

        def press_on(frame: tuple[Path, Array, Array]) -> SensorRecording:
            path, exposure, key = frame
            return scene.see(scene.solve(gap, path.force_n), None, exposure, key)

        return jax.lax.map(press_on, (press.path, exposure, keys))

    def move_on(
        history: drag.History, frame: tuple[Path, Array, Array, drag.RigidMotion]
    ) -> tuple[drag.History, SensorRecording]:
        path, exposure, key, step = frame
        solved = scene.solve(scene.gap(path), path.force_n)
        history, dragged = scene.drag(history, solved, step)
        seen = scene.see(solved, dragged.traction_mpa, exposure, key)
        return history, dataclasses.replace(seen, converged=seen.converged & dragged.converged)

    inputs = (press.path, exposure, keys, _steps(press))
    return jax.lax.scan(move_on, drag.at_rest(grid.contact_grid), inputs)[1]


@dataclasses.dataclass(frozen=True)
class Scene:
    """One sensor over one object, while it is traced; `limits` are tolerance and cap of the contact solver."""

    press: Press
    unit: Unit
    kernels: Kernels
    sensor: SensorModel
    grid: GridSizes
    limits: tuple[float, int]

    @property
    def spacing(self) -> float:
        return self.sensor.window_mm / self.grid.contact_grid

    @property
    def x(self) -> Array:
        """Pixel centres along both axes."""
        return (jnp.arange(self.grid.contact_grid, dtype=jnp.float32) + 0.5) * self.spacing - self.sensor.window_mm / 2

    def gap(self, at: Path) -> Array:
        """Distance of the undeformed skin from the gel in one frame."""
        pose = motions.moved(self.press.pose, at.slide_mm, at.twist_rad, at.tilt_rad)
        return surface.gap(self.press.skin, pose, self.x)

    def solve(self, gap: Array, force_n: Array) -> contact.Contact:
        """The normal contact; without force nothing is pressed and nothing can fail."""
        gel, body = self.kernels.gel / self.unit.modulus_factor, self.kernels.body / self.press.modulus_mpa
        touches = force_n > 0
        iterations = jnp.where(touches, self.limits[1], 0)
        force = jnp.where(touches, force_n, 1.0)
        thickness = self.sensor.gel.thickness_mm
        solved = contact.solve(gap, force, gel, body, self.spacing, self.limits[0], iterations, thickness_mm=thickness)
        return dataclasses.replace(
            solved,
            pressure_mpa=jnp.where(touches, solved.pressure_mpa, 0),
            displacement_mm=jnp.where(touches, solved.displacement_mm, 0),
            converged=solved.converged | ~touches,
            strain=jnp.where(touches, solved.strain, 0),
        )

    def drag(
        self, history: drag.History, solved: contact.Contact, step: drag.RigidMotion
    ) -> tuple[drag.History, drag.Frame]:
        """The traction of this frame."""
        series = traction.in_series(
            self.kernels.gel_shear, self.kernels.body_shear, self.unit.modulus_factor, self.press.modulus_mpa
        )
        bodies = drag.Bodies(compliance=series, coupling=self._coupling(), response=self.kernels.markers)
        return drag.advance(history, solved.pressure_mpa, self.press.friction, step, bodies, self.x)

    def _coupling(self) -> Array | None:
        """By how much the gel's surface moves more by pressure than the object's."""
        gel, body = self.kernels.gel_lateral, self.kernels.body_lateral
        if gel is None or body is None:
            return None
        return gel / self.unit.modulus_factor - body / self.press.modulus_mpa

    def see(self, solved: contact.Contact, slip: Array | None, exposure: Array, key: Array) -> SensorRecording:
        """Everything that is recorded of one frame under pressure and traction."""
        gel = self._gel(solved, slip)
        carried = jnp.zeros(solved.pressure_mpa.shape, jnp.complex64) if slip is None else slip
        force, moment = traction.resultant(solved.pressure_mpa, carried, self.x, self.spacing)
        picture = readout.photograph(gel, self.unit, exposure, self.kernels.resampling, key, self.sensor)
        fields = readout.measure(gel, self.unit, self.kernels.resampling, key, self.sensor)
        failed = failures.flags(
            saturated=jnp.zeros((), bool) if picture is None else failures.saturated(picture),
            marker_loss=failures.marker_loss(fields.valid),
            border_contact=failures.border_contact(solved.pressure_mpa),
        )
        return SensorRecording(
            frames=picture,
            fields=fields,
            force_n=force,
            moment_nmm=moment,
            strain=solved.strain,
            failures=failed,
            converged=solved.converged,
            residual=solved.residual,
            iterations=solved.iterations,
        )

    def _gel(self, solved: contact.Contact, slip: Array | None) -> Gel:
        depth, pressure, response = solved.displacement_mm, solved.pressure_mpa, self.kernels.markers
        still = jnp.zeros(depth.shape, jnp.complex64)
        if self.sensor.marker_depth_mm is None:
            return Gel(depth_mm=depth, marker_depth_mm=depth, markers_mm=still, shear_mm=still)
        if slip is None:
            along = traction.lateral_displacement(pressure, response.lateral)
            into, sheared = contact.convolve(pressure, response.depth), still
        else:
            along, into = traction.displacement(pressure, slip, response)
            sheared = traction.shear_displacement(slip, response.shear)
        softer = 1 / self.unit.modulus_factor
        return Gel(depth_mm=depth, marker_depth_mm=into * softer, markers_mm=along * softer, shear_mm=sheared * softer)


def _steps(press: Press) -> drag.RigidMotion:
    """Motion of every frame since the one before."""
    path = press.path
    slide, twist = (jnp.diff(a, axis=0, prepend=jnp.zeros_like(a[:1])) for a in (path.slide_mm, path.twist_rad))
    return drag.RigidMotion(slide_mm=slide, twist_rad=twist, centre_mm=press.pose.offset_mm + path.slide_mm)


def _is_smooth(size: int) -> bool:
    for prime in (2, 3, 5):
        while size % prime == 0:
            size //= prime
    return size == 1
