"""Contacts with friction: three kinds of bodies on the gels of the sensors, pushed, slid and twisted.

`partial_slip.promised_error` was fitted to other gels and shapes.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Complex, Float

from experiments.mechanics.contact_scenes import SHORTEST_WAVE_MM, normal_compliances
from sensors_io.scenes import contact, drag, motions, objects, partial_slip, press, schedule, surface
from sensors_io.scenes.sensors import BODY, MODELS, SensorModel
from sensors_io.scenes.traction import Compliance, Response, in_series, make_compliance, make_response

KINDS = ("sphere", "rough", "patterned")
"""A sphere; a body of two curvatures with roughness, and one with bumps, ridges or plateaus."""

FORCES_N = (1.0, 8.0)
PULL_SHARES = (0.3, 0.9)
"""Of the friction limit: the range for which `partial_slip.promised_error` holds."""

SLIDE_SHARES = (0.2, 0.9)
"""Of the slide at which a round contact has slipped everywhere."""

SEQUENCE_FORCE_N = 5.0
_RAMP = 16  # frames of the press that went before
_RISE = 1.5  # force over time in a press, see `motions`
_ROUGHNESS_MM, _RELIEF_MM = (0.01, 0.06), (0.05, 0.4)
_PRESSURE_TOLERANCE, _PRESSURE_ITERATIONS = 1e-4, 400


@struct.dataclass
class FrictionKernels:
    """The spectra of one gel on a padded grid: normal and tangential, of the gel and of a body of 1 MPa; markers."""

    x_mm: Float[Array, "N"]
    normal_gel: Float[Array, "M K"]
    normal_body: Float[Array, "M K"]
    gel: Compliance
    body: Compliance
    markers: Response

    @property
    def spacing_mm(self) -> Array:
        """Pixel size."""
        return self.x_mm[1] - self.x_mm[0]


@struct.dataclass
class FrictionContact:
    """One contact and the motion applied to it; of many contacts every array has a leading axis.

    The press went through the forces `ramp_n`, the last of which is the one that holds.  Either a tangential force of
    `pull_share` times the friction limit is applied along `direction`, or a slide along it, or a twist.
    """

    gap_mm: Float[Array, "N N"]
    ramp_mpa: Float[Array, "K N N"]
    ramp_n: Float[Array, "K"]
    modulus_mpa: Float[Array, ""]
    friction: Float[Array, ""]
    direction: Complex[Array, ""]
    pull_share: Float[Array, ""]
    slide_mm: Float[Array, ""]
    twist_rad: Float[Array, ""]

    @property
    def limit_mpa(self) -> Array:
        """μp, the greatest traction."""
        return jnp.asarray(self.friction)[..., None, None] * self.ramp_mpa[..., -1, :, :]


@struct.dataclass
class FrictionSequence:
    """A sequence of F frames: the pressure of each and the motion since the frame before."""

    pressure_mpa: Float[Array, "F N N"]
    step: drag.RigidMotion
    modulus_mpa: Float[Array, ""]
    friction: Float[Array, ""]


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrictionBody:
    """A drawn object: its kind, skin, modulus and friction."""

    kind: str
    skin: surface.Skin
    modulus_mpa: float
    friction: float


def sensors(names: tuple[str, ...]) -> tuple[SensorModel, ...]:
    """The models of these names.

    Raises:
      ValueError: a name that no model has.
    """
    by_name = {model.name: model for model in MODELS}
    unknown = sorted(set(names) - set(by_name))
    if unknown or not names:
        raise ValueError(f"sensors is {names}: must be some of {', '.join(by_name)}; rename {unknown}")
    return tuple(by_name[name] for name in names)


def friction_kernels(sensor: SensorModel, grid: int) -> FrictionKernels:
    """A gel's spectra, on the padding that the widest-reaching gel needs, so that one program serves all."""
    spacing = sensor.window_mm / grid
    size = max(press.padded_size(grid, m.window_mm, m.gel.thickness_mm) for m in MODELS)
    normal_gel, normal_body = normal_compliances(sensor, size, spacing)
    return FrictionKernels(
        x_mm=jnp.asarray((np.arange(grid) + 0.5) * spacing - sensor.window_mm / 2, jnp.float32),
        normal_gel=jnp.asarray(normal_gel, jnp.float32),
        normal_body=jnp.asarray(normal_body, jnp.float32),
        gel=make_compliance(sensor.gel, size, spacing),
        body=make_compliance(BODY, size, spacing),
        markers=make_response(sensor.gel, size, spacing, sensor.marker_depth_mm or 0.0),
    )


def draw(rng: np.random.Generator, kind: str) -> FrictionBody:
    """An object of a kind of `KINDS`, with a modulus and a friction of any material."""
    solid = objects.sample(rng, 0.0, SHORTEST_WAVE_MM)
    radius = solid.radius_1_mm if kind == "sphere" else solid.radius_2_mm
    rms = rng.uniform(*_ROUGHNESS_MM) if kind == "rough" else 0.0
    amplitudes = solid.wave_amplitudes_mm * (rms / solid.rms_mm)
    relief = rng.uniform(*_RELIEF_MM) if kind == "patterned" else 0.0
    shaped = dataclasses.replace(
        solid, radius_2_mm=radius, wave_amplitudes_mm=amplitudes, feature_height_mm=relief, rms_mm=rms
    )
    skin = surface.make_skin(shaped, rng.uniform(-2, 2, 2), 1.0)
    return FrictionBody(kind=kind, skin=skin, modulus_mpa=solid.modulus_mpa, friction=solid.friction)


