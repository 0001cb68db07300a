"""Presses at any tier of the contact ladder and any noise, summarised by fixed features.

The pressure alone is found in another way than in the generator: two tiers differ in nothing else, not in one number of
the noise.
"""

import dataclasses
import functools
from collections.abc import Sequence as Seq

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, UInt8

from experiments.mechanics.identify_draw import DrawnPress, noisier
from sensors_io.scenes import contact, noise, readout, surface, traction
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.press import Grid, Kernels, make_kernels
from sensors_io.scenes.readout import Fields, Gel, Unit
from sensors_io.scenes.sensors import MODELS, SensorModel
from sensors_io.selection import FIELD_MM_PER_COUNT
from touchr1_jax.training.evidence import stream_features


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactTier:
    """How a contact is solved: side of its grid, tolerance, and whether springs stand for the gel's compliance."""

    name: str
    grid: int
    tolerance: float = contact.TOLERANCE
    springs: bool = False

    def config(self, scenes: SceneConfig) -> SceneConfig:
        """The same scenes at this tier."""
        return dataclasses.replace(scenes, contact_grid=self.grid, solver_tolerance=self.tolerance)


@struct.dataclass
class PressReadings:
    """A press of F frames at L levels of noise: pictures, `None` without a camera, fields, and the solver's account."""

    pictures: UInt8[Array, "F L H W 3"] | None
    fields: Fields
    strain: Float[Array, "F"]
    converged: Bool[Array, "F"]


@struct.dataclass
class PressFeatures:
    """B presses at L levels of noise: features without force, and the solver's account of their frames."""

    features: Float[Array, "B L D"]
    strain: Float[Array, "B F"]
    converged: Bool[Array, "B F"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressSetup:
    """What a press is made with: one sensor at L levels of noise, grids, cap of the solver, springs or not."""

    sensors: tuple[SensorModel, ...]
    grid: Grid
    max_iterations: int
    springs: bool

    @property
    def spacing(self) -> float:
        """Pixel of the contact grid, mm."""
        return self.sensors[0].window_mm / self.grid.contact_grid


def means(config: SceneConfig, tier: ContactTier, order: int, factors: tuple[float, ...]) -> PressSetup:
    """Sensor number `order` with its noise multiplied by each factor, and the tier's grid."""
    return PressSetup(
        sensors=tuple(noisier(MODELS[order], factor) for factor in factors),
        grid=Grid(contact_grid=tier.grid, image_px=config.image_px),
        max_iterations=config.solver_max_iterations,
        springs=tier.springs,
    )


def see(drawn: DrawnPress, kernels: Kernels, tolerance: Array | float, by: PressSetup) -> PressReadings:
    """Press, measure and photograph.

    Args:
      drawn: the press.
      kernels: `make_kernels(by.sensors[0], by.grid)`.
      tolerance: of the contact solver.
      by: the rest.
    """
    sensor, press = by.sensors[0], drawn.press
    n = by.grid.contact_grid
    x = (jnp.arange(n, dtype=jnp.float32) + 0.5) * by.spacing - sensor.window_mm / 2
    gap = surface.gap(press.skin, press.pose, x)

    def frame(at: tuple[Array, Array, Array]) -> PressReadings:
        force, exposure, key = at
        solved = _solve(gap, force, drawn, kernels, tolerance, by)
        gel = _gel(solved, kernels, drawn.unit, sensor)
        fields = [readout.measure(gel, drawn.unit, kernels.resampling, key, s) for s in by.sensors]
        shots = [readout.photograph(gel, drawn.unit, exposure, kernels.resampling, key, s) for s in by.sensors]
        return PressReadings(
            pictures=None if sensor.render is None else jnp.stack([shot for shot in shots if shot is not None]),
            fields=jax.tree.map(lambda *levels: jnp.stack(levels), *fields),
            strain=solved.strain,
            converged=solved.converged,
        )

    count = press.path.force_n.shape[0]
    exposure = 1 + press.exposure_drift * jnp.arange(count) / max(count - 1, 1)
    keys = jax.vmap(noise.fold, (None, 0))(drawn.key, jnp.arange(count))
    return jax.lax.map(frame, (press.path.force_n, exposure, keys))


def feel(
    config: SceneConfig, tier: ContactTier, order: int, draws: Seq[DrawnPress], factors: tuple[float, ...], batch: int
) -> PressFeatures:
    """Features of presses by one sensor at one tier, as NumPy arrays.

    Args:
      config: scenes.
      tier: how contacts are solved.
      order: number of the sensor.
      draws: the presses, on the skins of this tier.
      factors: L, multiples of the sensor's noise.
      batch: presses in one call of the compiled program.
    """
    by = means(config, tier, order, factors)
    kernels = make_kernels(MODELS[order], by.grid)
    parts = []
    for start in range(0, len(draws), batch):
        rows = np.minimum(np.arange(start, start + batch), len(draws) - 1)  # the last call has the shape of the others
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get([draws[i] for i in rows]))
        parts.append(jax.device_get(_feel(stacked, kernels, tier.tolerance, by)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(draws)], *parts)


