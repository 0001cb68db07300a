"""Choice of the grid, padding and tolerance that keep a contact below an error, from a first, coarse solution.

Every scene is solved on 24² (`LOOK`), which takes a tenth of a millisecond.  What that solution and the gap on finer
grids show (`chooser_survey`) goes into a law of the error of every setting (`chooser_law`).  Where the coarse solution
is good enough it is the answer; else the cheapest setting that is goes on from it, so that little of the look is lost.
No setting is a bed of springs alone: that is off by tens of per cent on every grid.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from sensors_io import layer
from sensors_io.layer import Layer
from sensors_io.scenes import contact, nested
from sensors_io.scenes.batching import chunks, gather, map_live
from sensors_io.scenes.chooser_law import LAW, LOOK, MENU, Law, Survey, log_error, pick
from sensors_io.scenes.chooser_survey import gel_share, survey
from sensors_io.scenes.config import require

LOOK_GRIDS = (LOOK.grid, 2 * LOOK.grid, 4 * LOOK.grid)
"""Sides of the grids on which a look takes the gap."""

Gaps = Callable[[int, np.ndarray], Array | np.ndarray]
"""Distance of the undeformed bodies, mm: from the side n of a grid and R indices of scenes to [R, n, n]."""

Gap = Callable[[int], Array] | Array
"""The same of one scene: a function of the grid's side, or an array on a fine grid."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactScene:
    """Surroundings of contacts: the gel, its square window, and the object as a layer of 1 MPa, `None` if rigid."""

    gel: Layer
    body: Layer | None
    window_mm: float

    def __post_init__(self) -> None:
        require(self.window_mm > 0, "window_mm", self.window_mm, "must be > 0")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactSettings:
    """Settings for solving a contact, and the predicted error and cost.

    `promised_error` is the law's bound of the error.  Where `met` is false the setting is the one of least error, and
    not enough.
    """

    grid: int
    padded: int
    tolerance: float
    tier: contact.Tier
    promised_error: float
    met: bool


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bucket:
    """The scenes that one grid and padding solved: their indices [R] and contacts, stacked."""

    grid: int
    padded: int
    rows: np.ndarray
    contacts: contact.Contact


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solved:
    """S scenes: the choice of each, and their contacts by grid."""

    choices: tuple[ContactSettings, ...]
    buckets: tuple[Bucket, ...]


@struct.dataclass
class CoarseSolve:
    """One look: the coarse contact, what it shows, and what follows for the error asked for."""

    contact: contact.Contact
    survey: Survey
    index: Int[Array, "..."]
    promised: Float[Array, "..."]
    met: Bool[Array, "..."]


def choose(error: float, gap: Gap, force_n: float, gel: Layer, body: Layer | None, window_mm: float) -> ContactSettings:
    """Choose as `solve` does, for who solves by other means."""
    stage, gaps, modulus = _alone(gap, gel, body, window_mm)
    seen = look(error, gaps, np.array([force_n]), modulus, stage)
    return _choices(seen)[0]


def solve(
    error: float, gap: Gap, force_n: float, gel: Layer, body: Layer | None, window_mm: float
) -> tuple[ContactSettings, contact.Contact]:
    """Solve one contact on the cheapest setting whose promised error is at most 1.5 times the error asked for.

    Args:
      error: relative L₂ error that displacement and slope may have, in (0, 1].
      gap: of the undeformed bodies, mm; an array's side must be a multiple of all grids that are chosen.
      force_n: prescribed force, > 0.
      gel: the layer.
      body: the object in series as a layer; `None` for a rigid one.
      window_mm: side of the square window.

    Raises:
      ValueError: an error, a force or a window out of range, a gap that does not fit a grid.
    """
    stage, gaps, modulus = _alone(gap, gel, body, window_mm)
    solved = solve_many(error, gaps, np.array([force_n]), modulus, stage)
    (bucket,) = solved.buckets
    return solved.choices[0], jax.tree.map(lambda leaf: leaf[0], bucket.contacts)


def solve_many(error: float, gaps: Gaps, force_n: np.ndarray, modulus_mpa: np.ndarray, stage: ContactScene) -> Solved:
    """Solve S contacts on one gel, each as `solve` does; the host sorts them by grid between look and solution.

    Compiles one program for the look and one for every grid and padding that is ever chosen.

    Args:
      error: relative L₂ error that displacement and slope may have, in (0, 1].
      gaps: of the undeformed bodies, mm.
      force_n: prescribed forces, > 0, [S].
      modulus_mpa: moduli of the objects, > 0, [S]; whatever for a rigid one.
      stage: gel, object, window.

    Raises:
      ValueError: an error, a force or a modulus out of range.
    """
    seen = look(error, gaps, force_n, modulus_mpa, stage)
    index = np.asarray(seen.index)
    programs = np.array([(s.grid, s.padded) for s in MENU])
    buckets = []
    for grid, padded in np.unique(programs[index], axis=0).tolist():
        rows = np.nonzero((programs[index] == (grid, padded)).all(1) & (index != MENU.index(LOOK)))[0]
        if len(rows):
            found = _go_on(seen, gaps, rows, force_n, modulus_mpa, stage, (grid, padded))
            buckets.append(Bucket(grid=grid, padded=padded, rows=rows, contacts=found))
    done = np.nonzero(index == MENU.index(LOOK))[0]
    if len(done):
        found = jax.tree.map(lambda leaf: leaf[done], seen.contact)
        buckets.append(Bucket(grid=LOOK.grid, padded=LOOK.padded, rows=done, contacts=found))
    return Solved(choices=_choices(seen), buckets=tuple(buckets))


