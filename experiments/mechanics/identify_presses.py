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

from experiments.core.concurrency import in_threads
from experiments.mechanics.identify_features import ContactData, features_of, force_of, truth
from sensors_io.scenes import contact, draws, noise, schedule, surface
from sensors_io.scenes.cards import shortest_wave_mm
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.press import GridSizes, Kernels, Press, Scene, make_kernels
from sensors_io.scenes.readout import FrameFields, Unit
from sensors_io.scenes.sensors import MODELS, SensorModel
from sensors_io.schema import SENSORS


@struct.dataclass
class DrawnPress:
    """One press by one sensor: the object, the sensor unit, the key of all noise, the measured force."""

    press: Press
    unit: Unit
    key: UInt32[Array, "2"]
    measured_n: Float[Array, "F 3"]


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


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressData(ContactData):
    """n presses; `by_tier` holds the features by tier and number of the sensor."""

    by_tier: dict[tuple[str, int], PressFeatures]

    def features(self, tier: ContactTier, order: int, level: int = 0) -> np.ndarray:
        """Touch and force of sensor number `order` at one of the tier's levels of noise, [n, D]."""
        return np.concatenate([self.by_tier[tier.name, order].features[:, level], self.force[:, order]], 1)


def press(
    config: SceneConfig, tiers: Seq[tuple[ContactTier, tuple[float, ...]]], batch: int, advance: Callable[[], object]
) -> PressData:
    """Make every press at every tier with its multiples of noise; the first tier's skin is the true shape.

    The config has no `sequences`; `advance` is called after each tier of each sensor.
    """
    drawn = [drawn_presses(tiers[0][0].config(config), order) for order in range(len(SENSORS))]
    wave_of = lambda tier: shortest_wave_mm(tier.config(config))
    by_wave = {wave_of(tier): skins(tier.config(config)) for tier, _ in tiers}

    def work(job: tuple[tuple[ContactTier, tuple[float, ...]], int]) -> PressFeatures:
        (tier, factors), order = job
        at_tier = [
            dataclasses.replace(one, press=dataclasses.replace(one.press, skin=skin))
            for one, skin in zip(drawn[order], by_wave[wave_of(tier)], strict=True)
        ]
        return press_features(config, tier, order, at_tier, factors, batch)

    jobs = list(itertools.product(tiers, range(len(SENSORS))))
    features = in_threads(work, jobs, advance)
    return PressData(
        by_tier={(tier.name, order): found for ((tier, _), order), found in zip(jobs, features, strict=True)},
        force=np.stack([force_of(np.stack([np.asarray(d.measured_n) for d in each])) for each in drawn], 1),
        **truth(config, _slots(config), by_wave[wave_of(tiers[0][0])]),
    )


def drawn_presses(config: SceneConfig, order: int) -> list[DrawnPress]:
    """All presses of a config without `sequences` by sensor number `order`; an object that stands has no traction."""
    found = []
    for index, slot in enumerate(_slots(config)):
        drawn = draws.draw(config, index, slot, order)
        load = np.column_stack([np.zeros((len(drawn.hand), 2)), -drawn.force_n])
        measured = jnp.asarray(drawn.force_sensor.read(load))
        found.append(DrawnPress(press=drawn.press, unit=drawn.unit, key=jnp.asarray(drawn.key), measured_n=measured))
    return found


def skins(config: SceneConfig) -> list[surface.Skin]:
    """Skin under every press; a coarse contact grid leaves out its short waves."""
    return [draws.site_of(config, slot.object_index, slot.site, 0).skin for slot in _slots(config)]


def _slots(config: SceneConfig) -> list[schedule.Slot]:
    return [schedule.press_slot(config, index) for index in range(config.contact_count)]


