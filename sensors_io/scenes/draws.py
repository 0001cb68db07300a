"""Random draws of one sequence before anything is solved: site, unit, hand, path, errors of the force sensor.

Everything follows from (config, contact, sensor, trial) by streams of its own, so that whoever wants to solve, render
or summarise a sequence in another way than `sequence` begins with the very same touch.
"""

import dataclasses
import functools

import numpy as np

from sensors_io.layer import Layer
from sensors_io.scenes import history, motions, noise, objects, schedule, surface
from sensors_io.scenes.cards import solid_of
from sensors_io.scenes.config import SceneConfig, stream
from sensors_io.scenes.press import Path, Press
from sensors_io.scenes.readout import Unit
from sensors_io.scenes.sensors import BODY, MODELS, SensorModel
from sensors_io.scenes.surface import as_f32
from sensors_io.scenes.units import UNITS, on_one_day, place, unit_of
from sensors_io.schema import Phase

SITE_MM = 8.0
"""Sites lie within this distance of the object's centre along both axes: the windows stay on the view of the object."""

_CURVATURE_SPREAD = 0.15  # of the body's curvature from site to site, standard deviation of its logarithm; assumed
_EXPOSURE_DRIFT = 0.01  # over a sequence, standard deviation, relative; assumed
_CROSSTALK = 0.01  # of the normal force into each tangential axis, standard deviation; 1 % is usual for such cells
_WORST_JITTER = 3.0  # standard deviations of the hand's error that are let through: a force stays above 0
_GEL_LOSS = 0.06  # share of the energy that a gel keeps on unloading; assumed
_CONTACT_MM = 3.0  # radius of an ordinary contact, by which the object's share of the stored energy is taken


@dataclasses.dataclass(frozen=True, kw_only=True)
class Site:
    """Values that all sensors share in a contact: the local object, skin, place (mm from its centre), direction."""

    solid: objects.Solid
    skin: surface.Skin
    place_mm: np.ndarray
    turn_rad: float

    @property
    def body(self) -> Layer:
        """The object as the layer in series with a gel."""
        return dataclasses.replace(BODY, modulus_mpa=self.solid.modulus_mpa)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ForceSensor:
    """Errors of the force sensor in one sequence: relative gain, crosstalk of the normal force [3], noise [F, 3], N."""

    gain: float
    crosstalk: np.ndarray
    noise_n: np.ndarray

    def read(self, force_n: np.ndarray) -> np.ndarray:
        """Force on the gel as the sensor reads it, N, float32 [F, 3]: gain · f − crosstalk · f_z + noise."""
        read: np.ndarray = self.gain * force_n - self.crosstalk * force_n[:, 2:] + self.noise_n
        return read.astype(np.float32)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Draw:
    """One sequence of F frames before it is solved.

    `hand` is what the hand is asked for, `force_n` [F] the normal force that it applies, ≥ 0; `press.path.force_n` is
    the elastic force, at which the contact is to be solved.  `unit` is that of the day, `key` that of all noise.
    """

    site: Site
    sensor: SensorModel
    serial: int
    unit: Unit
    hand: motions.Plan
    force_n: np.ndarray
    press: Press
    key: np.ndarray
    force_sensor: ForceSensor


@functools.lru_cache(maxsize=64)
def site_of(config: SceneConfig, object_index: int, site: int, trial: int) -> Site:
    """Site number `site` of an object, as drawn at attempt `trial`."""
    rng = stream(config.seed, "contact", object_index, site, trial)
    spot = rng.uniform(-SITE_MM, SITE_MM, 2)
    solid = solid_of(config, object_index).at(spot)
    turn = rng.uniform(0, 2 * np.pi)
    skin = surface.make_skin(solid, spot, float(np.exp(_CURVATURE_SPREAD * rng.standard_normal())))
    return Site(solid=solid, skin=skin, place_mm=spot, turn_rad=turn)


def draw(config: SceneConfig, index: int, what: schedule.Slot, order: int, trial: int = 0) -> Draw:
    """Contact `index` by sensor number `order`, at attempt `trial`."""
    site = site_of(config, what.object_index, what.site, trial)
    sensor = MODELS[order]
    rng = stream(config.seed, "press", index, order, trial)
    serial = int(rng.integers(UNITS))
    hand = _hand(config, what)
    jitter = np.clip(rng.standard_normal(len(hand)), -_WORST_JITTER, _WORST_JITTER)
    force = hand.force_n * (1 + config.force_jitter * jitter)
    press = Press(
        skin=site.skin,
        pose=place(site.turn_rad, rng),
        modulus_mpa=as_f32(site.solid.modulus_mpa),
        friction=as_f32(site.solid.friction),
        path=_path(hand, history.elastic_force(force, _loss(sensor, site))),
        exposure_drift=as_f32(_EXPOSURE_DRIFT * rng.standard_normal()),
    )
    unit = on_one_day(unit_of(config.seed, order, serial), rng)
    return Draw(
        site=site,
        sensor=sensor,
        serial=serial,
        unit=unit,
        hand=hand,
        force_n=force,
        press=press,
        key=noise.key(rng),
        force_sensor=_force_sensor(config, len(hand), rng),
    )


def _hand(config: SceneConfig, what: schedule.Slot) -> motions.Plan:
    """Target forces of the hand: geometric levels where only presses are made, else the motion's plan."""
    if config.sequences is not None:
        return motions.plan(what.motion, what.force_n, schedule.pace(config.frame_count))
    count = config.frame_count
    force = np.geomspace(config.min_force_n, what.force_n, count)
    still = np.zeros((count, 2))
    return motions.Plan(
        motion=what.motion,
        force_n=force,
        slide_mm=still,
        twist_rad=still[:, 0],
        tilt_rad=still,
        phase=np.full(count, Phase.LOAD, np.uint8),
        time_s=force / what.force_n * config.ramp_s,
    )


def _path(hand: motions.Plan, elastic_n: np.ndarray) -> Path:
    return Path(
        force_n=as_f32(elastic_n),
        slide_mm=as_f32(hand.slide_mm),
        twist_rad=as_f32(hand.twist_rad),
        tilt_rad=as_f32(hand.tilt_rad),
    )


def _loss(sensor: SensorModel, site: Site) -> float:
    """Share of the energy that gel and object keep on unloading."""
    share = history.body_share(sensor.gel, site.body, _CONTACT_MM)
    return history.Loss(gel=_GEL_LOSS, body=1 - site.solid.energy_returned).of_contact(share)


def _force_sensor(config: SceneConfig, frames: int, rng: np.random.Generator) -> ForceSensor:
    gain = 1 + config.force_gain_error * rng.standard_normal()
    crosstalk = np.append(_CROSSTALK * rng.standard_normal(2), 0)
    return ForceSensor(gain=gain, crosstalk=crosstalk, noise_n=config.force_noise_n * rng.standard_normal((frames, 3)))