def features_of(pictures: UInt8[Array, "*n F H W 3"] | None, fields: UInt8[Array, "*n F h w 3"]) -> Array:
    """Fixed summary [*n, D] of what a sensor saw, without its force: of its pictures, if any, and of its fields."""
    unknown = jnp.zeros((*fields.shape[:-3], 3))
    parts = [fields] if pictures is None else [pictures, fields]
    return jnp.concatenate([stream_features(part, unknown) for part in parts], -1)


def field_counts(deformation_mm: Float[Array, "*n h w 2"], depth_mm: Float[Array, "*n h w"]) -> Array:
    """Displacement and depth as a picture [*n, h, w, 3], 128 for none, on the scale of the clips that policies see."""
    mm = jnp.concatenate([deformation_mm, depth_mm[..., None]], -1)
    return jnp.clip(jnp.round(128 + mm / FIELD_MM_PER_COUNT), 0, 255).astype(jnp.uint8)


@functools.partial(jax.jit, static_argnames="by")
def _feel(draws: DrawnPress, kernels: Kernels, tolerance: float, by: PressSetup) -> PressFeatures:
    def one(drawn: DrawnPress) -> PressFeatures:
        seen = see(drawn, kernels, tolerance, by)
        counts = jnp.moveaxis(field_counts(seen.fields.deformation_mm, seen.fields.depth_mm), 1, 0)
        pictures = None if seen.pictures is None else jnp.moveaxis(seen.pictures, 1, 0)
        return PressFeatures(features=features_of(pictures, counts), strain=seen.strain, converged=seen.converged)

    return jax.lax.map(one, draws)


def _solve(
    gap: Array, force: Array, drawn: DrawnPress, kernels: Kernels, tolerance: Array | float, by: PressSetup
) -> contact.Contact:
    """Springs give a wrong pressure, to which the gel then answers as it would."""
    gel, body = kernels.gel / drawn.unit.modulus_factor, kernels.body / drawn.press.modulus_mpa
    thickness = by.sensors[0].gel.thickness_mm
    if by.springs:
        return contact.solve_winkler(gap, force, gel, body, by.spacing, tolerance, thickness_mm=thickness)
    cap = by.max_iterations
    return contact.solve(gap, force, gel, body, by.spacing, tolerance, cap, thickness_mm=thickness)


def _gel(solved: contact.Contact, kernels: Kernels, unit: Unit, sensor: SensorModel) -> Gel:
    """The gel under pressure alone; what little traction a standing press has is left out, as in the generator."""
    depth, still = solved.displacement_mm, jnp.zeros(solved.pressure_mpa.shape, jnp.complex64)
    if sensor.marker_depth_mm is None:
        return Gel(depth_mm=depth, marker_depth_mm=depth, markers_mm=still, shear_mm=still)
    softer = 1 / unit.modulus_factor
    along = traction.lateral_displacement(solved.pressure_mpa, kernels.markers.lateral)
    into = contact.convolve(solved.pressure_mpa, kernels.markers.depth)
    return Gel(depth_mm=depth, marker_depth_mm=into * softer, markers_mm=along * softer, shear_mm=still)