def noisier(sensor: SensorModel, factor: float) -> SensorModel:
    """The same sensor with `factor` times the noise of its fields and of its camera; its units differ as before."""
    scaled = lambda noise: tuple(factor * channel for channel in noise)
    return dataclasses.replace(
        sensor,
        lateral_noise_mm=factor * sensor.lateral_noise_mm,
        depth_noise_mm=factor * sensor.depth_noise_mm,
        read_noise=scaled(sensor.read_noise),
        shot_noise=scaled(sensor.shot_noise),
    )


def press_setup(config: SceneConfig, tier: ContactTier, order: int, factors: tuple[float, ...]) -> PressSetup:
    """Sensor number `order` with its noise multiplied by each factor, and the tier's grid."""
    return PressSetup(
        sensors=tuple(noisier(MODELS[order], factor) for factor in factors),
        grid=GridSizes(contact_grid=tier.grid, image_px=config.image_px),
        max_iterations=config.solver_max_iterations,
        springs=tier.springs,
    )


def press_features(
    config: SceneConfig, tier: ContactTier, order: int, draws: Seq[DrawnPress], factors: tuple[float, ...], batch: int
) -> PressFeatures:
    """Features of presses by sensor number `order` at one tier and several multiples of its noise, as NumPy arrays."""
    by = press_setup(config, tier, order, factors)
    kernels = make_kernels(MODELS[order], by.grid)
    parts = []
    for start in range(0, len(draws), batch):
        rows = np.minimum(np.arange(start, start + batch), len(draws) - 1)  # the last call has the shape of the others
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get([draws[i] for i in rows]))
        parts.append(jax.device_get(_features(stacked, kernels, tier.tolerance, by)))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(draws)], *parts)


@functools.partial(jax.jit, static_argnames="by")
def _features(draws: DrawnPress, kernels: Kernels, tolerance: float, by: PressSetup) -> PressFeatures:
    def one(drawn: DrawnPress) -> PressFeatures:
        seen = read_press(drawn, kernels, tolerance, by)
        pictures, deformation, depth = jax.tree.map(
            lambda field: jnp.moveaxis(field, 1, 0), (seen.pictures, seen.fields.deformation_mm, seen.fields.depth_mm)
        )
        features = features_of(pictures, deformation, depth)
        return PressFeatures(features=features, strain=seen.strain, converged=seen.converged)

    return jax.lax.map(one, draws)


def read_press(drawn: DrawnPress, kernels: Kernels, tolerance: float, by: PressSetup) -> PressReadings:
    """Press, measure and photograph, as the generator does, with the kernels of `by.sensors[0]` on `by.grid`.

    With springs the pressure is wrong, the gel's response to it is not.
    """
    press, unit, limits = drawn.press, drawn.unit, (tolerance, by.max_iterations)
    scenes = [Scene(press, unit, kernels, sensor, by.grid, limits) for sensor in by.sensors]
    scene = scenes[0]
    gap = surface.gap(press.skin, press.pose, scene.x)

    def solve(force: Array) -> contact.Contact:
        if not by.springs:
            return scene.solve(gap, force)
        gel, body = kernels.gel / unit.modulus_factor, kernels.body / press.modulus_mpa
        thickness = scene.sensor.gel.thickness_mm
        return contact.solve_winkler(gap, force, gel, body, scene.spacing, tolerance, thickness_mm=thickness)

    def frame(at: tuple[Array, Array, Array]) -> PressReadings:
        force, exposure, key = at
        solved = solve(force)
        seen = [each.see(solved, None, exposure, key) for each in scenes]
        levels = [(one.frames, one.fields) for one in seen]
        pictures, fields = jax.tree.map(lambda *leaves: jnp.stack(leaves), *levels)
        return PressReadings(pictures=pictures, fields=fields, strain=solved.strain, converged=solved.converged)

    count = press.path.force_n.shape[0]
    exposure = 1 + press.exposure_drift * jnp.arange(count) / max(count - 1, 1)
    keys = jax.vmap(noise.fold, (None, 0))(drawn.key, jnp.arange(count))
    return jax.lax.map(frame, (press.path.force_n, exposure, keys))
