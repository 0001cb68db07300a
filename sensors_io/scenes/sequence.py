"""One sequence: one contact by one sensor, from what was drawn to the arrays that are stored."""

from typing import Any

import jax
import numpy as np

from sensors_io.scenes import adhesion, effort, schedule
from sensors_io.scenes.cards import object_id, region_px
from sensors_io.scenes.config import GENERATOR, SceneConfig
from sensors_io.scenes.draws import Draw, Site, draw
from sensors_io.scenes.effort import Effort
from sensors_io.scenes.press import GridSizes, make_kernels, record
from sensors_io.scenes.sensors import MODELS, SensorModel
from sensors_io.scenes.validity import STRAIN_LIMIT
from sensors_io.schema import ContactKey, Flag, Sequence

_FORCE_LEAD_NS = 2_000_000  # the force sensor is read 2 ms before the picture arrives
_TURN_MS = 10_000.0  # from the start of one sensor's sequence to that of the next: three times the longest
_MOVING = ("slide_x", "slide_y", "twist", "roll")


def make_sequence(config: SceneConfig, index: int, what: schedule.Slot, order: int, trial: int) -> Sequence:
    """Contact `index` by sensor number `order`, at attempt `trial`."""
    drawn = draw(config, index, what, order, trial)
    sensor, hand = drawn.sensor, drawn.hand
    chosen = effort_of(config, drawn)
    made = _record(config, drawn, chosen)
    time_ns = _times(index, order, drawn)
    markers = sensor.marker_depth_mm is not None
    return Sequence(
        key=key_of(what, trial),
        sensor=sensor.name,
        serial=f"generated-{sensor.name}-{drawn.serial}",
        calibration=f"generated-{GENERATOR}",
        contact_region_px=region_px(config, sensor, drawn.site.place_mm),
        mm_per_px=sensor.window_mm / config.image_px if sensor.render is not None else None,
        frames=made.frames,
        deformation_mm=made.fields.deformation_mm if markers else None,
        shear_mm=made.fields.shear_mm if markers else None,
        depth_mm=made.fields.depth_mm,
        valid=made.fields.valid,
        force_n=drawn.force_sensor.read(np.column_stack([made.force_n[:, :2], -drawn.force_n])),
        moment_nmm=made.moment_nmm,
        target_force_n=hand.force_n.astype(np.float32),
        host_time_ns=time_ns,
        force_time_ns=time_ns - _FORCE_LEAD_NS,
        phase=hand.phase,
        flags=_flags(made, chosen) | light_touches(config, sensor, drawn.site, drawn.force_n),
        contact_grid=None if config.error is None else np.full(len(hand), chosen.grid, np.uint16),
    )


def key_of(what: schedule.Slot, trial: int) -> ContactKey:
    """Identity of a contact as made at attempt `trial`."""
    return ContactKey(object_id=object_id(what.object_index), site=what.site, motion=what.motion, trial=trial)


def effort_of(config: SceneConfig, drawn: Draw) -> Effort:
    """Solver settings of a sequence: as chosen for the error asked for, else those of the config."""
    if config.error is None:
        return Effort(grid=config.contact_grid, tolerance=config.solver_tolerance, met=True)
    return effort.choose(config.error, drawn.press, drawn.unit.modulus_factor, drawn.sensor)


def _record(config: SceneConfig, drawn: Draw, chosen: Effort) -> Any:
    """The `Recording` of the sensor's compiled program, as NumPy arrays."""
    grid = GridSizes(contact_grid=chosen.grid, image_px=config.image_px)
    limits = (chosen.tolerance, config.solver_max_iterations)
    kernels = make_kernels(drawn.sensor, grid, coupled=config.coupled)
    moving = config.coupled or drawn.hand.motion in _MOVING
    made = record(drawn.press, drawn.unit, kernels, drawn.key, drawn.sensor, grid, *limits, moving=moving)
    return jax.device_get(made)


def _flags(made: Any, chosen: Effort) -> np.ndarray:
    """Flags of each frame, [F] uint32."""
    flags: np.ndarray = made.failures.copy()
    flags[made.strain > STRAIN_LIMIT] |= np.uint32(Flag.STRAIN_LIMIT)
    flags[~made.converged] |= np.uint32(Flag.NOT_CONVERGED)
    if not chosen.met:
        flags |= np.uint32(Flag.ERROR_UNMET)
    return flags


def light_touches(config: SceneConfig, sensor: SensorModel, site: Site, force_n: np.ndarray) -> np.ndarray:
    """Frames that touch so lightly that adhesion, which is left out, would count: bits [F] uint32.

    Of the body's mean curvature and its roughness at the site; relief, which makes narrower contacts, is left out.
    """
    modulus = adhesion.plane_modulus_mpa(sensor.gel, site.body)
    work = 1e-3 * config.adhesion_j_per_m2  # N/mm
    contact = adhesion.Adhesion(
        radius_mm=1 / float(np.mean(site.skin.curvature_per_mm)),
        plane_modulus_mpa=modulus,
        work_n_per_mm=adhesion.work_left(work, modulus, site.solid.wave_numbers, site.solid.wave_amplitudes_mm),
    )
    light = (force_n > 0) & (force_n < contact.least_force_n(config.adhesion_tolerance))
    return np.where(light, np.uint32(Flag.ADHESION), np.uint32(0))


def _times(index: int, order: int, drawn: Draw) -> np.ndarray:
    """Host stamps, ns [F]: the sensors touch one after another; frames come on the camera's clock, each on a tick of
    its own.
    """
    begin_ms = _TURN_MS * (index * len(MODELS) + order)
    count, period_ms = np.arange(len(drawn.hand)), drawn.sensor.frame_period_ms
    tick = np.maximum.accumulate(np.round(1000 * drawn.hand.time_s / period_ms) - count) + count
    return np.round((begin_ms + tick * period_ms) * 1e6).astype(np.int64)