def look(
    error: float, gaps: Gaps, force_n: np.ndarray, modulus_mpa: np.ndarray, stage: ContactScene, law: Law = LAW
) -> CoarseSolve:
    """Solve S contacts on the coarsest grid and choose for each; arguments as for `solve_many`."""
    require(0 < error <= 1, "error", error, "must lie in (0, 1]")
    for name, values in (("force_n", force_n), ("modulus_mpa", modulus_mpa)):
        require(bool(np.all(values > 0)), name, values, "must be > 0")
    gel, body = _spectra(stage, LOOK.padded, stage.window_mm / LOOK.grid)
    sizes = (stage.window_mm, stage.gel.thickness_mm)
    parts = []
    for rows, live in chunks(np.arange(len(force_n))):
        given = (tuple(gaps(n, rows) for n in LOOK_GRIDS), force_n[rows], modulus_mpa[rows])
        parts.append(_look(live, given, gel, body, sizes, error, law))
    return gather(parts, len(force_n))


def gap_on(gap: Gap, grid: int) -> Float[Array, "N N"]:
    """The gap on a grid of that side: called for, or the mean over blocks of a finer one.

    Raises:
      ValueError: an array that is not square, or whose side is no multiple of the grid's.
    """
    if callable(gap):
        return gap(grid)
    fits = gap.ndim == 2 and gap.shape[0] == gap.shape[1] and gap.shape[0] % grid == 0
    require(fits, "gap", gap.shape, f"must be square with a side that is a multiple of {grid}, or a function of it")
    return nested.coarsen(gap, gap.shape[0] // grid)


def _alone(gap: Gap, gel: Layer, body: Layer | None, window_mm: float) -> tuple[ContactScene, Gaps, np.ndarray]:
    """One scene as many."""
    soft = None if body is None else dataclasses.replace(body, modulus_mpa=1.0)
    modulus = np.array([1.0 if body is None else body.modulus_mpa])
    return ContactScene(gel=gel, body=soft, window_mm=window_mm), lambda n, rows: gap_on(gap, n)[None], modulus


def _choices(seen: CoarseSolve) -> tuple[ContactSettings, ...]:
    fields = zip(seen.index.tolist(), seen.promised.tolist(), seen.met.tolist(), strict=True)
    return tuple(
        ContactSettings(**dataclasses.asdict(MENU[i]), tier=contact.Tier.SPG, promised_error=e, met=m)
        for i, e, m in fields
    )


def _go_on(
    seen: CoarseSolve,
    gaps: Gaps,
    rows: np.ndarray,
    force_n: np.ndarray,
    modulus_mpa: np.ndarray,
    stage: ContactScene,
    program: tuple[int, int],
) -> contact.Contact:
    """Contacts of some scenes on one grid, from where the look left them."""
    grid, padded = program
    spacing = stage.window_mm / grid
    gel, body = _spectra(stage, padded, spacing)
    tolerance = np.array([s.tolerance for s in MENU], np.float32)[seen.index]
    parts = []
    for chunk, live in chunks(rows):
        known = contact.Known(gap_mm=jnp.asarray(gaps(LOOK.grid, chunk)), pressure_mpa=seen.contact.pressure_mpa[chunk])
        given = (known, gaps(grid, chunk), force_n[chunk], modulus_mpa[chunk], tolerance[chunk])
        parts.append(_resume(live, given, gel, body, spacing, stage.gel.thickness_mm))
    return gather(parts, len(rows))


@jax.jit
def _look(
    live: Array, given: tuple, gel: Array, body: Array, sizes: tuple[float, float], error: float, law: Law
) -> CoarseSolve:
    window, thickness = sizes

    def one(scene: tuple[Array, Array, Array]) -> contact.Contact:
        gap, force, modulus = scene
        spacing = window / LOOK.grid
        return contact.solve(gap, force, gel, body / modulus, spacing, LOOK.tolerance, thickness_mm=thickness)

    def summary(found: contact.Contact, gaps: tuple[Array, Array, Array], modulus: Array) -> CoarseSolve:
        share = gel_share(gel, body / modulus)
        surveyed = survey(found.pressure_mpa, found.displacement_mm, gaps, share, window, thickness)
        index, promised, met = pick(error, log_error(surveyed, law, MENU), law)
        return CoarseSolve(contact=found, survey=surveyed, index=index, promised=promised, met=met)

    gaps, force, modulus = given
    found = map_live(one, live, (gaps[0], force, modulus))
    return jax.vmap(summary)(found, gaps, modulus)  # all at once: many small steps, none of which stops early


@jax.jit
def _resume(
    live: Array, given: tuple, gel: Array, body: Array, spacing_mm: float, thickness_mm: float
) -> contact.Contact:
    def one(scene: tuple[contact.Known, Array, Array, Array, Array]) -> contact.Contact:
        known, gap, force, modulus, tolerance = scene
        return contact.resume(known, gap, force, gel, body / modulus, spacing_mm, tolerance, thickness_mm=thickness_mm)

    return map_live(one, live, given)


def _spectra(stage: ContactScene, padded: int, spacing_mm: float) -> tuple[Array, Array]:
    """Compliance of the gel and of the object of 1 MPa."""
    gel = _compliance(stage.gel, padded, spacing_mm)
    return gel, jnp.zeros_like(gel) if stage.body is None else _compliance(stage.body, padded, spacing_mm)


@functools.lru_cache(maxsize=128)
def _compliance(body: Layer, padded: int, spacing_mm: float) -> Array:
    return jnp.asarray(layer.normal_compliance(np.hypot(*layer.wave_numbers(padded, spacing_mm)), body), jnp.float32)
