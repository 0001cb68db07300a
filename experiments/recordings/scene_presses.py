"""Generated presses seen by a GelSight Mini only, as modelled or with one part of the scene changed."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sensors_io.scenes import optics
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.draws import Draw, draw
from sensors_io.scenes.press import GridSizes, Kernels, make_kernels, record
from sensors_io.scenes.schedule import press_slot
from sensors_io.scenes.surface import Skin, as_f32
from sensors_io.scenes.winkler import bed_compliance
from sensors_io.schema import SENSORS

SENSOR = "gelsight_mini"

RIGID_MPA = 1e4
CURVATURE_MM, PITCH_MM, WIDTH = 20.0, 4.0, 0.2  # of every object where shapes do not vary
WAVE_MM = 1.6  # of a roughness of one wavelength: in the middle of the band of the spectrum
TURN_RAD, SLIDE_MM, TILT_RAD = 0.5, 2.0, 0.05  # standard deviations of a hand's motion by the last frame; assumed
LEAST_N = 4.0  # of the last frame where the greatest force varies

Change = Callable[[Draw, np.random.Generator], Draw]


def unchanged(drawn: Draw, rng: np.random.Generator) -> Draw:
    """The press as it was drawn."""
    return drawn


@dataclasses.dataclass(frozen=True, kw_only=True)
class PressVariant:
    """A change of generated presses, by default none.

    `scenes` are fields of `SceneConfig`; `change` is what becomes of a press before it is solved, with randomness of
    its own; with `springs` the gel is a bed of springs; `moving` solves every frame at its own place.
    """

    scenes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    change: Change = unchanged
    springs: bool = False
    moving: bool = False


def press_pictures(config: SceneConfig, index: int, variant: PressVariant = PressVariant()) -> np.ndarray:
    """Pictures of press `index`, uint8 [F, H, W, 3]; without a variant those of `generate_records`, bit by bit."""
    config = dataclasses.replace(config, **variant.scenes)
    drawn = draw(config, index, press_slot(config, index), SENSORS.index(SENSOR))
    drawn = variant.change(drawn, np.random.default_rng([config.seed, index]))
    grid = GridSizes(contact_grid=config.contact_grid, image_px=config.image_px)
    kernels = make_kernels(drawn.sensor, grid)
    if variant.springs:
        kernels = springs(kernels, drawn.sensor.window_mm / config.contact_grid)
    limits = config.solver_tolerance, config.solver_max_iterations
    made = record(drawn.press, drawn.unit, kernels, drawn.key, drawn.sensor, grid, *limits, moving=variant.moving)
    return np.asarray(jax.device_get(made.frames))


def springs(kernels: Kernels, spacing_mm: float) -> Kernels:
    """Kernels of beds of springs as stiff as gel and object at the scale of a finger-sized contact."""
    flat = lambda spectrum: jnp.full_like(spectrum, bed_compliance(spectrum, spacing_mm))
    return dataclasses.replace(kernels, gel=flat(kernels.gel), body=flat(kernels.body))


def _sensor(**changes: Any) -> Change:
    return lambda drawn, rng: dataclasses.replace(drawn, sensor=dataclasses.replace(drawn.sensor, **changes))


def _press(make: Callable[[Draw, np.random.Generator], Mapping[str, Any]]) -> Change:
    return lambda drawn, rng: dataclasses.replace(drawn, press=dataclasses.replace(drawn.press, **make(drawn, rng)))


def _skin(make: Callable[[Skin], Mapping[str, Any]]) -> Change:
    return _press(lambda drawn, rng: {"skin": dataclasses.replace(drawn.press.skin, **make(drawn.press.skin))})


def lamps_by_eye(gel: optics.DeformedGel, light: optics.Light) -> optics.Array:
    """Three lamps at 120° of each other, which nobody fitted to a sensor."""
    return optics.shade(gel, light, optics.SOFT_LAMPS, slope_gain=optics.DOT_SLOPE_GAIN)


def _no_grain(drawn: Draw, rng: np.random.Generator) -> Draw:
    light = dataclasses.replace(drawn.unit.light, texture=as_f32(np.zeros(drawn.unit.light.texture.shape)))
    return dataclasses.replace(drawn, unit=dataclasses.replace(drawn.unit, light=light))


def _one_unit(drawn: Draw, rng: np.random.Generator) -> Draw:
    light = dataclasses.replace(drawn.unit.light, exposure=as_f32(1.0), led_gain=as_f32(np.ones(3)))
    unit = dataclasses.replace(drawn.unit, light=light, modulus_factor=as_f32(1.0))
    return dataclasses.replace(drawn, unit=unit, press=dataclasses.replace(drawn.press, exposure_drift=as_f32(0.0)))


def _one_wave(skin: Skin) -> Mapping[str, Any]:
    length = np.linalg.norm(skin.wave_numbers, axis=1, keepdims=True)
    amplitude = np.sqrt(np.mean(np.square(skin.wave_amplitudes_mm)))
    numbers = skin.wave_numbers / length * (2 * np.pi / WAVE_MM)
    amplitudes = np.full(skin.wave_amplitudes_mm.shape, amplitude)
    return {"wave_numbers": as_f32(numbers), "wave_amplitudes_mm": as_f32(amplitudes)}


def _one_relief(skin: Skin) -> Mapping[str, Any]:
    return {"pattern": np.int32(0), "feature_pitch_mm": as_f32(PITCH_MM), "feature_width": as_f32(WIDTH)}


def _by_hand(drawn: Draw, rng: np.random.Generator) -> Mapping[str, Any]:
    """The hand turns, slides and tilts the sensor on the object, evenly over the frames."""
    share = np.linspace(0, 1, len(drawn.press.path.force_n))
    turn, slide, tilt = rng.normal(0, TURN_RAD), rng.normal(0, SLIDE_MM, 2), rng.normal(0, TILT_RAD, 2)
    moved: dict[str, Any] = {
        "slide_mm": as_f32(np.outer(share, slide)),
        "twist_rad": as_f32(share * turn),
        "tilt_rad": as_f32(np.outer(share, tilt)),
    }
    return {"path": dataclasses.replace(drawn.press.path, **moved)}


def _any_force(drawn: Draw, rng: np.random.Generator) -> Mapping[str, Any]:
    """The greatest force is drawn for every press, evenly in its logarithm."""
    path = drawn.press.path
    factor = np.exp(rng.uniform(np.log(min(LEAST_N / float(path.force_n[-1]), 1.0)), 0))
    return {"path": dataclasses.replace(path, force_n=as_f32(np.asarray(path.force_n) * factor))}


AS_GENERATED = "as generated"

VARIANTS: Mapping[str, PressVariant] = {
    AS_GENERATED: PressVariant(),
    "optics: lamps set by eye": PressVariant(change=_sensor(render=lamps_by_eye)),
    "optics: gel without grain": PressVariant(change=_no_grain),
    "optics: one unit, no drift": PressVariant(change=_one_unit),
    "noise: none of the camera": PressVariant(change=_sensor(read_noise=(0.0,) * 3, shot_noise=(0.0,) * 3)),
    "texture: one wavelength": PressVariant(change=_skin(_one_wave)),
    "texture: none": PressVariant(
        change=_skin(lambda skin: {"wave_amplitudes_mm": as_f32(np.zeros(skin.wave_amplitudes_mm.shape))})
    ),
    "shapes: one curvature": PressVariant(
        change=_skin(lambda skin: {"curvature_per_mm": as_f32(np.full(2, 1 / CURVATURE_MM))})
    ),
    "shapes: one relief": PressVariant(change=_skin(_one_relief)),
    "contact: rigid objects": PressVariant(change=_press(lambda drawn, rng: {"modulus_mpa": as_f32(RIGID_MPA)})),
    "contact: bed of springs": PressVariant(springs=True),
    "grid: 32 in place of 64": PressVariant(scenes={"contact_grid": 32}),
    "pictures: 56 px in place of 112": PressVariant(scenes={"image_px": 56}),
    "motion: turned and slid by hand": PressVariant(change=_press(_by_hand), moving=True),
    "motion: any greatest force": PressVariant(change=_press(_any_force)),
}
"""Parts that are left out or coarser and, last, two that generated presses lack."""
