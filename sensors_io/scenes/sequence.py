"""One sequence: one contact by one sensor, from what the hand is asked for to the arrays that are stored."""

import dataclasses
import functools
from typing import Any

import jax
import numpy as np

from sensors_io.scenes import adhesion, history, motions, noise, objects, schedule, surface
from sensors_io.scenes.cards import object_id, region_px, solid_of
from sensors_io.scenes.config import GENERATOR, SceneConfig, as_f32, stream
from sensors_io.scenes.layer import Layer
from sensors_io.scenes.press import Grid, Path, Press, make_kernels, record
from sensors_io.scenes.readout import Unit
from sensors_io.scenes.sensors import BODY, MODELS, SensorModel
from sensors_io.scenes.units import UNITS, on_one_day, place, unit_of
from sensors_io.scenes.validity import STRAIN_LIMIT
from sensors_io.schema import ContactKey, Flag, Sequence

_FORCE_LEAD_NS = 2_000_000  # the force sensor is read 2 ms before the picture arrives
_MOVING = ("slide_x", "slide_y", "twist", "roll")
_GEL_LOSS = 0.06  # share of the energy that a gel keeps on unloading; assumed
_CONTACT_MM = 3.0  # radius of an ordinary contact, by which the object's share of the stored energy is taken


@dataclasses.dataclass(frozen=True, kw_only=True)
class Site:
    """What all sensors share in a contact: the object as it is there, skin, place (mm from its centre), direction."""

    solid: objects.Solid
    skin: surface.Skin
    place_mm: np.ndarray
    turn_rad: float


@functools.lru_cache(maxsize=64)
def site_of(config: SceneConfig, object_index: int, site: int, trial: int) -> Site:
    """Site number `site` of an object, as drawn at attempt `trial`."""
    rng = stream(config.seed, "contact", object_index, site, trial)
    spot = rng.uniform(-8, 8, 2)
    solid = solid_of(config, object_index).at(spot)
    turn = rng.uniform(0, 2 * np.pi)
    skin = surface.make_skin(solid, spot, float(np.exp(0.15 * rng.standard_normal())))
    return Site(solid=solid, skin=skin, place_mm=spot, turn_rad=turn)


def make_sequence(config: SceneConfig, index: int, what: schedule.Slot, order: int, trial: int) -> Sequence:
    """Contact `index` by sensor number `order`."""
    site = site_of(config, what.object_index, what.site, trial)
    sensor = MODELS[order]
    rng = stream(config.seed, "press", index, order, trial)
    serial = int(rng.integers(UNITS))
    hand = _hand(config, what)
    force = hand.force_n * (1 + config.force_jitter * np.clip(rng.standard_normal(len(hand)), -3, 3))
    press = Press(
        skin=site.skin,
        pose=place(site.turn_rad, rng),
        modulus_mpa=as_f32(site.solid.modulus_mpa),
        friction=as_f32(site.solid.friction),
        path=Path(
            force_n=as_f32(history.elastic_force(force, _loss(sensor, site.solid))),
            slide_mm=as_f32(hand.slide_mm),
            twist_rad=as_f32(hand.twist_rad),
            tilt_rad=as_f32(hand.tilt_rad),
        ),
        exposure_drift=as_f32(0.01 * rng.standard_normal()),
    )
    unit = on_one_day(unit_of(config.seed, order, serial), rng)
    made = _record(config, sensor, press, unit, noise.key(rng), what.motion in _MOVING)
    time_ns = _times(index, order, sensor, hand)
    markers = sensor.marker_depth_mm is not None
    return Sequence(
        key=key_of(what, trial),
        sensor=sensor.name,
        serial=f"generated-{sensor.name}-{serial}",
        calibration=f"generated-{GENERATOR}",
        contact_region_px=region_px(config, sensor, site.place_mm),
        mm_per_px=sensor.window_mm / config.image_px if sensor.render is not None else None,
        frames=made.frames,
        deformation_mm=made.fields.deformation_mm if markers else None,
        shear_mm=made.fields.shear_mm if markers else None,
        depth_mm=made.fields.depth_mm,
        valid=made.fields.valid,
        force_n=_weighed(config, np.column_stack([made.force_n[:, :2], -force]), rng),
        moment_nmm=made.moment_nmm,
        target_force_n=hand.force_n.astype(np.float32),
        host_time_ns=time_ns,
        force_time_ns=time_ns - _FORCE_LEAD_NS,
        phase=hand.phase,
        flags=_flags(made) | _light(config, sensor, site, force),
    )