def sample(kernels: FrictionKernels, count: int, seed: int, order: int) -> tuple[FrictionContact, tuple[str, ...]]:
    """`count` contacts of every kind on gel number `order`, stacked, and the kind of each."""
    kinds = tuple(kind for kind in KINDS for _ in range(count))
    rng = np.random.default_rng([seed, order])
    cases = [_case(kernels, draw(rng, kind), rng) for kind in kinds]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases), kinds


def make_motion(kernels: FrictionKernels, body: FrictionBody, name: str, frames: int) -> FrictionSequence:
    """A motion of the protocol at 5 N by one object, with the pressure of every frame."""
    hand = motions.plan(name, SEQUENCE_FORCE_N, schedule.pace(frames))
    slide, twist = (jnp.asarray(a, jnp.float32) for a in (hand.slide_mm, hand.twist_rad))
    force, modulus = jnp.asarray(hand.force_n, jnp.float32), jnp.float32(body.modulus_mpa)
    since = lambda path: jnp.diff(path, axis=0, prepend=jnp.zeros_like(path[:1]))
    return FrictionSequence(
        pressure_mpa=_pressures(kernels, body.skin, modulus, force, slide, twist),
        step=drag.RigidMotion(slide_mm=since(slide), twist_rad=since(twist), centre_mm=jnp.zeros(2) + slide),
        modulus_mpa=modulus,
        friction=jnp.float32(body.friction),
    )


def contact_radius_mm(pressure_mpa: np.ndarray, spacing_mm: float) -> float:
    """Radius of the circle of a contact's area."""
    return float(np.sqrt((pressure_mpa > 0).sum() / np.pi) * spacing_mm)


def _case(kernels: FrictionKernels, body: FrictionBody, rng: np.random.Generator) -> FrictionContact:
    pose = surface.SensorPose(
        offset_mm=jnp.asarray(rng.uniform(-1, 1, 2), jnp.float32),
        turn_rad=jnp.float32(rng.uniform(0, 2 * np.pi)),
        tilt=jnp.zeros(2),
    )
    force = float(np.exp(rng.uniform(*np.log(FORCES_N))))
    direction = jnp.complex64(np.exp(1j * rng.uniform(0, 2 * np.pi)))
    forces = jnp.asarray(force * (np.arange(1, _RAMP + 1) / _RAMP) ** _RISE, jnp.float32)
    modulus, friction = jnp.float32(body.modulus_mpa), jnp.float32(body.friction)
    gap, ramp, slide = _press(kernels, body.skin, pose, modulus, forces, direction)
    share = rng.uniform(*SLIDE_SHARES)
    radius = contact_radius_mm(np.asarray(ramp[-1]), float(kernels.spacing_mm))
    return FrictionContact(
        gap_mm=gap,
        ramp_mpa=ramp,
        ramp_n=forces,
        modulus_mpa=modulus,
        friction=friction,
        direction=direction,
        pull_share=jnp.float32(rng.uniform(*PULL_SHARES)),
        slide_mm=share * friction * slide,
        twist_rad=share * friction * slide / radius,
    )


@jax.jit
def _press(
    kernels: FrictionKernels,
    skin: surface.Skin,
    pose: surface.SensorPose,
    modulus_mpa: Array,
    forces_n: Array,
    direction: Array,
) -> tuple[Array, Array, Array]:
    """Gap, pressure at every force, and the slide along `direction` at which a friction of 1 lets all of it slip."""
    gap = surface.gap(skin, pose, kernels.x_mm)
    ramp = jax.lax.map(lambda force: _solved(kernels, gap, modulus_mpa, force), forces_n)
    compliance = in_series(kernels.gel, kernels.body, 1.0, modulus_mpa)
    return gap, ramp, partial_slip.core_slide(ramp, compliance, direction)[-1]


@jax.jit
def _pressures(
    kernels: FrictionKernels, skin: surface.Skin, modulus_mpa: Array, force_n: Array, slide_mm: Array, twist_rad: Array
) -> Array:
    """Pressure of every frame, [F, N, N]; zeros without force."""
    pose = surface.SensorPose(offset_mm=jnp.zeros(2), turn_rad=jnp.zeros(()), tilt=jnp.zeros(2))

    def frame(at: tuple[Array, Array, Array]) -> Array:
        force, slide, twist = at
        gap = surface.gap(skin, motions.moved(pose, slide, twist, jnp.zeros(2)), kernels.x_mm)
        return jnp.where(force > 0, _solved(kernels, gap, modulus_mpa, jnp.where(force > 0, force, 1.0)), 0)

    return jax.lax.map(frame, (force_n, slide_mm, twist_rad))


def _solved(kernels: FrictionKernels, gap: Array, modulus_mpa: Array, force_n: Array) -> Array:
    body = kernels.normal_body / modulus_mpa
    limits = (_PRESSURE_TOLERANCE, _PRESSURE_ITERATIONS)
    return contact.solve(gap, force_n, kernels.normal_gel, body, kernels.spacing_mm, *limits).pressure_mpa
