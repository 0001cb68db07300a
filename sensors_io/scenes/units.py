"""Physical units of the sensors: what distinguishes two sensors of one model, and one sensor on two days."""

import dataclasses
import functools

import numpy as np

from sensors_io.scenes import optics, surface
from sensors_io.scenes.config import as_f32, stream
from sensors_io.scenes.readout import Unit
from sensors_io.scenes.sensors import MODELS

UNITS = 3
"""Physical units of every sensor type."""


@functools.lru_cache(maxsize=64)
def unit_of(seed: int, order: int, serial: int) -> Unit:
    """One physical unit: gel 5 % off its model, its own lamps, print and calibration."""
    rng = stream(seed, "unit", order, serial)
    sensor = MODELS[order]
    light = optics.Light(
        exposure=as_f32(np.exp(0.05 * rng.standard_normal())),
        led_gain=as_f32(np.exp(0.06 * rng.standard_normal(3))),
        pattern_shift_mm=as_f32(rng.uniform(-0.5, 0.5, 2)),
        texture=as_f32(sensor.draw_texture(rng)),
    )
    return Unit(
        modulus_factor=as_f32(np.exp(0.05 * rng.standard_normal())),
        light=light,
        lateral_gain=as_f32(1 + 0.02 * rng.standard_normal()),
        depth_gain=as_f32(1 + 0.03 * rng.standard_normal()),
    )


def on_one_day(unit: Unit, rng: np.random.Generator) -> Unit:
    """The unit on the day of this press: exposure 3 % off."""
    exposure = unit.light.exposure * float(np.exp(0.03 * rng.standard_normal()))
    return dataclasses.replace(unit, light=dataclasses.replace(unit.light, exposure=exposure))


def place(turn: float, rng: np.random.Generator) -> surface.Pose:
    """The site's direction with this sensor's error of placement: 0.3 mm, 2°, tilt 0.3°."""
    return surface.Pose(
        offset_mm=as_f32(rng.normal(0, 0.3, 2)),
        turn_rad=as_f32(turn + rng.normal(0, np.deg2rad(2))),
        tilt=as_f32(rng.normal(0, np.deg2rad(0.3), 2)),
    )
