"""Physical units of the sensors: what distinguishes two sensors of one model, and one sensor on two days."""

import dataclasses
import functools

import numpy as np

from sensors_io.scenes import optics, surface
from sensors_io.scenes.config import stream
from sensors_io.scenes.readout import Unit
from sensors_io.scenes.sensors import MODELS
from sensors_io.scenes.surface import as_f32

UNITS = 3
"""Physical units of every sensor type."""

MODULUS_SPREAD, EXPOSURE_SPREAD, LED_SPREAD = 0.05, 0.05, 0.06
"""Standard deviations of ln(unit / model): stiffness of a cast gel, exposure, each lamp.

These and all spreads below are assumptions of the usual size; no two real units of one model were compared.
"""

PATTERN_SHIFT_MM = 0.5
"""A print lies off the camera's axis by up to this, along x and y."""

LATERAL_GAIN_SPREAD, DEPTH_GAIN_SPREAD = 0.02, 0.03
"""Standard deviations of the gains of a unit's calibrated displacements; depth is the harder to calibrate."""

DAY_SPREAD = 0.03
"""Standard deviation of ln(exposure / the unit's) from day to day: warm lamps, a worn coating."""

PLACE_MM, PLACE_TURN_DEG, PLACE_TILT_DEG = 0.3, 2.0, 0.3
"""Standard deviations with which an arm puts a sensor on a site, along x and y, about the normal and off it."""


@functools.lru_cache(maxsize=64)
def unit_of(seed: int, order: int, serial: int) -> Unit:
    """One physical unit: a gel off its model, its own lamps, print and calibration."""
    rng = stream(seed, "unit", order, serial)
    sensor = MODELS[order]
    light = optics.Light(
        exposure=as_f32(np.exp(EXPOSURE_SPREAD * rng.standard_normal())),
        led_gain=as_f32(np.exp(LED_SPREAD * rng.standard_normal(3))),
        pattern_shift_mm=as_f32(rng.uniform(-PATTERN_SHIFT_MM, PATTERN_SHIFT_MM, 2)),
        texture=as_f32(sensor.draw_texture(rng)),
    )
    return Unit(
        modulus_factor=as_f32(np.exp(MODULUS_SPREAD * rng.standard_normal())),
        light=light,
        lateral_gain=as_f32(1 + LATERAL_GAIN_SPREAD * rng.standard_normal()),
        depth_gain=as_f32(1 + DEPTH_GAIN_SPREAD * rng.standard_normal()),
    )


def on_one_day(unit: Unit, rng: np.random.Generator) -> Unit:
    """The unit on the day of this press: its exposure off by `DAY_SPREAD`."""
    exposure = unit.light.exposure * float(np.exp(DAY_SPREAD * rng.standard_normal()))
    return dataclasses.replace(unit, light=dataclasses.replace(unit.light, exposure=exposure))


def place(turn: float, rng: np.random.Generator) -> surface.SensorPose:
    """The site's direction with this sensor's error of placement."""
    return surface.SensorPose(
        offset_mm=as_f32(rng.normal(0, PLACE_MM, 2)),
        turn_rad=as_f32(turn + rng.normal(0, np.deg2rad(PLACE_TURN_DEG))),
        tilt=as_f32(rng.normal(0, np.deg2rad(PLACE_TILT_DEG), 2)),
    )
