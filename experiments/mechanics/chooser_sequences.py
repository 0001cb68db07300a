"""Errors of generated sequences with a requested error (`SceneConfig.error`), compared with a finer solution.

Frames are drawn from those that touch, so most are not among the few that `effort.choose` looks at, and are solved as
`press.record` solves them.  The reference is that of the chooser's measurement (`chooser_measure`).
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.mechanics import chooser_measure as measured
from sensors_io import layer
from sensors_io.scenes import contact, effort, nested, protocol
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.draws import Draw, draw
from sensors_io.scenes.press import GridSizes, Kernels, Path, Press, Scene, make_kernels
from sensors_io.scenes.readout import Unit
from sensors_io.scenes.sensors import BODY, MODELS, SensorModel

FRAMES = 6
"""Frames of a sequence that are compared."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SequenceTrial:
    """One error asked for, over S sequences: grid, whether it is promised [S], motions, error of frames [S, FRAMES]."""

    asked: float
    grid: np.ndarray
    met: np.ndarray
    error: np.ndarray
    motion: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Lists of numbers."""
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in fields.items()}


def join(parts: Sequence[Mapping[str, Any]]) -> SequenceTrial:
    """The sequences of several sensors at one error, each as `Kept.to_json` gives it."""
    arrays = {name: np.concatenate([np.asarray(p[name]) for p in parts]) for name in ("grid", "met", "error")}
    return SequenceTrial(asked=parts[0]["asked"], motion=tuple(m for p in parts for m in p["motion"]), **arrays)


def try_out(order: int, count: int, asked: Sequence[float], reference: int, seed: int) -> list[SequenceTrial]:
    """Choose and solve `count` sequences of sensor `order` at every error asked for, presses and motions by turns."""
    config = SceneConfig(objects=count, sequences=2 * count * len(MODELS), frames=20, seed=seed)
    rng = np.random.default_rng([seed, order])
    chosen = range(0, config.contact_count, 2)
    drawn = [draw(config, index, protocol.slot(config, index), order) for index in chosen]
    paths = [_some_frames(each, rng) for each in drawn]
    true = jnp.concatenate([_reference(each, path, reference) for each, path in zip(drawn, paths, strict=True)])
    return [_kept(error, drawn, paths, true) for error in asked]


def _some_frames(drawn: Draw, rng: np.random.Generator) -> Path:
    touching = np.nonzero(np.asarray(drawn.press.path.force_n) > 0)[0]
    frames = np.sort(rng.choice(touching, FRAMES, replace=len(touching) < FRAMES))
    return jax.tree.map(lambda leaf: leaf[frames], drawn.press.path)


def _kept(asked: float, drawn: Sequence[Draw], paths: Sequence[Path], true: Array) -> SequenceTrial:
    """The sequences at one error, solved as chosen."""
    efforts = [effort.choose(asked, d.press, d.unit.modulus_factor, d.sensor) for d in drawn]
    errors = []
    for k, (each, path, how) in enumerate(zip(drawn, paths, efforts, strict=True)):
        grid = GridSizes(contact_grid=how.grid, image_px=how.grid)
        found = _solve(each.press, path, each.unit, make_kernels(each.sensor, grid), how.tolerance, each.sensor, grid)
        errors.append(measured.errors_of(found, true[k * FRAMES : (k + 1) * FRAMES]))
    return SequenceTrial(
        asked=asked,
        grid=np.array([e.grid for e in efforts]),
        met=np.array([e.met for e in efforts]),
        error=np.stack(errors),
        motion=tuple(d.hand.motion for d in drawn),
    )


def _reference(drawn: Draw, path: Path, grid: int) -> Array:
    """Displacement on half the reference's grid, [FRAMES, K, K]."""
    sides = GridSizes(contact_grid=grid, image_px=grid)
    kernels = _widely_padded(drawn.sensor, grid)
    found = _solve(drawn.press, path, drawn.unit, kernels, measured.REFERENCE_TOLERANCE, drawn.sensor, sides)
    return jax.vmap(lambda u: nested.coarsen(u, 2))(found)


@functools.lru_cache(maxsize=2)
def _widely_padded(sensor: SensorModel, grid: int) -> Kernels:
    """Kernels of the normal contact alone, with the padding of the reference solution."""
    q = np.hypot(*layer.wave_numbers(round(grid * measured.REFERENCE_PADDING), sensor.window_mm / grid))
    gel, body = (jnp.asarray(layer.normal_compliance(q, each), jnp.float32) for each in (sensor.gel, BODY))
    coarse = make_kernels(sensor, GridSizes(contact_grid=effort.GRIDS[0], image_px=effort.GRIDS[0]))
    return dataclasses.replace(coarse, gel=gel, body=body)


@functools.partial(jax.jit, static_argnames=("sensor", "grid"))
def _solve(
    press: Press, path: Path, unit: Unit, kernels: Kernels, tolerance: float, sensor: SensorModel, grid: GridSizes
) -> Array:
    """Displacement of every frame of a path, [F, n, n]."""
    scene = Scene(press, unit, kernels, sensor, grid, (tolerance, contact.MAX_ITERATIONS))
    return jax.lax.map(lambda at: scene.solve(scene.gap(at), at.force_n).displacement_mm, path)