def key_of(what: schedule.Slot, trial: int) -> ContactKey:
    """Identity of a contact as made at attempt `trial`."""
    return ContactKey(object_id=object_id(what.object_index), site=what.site, motion=what.motion, trial=trial)


def _loss(sensor: SensorModel, solid: objects.Solid) -> float:
    """Share of the energy that gel and object keep on unloading."""
    share = history.body_share(sensor.gel, _body(solid), _CONTACT_MM)
    return history.Loss(gel=_GEL_LOSS, body=1 - solid.energy_returned).of_contact(share)


def _body(solid: objects.Solid) -> Layer:
    return dataclasses.replace(BODY, modulus_mpa=solid.modulus_mpa)


def _record(config: SceneConfig, sensor: SensorModel, press: Press, unit: Unit, key: np.ndarray, moving: bool) -> Any:
    """The `Recording` of a sensor's compiled program, as NumPy arrays."""
    grid = Grid(contact_grid=config.contact_grid, image_px=config.image_px)
    limits = (config.solver_tolerance, config.solver_max_iterations)
    kernels = make_kernels(sensor, grid)
    return jax.device_get(record(press, unit, kernels, key, sensor, grid, *limits, moving=moving))


def _flags(made: Any) -> np.ndarray:
    """What is wrong with each frame, [F] uint32."""
    flags: np.ndarray = made.failures.copy()
    flags[made.strain > STRAIN_LIMIT] |= np.uint32(Flag.STRAIN_LIMIT)
    flags[~made.converged] |= np.uint32(Flag.NOT_CONVERGED)
    return flags


def _light(config: SceneConfig, sensor: SensorModel, site: Site, force_n: np.ndarray) -> np.ndarray:
    """Frames that touch so lightly that adhesion, which is left out, would count: bits [F] uint32.

    Of the body's mean curvature and its roughness at the site; relief, which makes narrower contacts, is left out.
    """
    modulus = adhesion.plane_modulus_mpa(sensor.gel, _body(site.solid))
    work = 1e-3 * config.adhesion_j_per_m2  # N/mm
    contact = adhesion.Adhesion(
        radius_mm=1 / float(np.mean(site.skin.curvature_per_mm)),
        plane_modulus_mpa=modulus,
        work_n_per_mm=adhesion.work_left(work, modulus, site.solid.wave_numbers, site.solid.wave_amplitudes_mm),
    )
    touches = force_n > 0
    if contact.may_be_left_out(float(force_n[touches].min()), config.adhesion_tolerance):
        return np.zeros(len(force_n), np.uint32)
    light = touches & (force_n < contact.least_force_n(config.adhesion_tolerance))
    return np.where(light, np.uint32(Flag.ADHESION), np.uint32(0))


def _hand(config: SceneConfig, what: schedule.Slot) -> motions.Plan:
    """What the hand is asked for: geometric levels of force where only presses are made, else the motion's plan."""
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
        phase=np.full(count, motions.Phase.LOAD, np.uint8),
        time_s=force / what.force_n * config.ramp_s,
    )


def _weighed(config: SceneConfig, force_n: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Force as the sensor under the gel reads it, [F, 3]: a gain error, crosstalk of the normal force, noise."""
    gain = 1 + config.force_gain_error * rng.standard_normal()
    crosstalk = np.append(0.01 * rng.standard_normal(2), 0)
    noise_n = config.force_noise_n * rng.standard_normal(force_n.shape)
    return (gain * force_n - crosstalk * force_n[:, 2:] + noise_n).astype(np.float32)


def _times(index: int, order: int, sensor: SensorModel, hand: motions.Plan) -> np.ndarray:
    """Host stamps: the sensors touch one after another, 10 s apart; frames come on the camera's clock, each on a tick
    of its own.
    """
    begin_ms = 10_000.0 * (index * len(MODELS) + order)
    count = np.arange(len(hand))
    tick = np.maximum.accumulate(np.round(1000 * hand.time_s / sensor.frame_period_ms) - count) + count
    return np.round((begin_ms + tick * sensor.frame_period_ms) * 1e6).astype(np.int64)
