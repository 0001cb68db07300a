"""Presses as the generator draws them, at any tier of the contact ladder and any noise, summarised by fixed features.

Only the pressure is solved differently from the generator: two tiers have the same draws and the same noise.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from collections.abc import Sequence as Seq

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, UInt8, UInt32

from experiments.mechanics.identify_features import features_of, field_counts, force_of, in_threads, statistics
from sensors_io.scenes import contact, draws, noise, readout, schedule, surface, traction
from sensors_io.scenes.cards import shortest_wave_mm, solid_of
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.press import GridSizes, Kernels, Press, make_kernels
from sensors_io.scenes.readout import FrameFields, Gel, Unit
from sensors_io.scenes.sensors import MODELS, SensorModel
from sensors_io.schema import SENSORS


@struct.dataclass
class DrawnPress:
    """One press by one sensor: the object, the sensor unit, the key of all noise, the measured force."""

    press: Press
    unit: Unit
    key: UInt32[Array, "2"]
    measured_n: Float[Array, "F 3"]


def drawn_presses(config: SceneConfig, order: int) -> list[DrawnPress]:
    """All presses of a config without `sequences` by sensor number `order`; an object that stands has no traction."""
    return [_drawn_press(config, index, order) for index in range(config.contact_count)]


def skins(config: SceneConfig) -> list[surface.Skin]:
    """Skin under every press; a coarse contact grid leaves out its short waves."""
    slots = [schedule.press_slot(config, index) for index in range(config.contact_count)]
    return [draws.site_of(config, what.object_index, what.site, 0).skin for what in slots]


def with_skin(drawn: DrawnPress, skin: surface.Skin) -> DrawnPress:
    """The same press on another skin."""
    return dataclasses.replace(drawn, press=dataclasses.replace(drawn.press, skin=skin))


def noisier(sensor: SensorModel, factor: float) -> SensorModel:
    """The same sensor with `factor` times the noise of its fields and of its camera; its units differ as before."""
    return dataclasses.replace(
        sensor,
        lateral_noise_mm=factor * sensor.lateral_noise_mm,
        depth_noise_mm=factor * sensor.depth_noise_mm,
        read_noise=_scaled(sensor.read_noise, factor),
        shot_noise=_scaled(sensor.shot_noise, factor),
    )


def _drawn_press(config: SceneConfig, index: int, order: int) -> DrawnPress:
    drawn = draws.draw(config, index, schedule.press_slot(config, index), order)
    load = np.column_stack([np.zeros((len(drawn.hand), 2)), -drawn.force_n])
    measured = jnp.asarray(drawn.force_sensor.read(load))
    return DrawnPress(press=drawn.press, unit=drawn.unit, key=jnp.asarray(drawn.key), measured_n=measured)


def _scaled(noise: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    red, green, blue = noise
    return factor * red, factor * green, factor * blue


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactTier:
    """A method of solving contacts: side of the grid, tolerance, and springs in place of the gel's compliance."""

    name: str
    grid: int
    tolerance: float = contact.TOLERANCE
    springs: bool = False

    def config(self, scenes: SceneConfig) -> SceneConfig:
        """The same scenes at this tier."""
        return dataclasses.replace(scenes, contact_grid=self.grid, solver_tolerance=self.tolerance)


@struct.dataclass
class PressReadings:
    """A press of F frames at L levels of noise: pictures (`None` without a camera), fields, strain and convergence."""

    pictures: UInt8[Array, "F L H W 3"] | None
    fields: FrameFields
    strain: Float[Array, "F"]
    converged: Bool[Array, "F"]


