"""Presses as the generator draws them, before anything is solved, and what a study changes about them."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, UInt32

from sensors_io.scenes import draws, schedule, surface
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.press import Press
from sensors_io.scenes.readout import Unit
from sensors_io.scenes.sensors import SensorModel


@struct.dataclass
class DrawnPress:
    """One press by one sensor: what is touched, the unit, the key of all noise, the force that was measured."""

    press: Press
    unit: Unit
    key: UInt32[Array, "2"]
    measured_n: Float[Array, "F 3"]


def touches(config: SceneConfig, order: int) -> list[DrawnPress]:
    """All presses of a config without `sequences` by sensor number `order`; an object that stands has no traction."""
    return [_touch(config, index, order) for index in range(config.contact_count)]


def skins(config: SceneConfig) -> list[surface.Skin]:
    """Skin under every press; a coarse contact grid leaves out its short waves."""
    slots = [schedule.press_slot(config, index) for index in range(config.contact_count)]
    return [draws.site_of(config, what.object_index, what.site, 0).skin for what in slots]


def on(drawn: DrawnPress, skin: surface.Skin) -> DrawnPress:
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


def _touch(config: SceneConfig, index: int, order: int) -> DrawnPress:
    drawn = draws.draw(config, index, schedule.press_slot(config, index), order)
    load = np.column_stack([np.zeros((len(drawn.hand), 2)), -drawn.force_n])
    measured = jnp.asarray(drawn.force_sensor.read(load))
    return DrawnPress(press=drawn.press, unit=drawn.unit, key=jnp.asarray(drawn.key), measured_n=measured)


def _scaled(noise: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    red, green, blue = noise
    return factor * red, factor * green, factor * blue
