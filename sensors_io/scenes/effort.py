"""On which grid and to which tolerance one sequence is solved, so that its contacts stay below an error.

`press.record` solves all frames of a sequence on one grid.  A few of them are solved on the chooser's coarsest grid,
and what these show about finer ones decides: the cheapest setting that promises enough for every one of them.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sensors_io import layer
from sensors_io.scenes import contact, motions, nested, surface
from sensors_io.scenes.chooser_law import LAW, LOOK, SLACK, TOLERANCES, Setting, log_error, margin_at
from sensors_io.scenes.chooser_survey import gel_share, survey
from sensors_io.scenes.press import Path, Press, padded_size
from sensors_io.scenes.sensors import BODY, SensorModel

GRIDS = (64, 96, 128)
"""Sides of the grids.  On coarser ones the gap, taken at points and not as means, misses the shortest roughness, and
probes trained on them lose more than two points (`identifiability`).  Each costs a compiled program per sensor."""

_LOOKED = 6  # frames that are looked at, evenly spread over those that touch
_FINEST = 4 * LOOK.grid  # where the gap is evaluated for a look


@dataclasses.dataclass(frozen=True, kw_only=True)
class Effort:
    """Solver settings of a sequence; `met` promises every frame that was examined the error asked for."""

    grid: int
    tolerance: float
    met: bool


def choose(error: float, press: Press, modulus_factor: float | Array, sensor: SensorModel) -> Effort:
    """The cheapest effort that promises an error.

    Args:
      error: relative L₂ error that displacement and slope of a contact may have, in (0, 1].
      press: what is touched; its path may have frames that do not touch.
      modulus_factor: the unit's modulus over that of its model.
      sensor: the sensor type.
    """
    touching = np.nonzero(np.asarray(press.path.force_n) > 0)[0]
    if not len(touching):
        return Effort(grid=GRIDS[0], tolerance=TOLERANCES[0], met=True)
    frames = touching[np.linspace(0, len(touching) - 1, _LOOKED).round().astype(int)]
    path = jax.tree.map(lambda leaf: leaf[frames], press.path)
    expected = np.exp(np.asarray(_log_errors(press, path, modulus_factor, *_spectra(sensor), sensor))).max(0)
    enough = float(margin_at(error, LAW)) * expected <= SLACK * error
    setting = menu(sensor)[int(enough.argmax() if enough.any() else expected.argmin())]
    met = float(LAW.doubt) * expected.min() <= SLACK * error
    return Effort(grid=setting.grid, tolerance=setting.tolerance, met=bool(met))


@functools.lru_cache(maxsize=8)
def menu(sensor: SensorModel) -> tuple[Setting, ...]:
    """The settings that a sequence may be solved under, cheapest first; padded as `press.make_kernels` pads."""
    sizes = {n: padded_size(n, sensor.window_mm, sensor.gel.thickness_mm) for n in GRIDS}
    settings = [Setting(grid=n, padded=sizes[n], tolerance=t) for n in GRIDS for t in TOLERANCES]
    return tuple(sorted(settings, key=lambda s: s.cost))


@functools.partial(jax.jit, static_argnames="sensor")
def _log_errors(press: Press, path: Path, modulus_factor: Array, gel: Array, body: Array, sensor: SensorModel) -> Array:
    """ln ê of every frame of the path and every setting, [F, T]."""
    x = (jnp.arange(_FINEST, dtype=jnp.float32) + 0.5) * sensor.window_mm / _FINEST - sensor.window_mm / 2
    soft, series = gel / modulus_factor, body / press.modulus_mpa
    thickness = sensor.gel.thickness_mm

    def one(at: Path) -> Array:
        pose = motions.moved(press.pose, at.slide_mm, at.twist_rad, at.tilt_rad)
        finest = surface.gap(press.skin, pose, x)
        finer, gap = nested.coarsen(finest, 2), nested.coarsen(finest, 4)
        spacing = sensor.window_mm / LOOK.grid
        found = contact.solve(gap, at.force_n, soft, series, spacing, LOOK.tolerance, thickness_mm=thickness)
        share = gel_share(soft, series)
        gaps = (gap, finer, finest)
        surveyed = survey(found.pressure_mpa, found.displacement_mm, gaps, share, sensor.window_mm, thickness)
        return log_error(surveyed, LAW, menu(sensor))

    return jax.lax.map(one, path)


@functools.lru_cache(maxsize=8)
def _spectra(sensor: SensorModel) -> tuple[Array, Array]:
    """Compliance of gel and of an object of 1 MPa on the look's padded grid."""
    q = np.hypot(*layer.wave_numbers(LOOK.padded, sensor.window_mm / LOOK.grid))
    gel, body = (jnp.asarray(layer.normal_compliance(q, each), jnp.float32) for each in (sensor.gel, BODY))
    return gel, body