@struct.dataclass
class PressFeatures:
    """B presses at L levels of noise: features without force, strain and convergence of their frames."""

    features: Float[Array, "B L D"]
    strain: Float[Array, "B F"]
    converged: Bool[Array, "B F"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressSetup:
    """One sensor at L levels of noise, its grids, the iteration limit of the solver, springs or not."""

    sensors: tuple[SensorModel, ...]
    grid: GridSizes
    max_iterations: int
    springs: bool

    @property
    def spacing(self) -> float:
        """Pixel of the contact grid, mm."""
        return self.sensors[0].window_mm / self.grid.contact_grid


def press_setup(config: SceneConfig, tier: ContactTier, order: int, factors: tuple[float, ...]) -> PressSetup:
    """Sensor number `order` with its noise multiplied by each factor, and the tier's grid."""
    return PressSetup(
        sensors=tuple(noisier(MODELS[order], factor) for factor in factors),
        grid=GridSizes(contact_grid=tier.grid, image_px=config.image_px),
        max_iterations=config.solver_max_iterations,
        springs=tier.springs,
    )


def read_press(drawn: DrawnPress, kernels: Kernels, tolerance: Array | float, by: PressSetup) -> PressReadings:
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


def press_features(
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
    by = press_setup(config, tier, order, factors)
    kernels = make_kernels(MODELS[order], by.grid)
    parts = []
    for start in range(0, len(draws), batch):
        rows = np.minimum(np.arange(start, start + batch), len(draws) - 1)  # the last call has the shape of the others
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get([draws[i] for i in rows]))
        parts.append(jax.device_get(_feel(stacked, kernels, tier.tolerance, by)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(draws)], *parts)


@functools.partial(jax.jit, static_argnames="by")
def _feel(draws: DrawnPress, kernels: Kernels, tolerance: float, by: PressSetup) -> PressFeatures:
    def one(drawn: DrawnPress) -> PressFeatures:
        seen = read_press(drawn, kernels, tolerance, by)
        counts = jnp.moveaxis(field_counts(seen.fields.deformation_mm, seen.fields.depth_mm), 1, 0)
        pictures = None if seen.pictures is None else jnp.moveaxis(seen.pictures, 1, 0)
        return PressFeatures(features=features_of(pictures, counts), strain=seen.strain, converged=seen.converged)

    return jax.lax.map(one, draws)


def _solve(
    gap: Array, force: Array, drawn: DrawnPress, kernels: Kernels, tolerance: Array | float, by: PressSetup
) -> contact.Contact:
    """With springs the pressure is wrong; the gel's response to it is not."""
    gel, body = kernels.gel / drawn.unit.modulus_factor, kernels.body / drawn.press.modulus_mpa
    thickness = by.sensors[0].gel.thickness_mm
    if by.springs:
        return contact.solve_winkler(gap, force, gel, body, by.spacing, tolerance, thickness_mm=thickness)
    cap = by.max_iterations
    return contact.solve(gap, force, gel, body, by.spacing, tolerance, cap, thickness_mm=thickness)


def _gel(solved: contact.Contact, kernels: Kernels, unit: Unit, sensor: SensorModel) -> Gel:
    """The gel under pressure alone; the small traction of a standing press is left out, as in the generator."""
    depth, still = solved.displacement_mm, jnp.zeros(solved.pressure_mpa.shape, jnp.complex64)
    if sensor.marker_depth_mm is None:
        return Gel(depth_mm=depth, marker_depth_mm=depth, markers_mm=still, shear_mm=still)
    softer = 1 / unit.modulus_factor
    along = traction.lateral_displacement(solved.pressure_mpa, kernels.markers.lateral)
    into = contact.convolve(solved.pressure_mpa, kernels.markers.depth)
    return Gel(depth_mm=depth, marker_depth_mm=into * softer, markers_mm=along * softer, shear_mm=still)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressData:
    """n presses: features by tier and sensor, force [n, S, E], true shape [n, G], levels and objects [n]."""

    by_tier: dict[tuple[str, int], PressFeatures]
    force: np.ndarray
    shape: np.ndarray
    levels: dict[str, np.ndarray]
    objects: np.ndarray

    def features(self, tier: ContactTier, order: int, level: int = 0) -> np.ndarray:
        """Touch and force of sensor number `order` at one of the tier's levels of noise, [n, D]."""
        return np.concatenate([self.by_tier[tier.name, order].features[:, level], self.force[:, order]], 1)


def press(
    config: SceneConfig, tiers: Seq[tuple[ContactTier, tuple[float, ...]]], batch: int, advance: Callable[[], object]
) -> PressData:
    """Make every press at every tier.

    Args:
      config: scenes without `sequences`.
      tiers: tiers, each with its multiples of noise; the first one's skin is the true shape.
      batch: presses in one call of a compiled program.
      advance: called after each tier of each sensor.
    """
    drawn = [drawn_presses(tiers[0][0].config(config), order) for order in range(len(SENSORS))]
    waves = {shortest_wave_mm(tier.config(config)): tier.config(config) for tier, _ in tiers}
    by_wave = {wave: skins(at) for wave, at in waves.items()}
    skins_of = lambda tier: by_wave[shortest_wave_mm(tier.config(config))]

    def work(job: tuple[tuple[ContactTier, tuple[float, ...]], int]) -> PressFeatures:
        (tier, factors), order = job
        presses = [with_skin(one, skin) for one, skin in zip(drawn[order], skins_of(tier), strict=True)]
        return press_features(config, tier, order, presses, factors, batch)

    jobs = list(itertools.product(tiers, range(len(SENSORS))))
    features = in_threads(work, jobs, advance)
    slots = [schedule.press_slot(config, index) for index in range(config.contact_count)]
    levels = [solid_of(config, what.object_index).levels() for what in slots]
    return PressData(
        by_tier={(tier.name, order): found for ((tier, _), order), found in zip(jobs, features, strict=True)},
        force=np.stack([force_of(np.stack([np.asarray(d.measured_n) for d in each])) for each in drawn], 1),
        shape=statistics(skins_of(tiers[0][0])),
        levels={name: np.array([level[name] for level in levels]) for name in levels[0]},
        objects=np.array([what.object_index for what in slots]),
    )
