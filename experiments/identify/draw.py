"""Presses as the generator draws them, before anything is solved: what is touched, by which unit, how hard.

Every random number is drawn in the generator's order, so that a press made here is the generator's own.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, UInt32

from sensors_io.scenes import SceneConfig, noise, schedule, surface
from sensors_io.scenes.config import as_f32, require, stream
from sensors_io.scenes.press import Path, Press
from sensors_io.scenes.readout import Unit
from sensors_io.scenes.sensors import SensorModel
from sensors_io.scenes.sequence import site_of
from sensors_io.scenes.units import UNITS, on_one_day, place, unit_of

_CROSSTALK = 0.01  # of the generator's force sensor, normal to tangential
_DRIFT = 0.01  # of its exposure over a sequence


@struct.dataclass
class Touch:
    """One press by one sensor: what is touched, the unit, the key of all noise, the force that was measured."""

    press: Press
    unit: Unit
    key: UInt32[Array, "2"]
    measured_n: Float[Array, "F 3"]


def touches(config: SceneConfig, order: int) -> list[Touch]:
    """All presses of a config without `sequences` by sensor number `order`.

    Raises:
      ValueError: a ramp that does not rise, on which the generator would look at its history.
    """
    return [_touch(config, index, order) for index in range(config.contact_count)]


def skins(config: SceneConfig) -> list[surface.Skin]:
    """Skin under every press; a coarse contact grid leaves out its short waves."""
    slots = [schedule.press_slot(config, index) for index in range(config.contact_count)]
    return [site_of(config, what.object_index, what.site, 0).skin for what in slots]


def on(drawn: Touch, skin: surface.Skin) -> Touch:
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


def _touch(config: SceneConfig, index: int, order: int) -> Touch:
    what = schedule.press_slot(config, index)
    site = site_of(config, what.object_index, what.site, 0)
    rng = stream(config.seed, "press", index, order, 0)
    serial = int(rng.integers(UNITS))
    force = np.geomspace(config.min_force_n, what.force_n, config.frame_count)
    force = force * (1 + config.force_jitter * np.clip(rng.standard_normal(len(force)), -3, 3))
    require(bool(np.all(np.diff(force) > 0)), "frames", config.frame_count, "must leave a ramp that rises")
    still = np.zeros((len(force), 2))
    press = Press(
        skin=site.skin,
        pose=place(site.turn_rad, rng),
        modulus_mpa=as_f32(site.solid.modulus_mpa),
        friction=as_f32(site.solid.friction),
        path=Path(force_n=as_f32(force), slide_mm=as_f32(still), twist_rad=as_f32(still[:, 0]), tilt_rad=as_f32(still)),
        exposure_drift=as_f32(_DRIFT * rng.standard_normal()),
    )
    unit = on_one_day(unit_of(config.seed, order, serial), rng)
    key = jnp.asarray(noise.key(rng))
    return Touch(press=press, unit=unit, key=key, measured_n=as_f32(_weighed(config, force, rng)))


def _weighed(config: SceneConfig, force: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The measured force [F, 3] of a press that stands still: gain error, crosstalk, noise."""
    gain = 1 + config.force_gain_error * rng.standard_normal()
    crosstalk = np.append(_CROSSTALK * rng.standard_normal(2), 0)
    true = np.column_stack([np.zeros((len(force), 2)), -force])
    error = config.force_noise_n * rng.standard_normal(true.shape)
    weighed: np.ndarray = gain * true - crosstalk * true[:, 2:] + error
    return weighed


def _scaled(noise_: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    red, green, blue = noise_
    return factor * red, factor * green, factor * blue
