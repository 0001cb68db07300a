"""Methods for the traction of a contact with friction: those of the package, and those that they are compared with.

A solver maps one contact, the spectra of its gel and a number (tolerance or iterations) to the traction [N, N], MPa,
x + iy; one of sequences maps a motion likewise to tractions [F, N, N] and to the displacement that the markers show.
"""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.mechanics.tangential_scenes import FrictionContact, FrictionKernels, FrictionSequence
from sensors_io.scenes import contact, drag, partial_slip, tangential
from sensors_io.scenes.traction import Compliance, displacement, in_series, rigid_field, shear_displacement

Solver = Callable[[FrictionContact, FrictionKernels, Array], Array]
SequenceSolver = Callable[[FrictionSequence, FrictionKernels, Array], tuple[Array, Any]]
FrameSolver = Callable[[Array, Array, Compliance, Array], tuple[Array, Any]]
"""μp, target, compliance and the previous traction → the traction, and anything else to return."""

Kept = TypeVar("Kept")

SOLVER, PLAIN, SUPERPOSED = "SPG to tolerance", "plain SPG", "superposition"
"""Kinds of methods."""

FROM_PRESS = f"{SUPERPOSED} from the press"
MAIN = f"{SOLVER} {tangential.TOLERANCE:g}"
SEQUENCE = "sequence"

MOST_ITERATIONS = 400
EXACT_TOLERANCE, EXACT_ITERATIONS = 1e-8, 4000
_TINY = 1e-30
_SHORTEST = 1e-12  # MPa; below it a traction has no direction


class FrictionMethod(NamedTuple):
    """A solver at one setting; `kind` groups the chart, `label` is its mark there."""

    kind: str
    solve: Callable[[Any, FrictionKernels, Array], Any]
    setting: float | int = 0.0
    label: str = ""


@functools.partial(jax.jit, static_argnames="solve")
def every(
    solve: Callable[[FrictionContact, FrictionKernels, Array], Kept],
    cases: FrictionContact,
    kernels: FrictionKernels,
    setting: Array,
) -> Kept:
    """Solutions of S contacts, one after the other, so that each stops on its own."""
    found: Kept = jax.lax.map(lambda case: solve(case, kernels, setting), cases)
    return found


@functools.partial(jax.jit, static_argnames="solve")
def sequence(
    solve: SequenceSolver, motion: FrictionSequence, kernels: FrictionKernels, setting: Array
) -> tuple[Array, Any]:
    """Tractions [F, N, N] of a sequence, and the displacement of its markers."""
    return solve(motion, kernels, setting)


def tractions(method: FrictionMethod, given: FrictionContact | FrictionSequence, kernels: FrictionKernels) -> Array:
    """Tractions of all contacts, or of all frames of a sequence, [S, N, N]."""
    setting = jnp.asarray(method.setting)
    if isinstance(given, FrictionSequence):
        return sequence(method.solve, given, kernels, setting)[0]
    return every(method.solve, given, kernels, setting)


def exact(task: str, given: FrictionContact | FrictionSequence, kernels: FrictionKernels) -> np.ndarray:
    """Tractions [S, N, N] in float64, which a duality gap below 1e-8 proves.

    Raises:
      RuntimeError: a gap that stays wider.
    """
    with jax.enable_x64(True):
        wide = _double(given), _double(kernels), jnp.asarray(EXACT_TOLERANCE)
        if task == SEQUENCE:
            found, (_, gap) = sequence(_exact_frames, *wide)
        else:
            solved = every(_SOLVED[task], *wide)
            found, gap = solved.traction_mpa, solved.residual
        worst = float(jnp.max(gap))
        if not worst < EXACT_TOLERANCE:
            raise RuntimeError(
                f"duality gap of the float64 reference is {worst:.1e}: must be < {EXACT_TOLERANCE:.0e}; "
                "raise EXACT_ITERATIONS"
            )
        return np.asarray(found)


@jax.jit
def marker_motion(tractions: Array, kernels: FrictionKernels) -> Array:
    """Displacement along the gel at the depth of its markers by tractions [S, N, N], mm."""
    return jax.lax.map(lambda each: shear_displacement(each, kernels.markers.shear), tractions)


# One contact ---------------------------------------------------------------------------------------------------------


def solve_task(task: str, case: FrictionContact, kernels: FrictionKernels, tolerance: Array) -> tangential.Traction:
    """A prescribed force, slide or twist by the package's solver."""
    cap = jnp.where(tolerance <= EXACT_TOLERANCE, EXACT_ITERATIONS, MOST_ITERATIONS)
    compliance = _series(case, kernels)
    if task == "force":
        pull = case.pull_share * case.direction * jnp.sum(case.limit_mpa) * kernels.spacing_mm**2
        force, still = jnp.stack([pull.real, pull.imag]), jnp.zeros_like(case.limit_mpa * case.direction)
        return tangential.solve_force(case.limit_mpa, force, still, compliance, kernels.spacing_mm, tolerance, cap)
    return tangential.solve(case.limit_mpa, _target(task, case, kernels), compliance, None, tolerance, cap)


_SOLVED = {task: functools.partial(solve_task, task) for task in ("force", "slide", "twist")}


def spg(task: str) -> Solver:
    """The package's solver."""
    return lambda case, kernels, tolerance: solve_task(task, case, kernels, tolerance).traction_mpa


def plain(task: str) -> Solver:
    """The plain solver of a slide or a twist."""
    return lambda case, kernels, iterations: plain_spg(
        case.limit_mpa, _target(task, case, kernels), _series(case, kernels), iterations
    )


def superposed_pull(case: FrictionContact, kernels: FrictionKernels, tolerance: Array) -> Array:
    """Ciavarella and Jäger's superposition, the smaller contact solved to a tolerance."""
    force = case.ramp_n[-1] * (1 - case.pull_share)
    body = kernels.normal_body / case.modulus_mpa
    stuck = contact.solve(case.gap_mm, force, kernels.normal_gel, body, kernels.spacing_mm, tolerance).pressure_mpa
    return partial_slip.ciavarella_jaeger(case.ramp_mpa[-1], stuck, case.friction, case.direction)


def ramp_pull(case: FrictionContact, kernels: FrictionKernels, _: Array) -> Array:
    """The same, the smaller contact read from the press that went before."""
    stuck = partial_slip.in_ramp(case.ramp_mpa, case.ramp_n, case.ramp_n[-1] * (1 - case.pull_share))
    return partial_slip.ciavarella_jaeger(case.ramp_mpa[-1], stuck, case.friction, case.direction)


def ramp_slide(case: FrictionContact, kernels: FrictionKernels, _: Array) -> Array:
    """The same for a prescribed slide, whose force follows from the press."""
    slides = partial_slip.core_slide(case.ramp_mpa, _series(case, kernels), case.direction)
    left = partial_slip.stuck_force(case.ramp_n, slides, case.ramp_n[-1], case.friction, case.slide_mm)
    stuck = partial_slip.in_ramp(case.ramp_mpa, case.ramp_n, left)
    return partial_slip.ciavarella_jaeger(case.ramp_mpa[-1], stuck, case.friction, case.direction)


def scaled_pull(case: FrictionContact, kernels: FrictionKernels, _: Array) -> Array:
    """Traction in proportion to the pressure."""
    return case.pull_share * case.limit_mpa * case.direction


def full_slip(case: FrictionContact, kernels: FrictionKernels, _: Array) -> Array:
    """A slide that slips everywhere: μp."""
    return case.limit_mpa * case.direction


def full_twist(case: FrictionContact, kernels: FrictionKernels, _: Array) -> Array:
    """A twist that slips everywhere."""
    target = _target("twist", case, kernels)
    return case.limit_mpa * target / jnp.maximum(jnp.abs(target), _TINY)


def plain_spg(limit: Array, target: Array, compliance: Compliance, iterations: Array) -> Array:
    """Spectral projected gradients by real components, from 0, a fixed number of iterations, without safeguards."""
    tensor, points = _tensor(compliance), compliance.even.shape[-1]
    first_step = 1 / tensor[0, 0, 0, tensor.shape[-1] // 8]
    goal = jnp.stack([target.real, target.imag])
    inside = limit > 0

    def nearest(t: Array) -> Array:
        return t * jnp.minimum(1, limit / jnp.maximum(jnp.hypot(t[0], t[1]), _SHORTEST))

    def slope(t: Array) -> Array:
        spectrum = jnp.fft.rfft2(t, s=(points, points))
        moved = jnp.fft.irfft2(tensor[0] * spectrum[0] + tensor[1] * spectrum[1], s=(points, points))
        return moved[:, : t.shape[1], : t.shape[2]] - goal

    def iterate(i: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        t, g, new = state
        after = slope(new)
        s, y = new - t, jnp.where(inside, after - g, 0)
        curvature = jnp.sum(s * y)
        long = jnp.sum(s * s) / jnp.maximum(curvature, _TINY)
        short = curvature / jnp.maximum(jnp.sum(y * y), _TINY)
        step = jnp.where(curvature > 0, jnp.where(i % 2 == 0, long, short), first_step)
        return new, after, nearest(new - step * after)

    still = jnp.zeros_like(goal)
    start = slope(still)
    x, y = jax.lax.fori_loop(0, iterations, iterate, (still, start, nearest(-first_step * start)))[2]
    return jax.lax.complex(x, y)


# Sequences -----------------------------------------------------------------------------------------------------------


def dragged(
    motion: FrictionSequence,
    kernels: FrictionKernels,
    keep: Callable[[drag.Frame], Kept],
    coupling: Array | None = None,
    tolerance: Array | float = tangential.TOLERANCE,
    max_iterations: int = tangential.MAX_ITERATIONS,
) -> Kept:
    """A sequence as the generator makes it, coupled or not; `keep` picks what is kept of every frame."""
    bodies = drag.Bodies(compliance=_series(motion, kernels), coupling=coupling, response=kernels.markers)

    def advance(history: drag.History, frame: tuple[Array, drag.RigidMotion]) -> tuple[drag.History, Kept]:
        pressure, step = frame
        history, solved = drag.advance(
            history, pressure, motion.friction, step, bodies, kernels.x_mm, tolerance, max_iterations
        )
        return history, keep(solved)

    start = drag.at_rest(kernels.x_mm.shape[0])
    found: Kept = jax.lax.scan(advance, start, (motion.pressure_mpa, motion.step))[1]
    return found


def spg_frames(motion: FrictionSequence, kernels: FrictionKernels, tolerance: Array) -> tuple[Array, Any]:
    """A sequence by the package's solver."""
    keep = lambda frame: (frame.traction_mpa, frame.displacement_mm)
    return dragged(motion, kernels, keep, None, tolerance, MOST_ITERATIONS)


def plain_frames(motion: FrictionSequence, kernels: FrictionKernels, iterations: Array) -> tuple[Array, Any]:
    """A sequence by the plain solver, which starts every frame from zero."""
    return _frames(motion, kernels, lambda limit, target, c, _: (plain_spg(limit, target, c, iterations), None))


def full_slip_frames(motion: FrictionSequence, kernels: FrictionKernels, _: Array) -> tuple[Array, Any]:
    """A sequence that slips everywhere against the motion of each frame."""

    def one(frame: tuple[Array, drag.RigidMotion]) -> tuple[Array, Any]:
        pressure, step = frame
        moved = rigid_field(kernels.x_mm, step.slide_mm, step.twist_rad, step.centre_mm)
        found = motion.friction * pressure * moved / jnp.maximum(jnp.abs(moved), _TINY)
        return found, displacement(pressure, found, kernels.markers)

    tractions: tuple[Array, Any] = jax.lax.map(one, (motion.pressure_mpa, motion.step))
    return tractions


def _exact_frames(motion: FrictionSequence, kernels: FrictionKernels, tolerance: Array) -> tuple[Array, Any]:
    def solve(limit: Array, target: Array, compliance: Compliance, before: Array) -> tuple[Array, Array]:
        solved = tangential.solve(limit, target, compliance, before, tolerance, EXACT_ITERATIONS)
        return solved.traction_mpa, solved.residual

    return _frames(motion, kernels, solve)


def _frames(motion: FrictionSequence, kernels: FrictionKernels, solve: FrameSolver) -> tuple[Array, Any]:
    """Regions that stick keep their displacement: the target of a frame is that of the last frame plus the motion."""
    compliance = _series(motion, kernels)

    def advance(state: tuple[Array, Array], frame: tuple[Array, drag.RigidMotion]) -> tuple[tuple[Array, Array], Any]:
        (before, carried), (pressure, step) = state, frame
        target = carried + rigid_field(kernels.x_mm, step.slide_mm, step.twist_rad, step.centre_mm)
        found, more = solve(motion.friction * pressure, target, compliance, before)
        seen = displacement(pressure, found, kernels.markers)
        return (found, shear_displacement(found, compliance)), (found, (seen, more))

    rest = jax.lax.complex(*[jnp.zeros_like(motion.pressure_mpa[0])] * 2)
    found: tuple[Array, Any] = jax.lax.scan(advance, (rest, rest), (motion.pressure_mpa, motion.step))[1]
    return found


def _to_tolerance(solve: Callable[..., Any]) -> list[FrictionMethod]:
    tolerances = (2e-2, 5e-3, tangential.TOLERANCE, 1e-3, 3e-4)
    return [FrictionMethod(SOLVER, solve, t, f"{t:g}") for t in tolerances]


def _with_iterations(solve: Callable[..., Any]) -> list[FrictionMethod]:
    return [FrictionMethod(PLAIN, solve, count, f"{count}") for count in (5, 10, 20, 40, 80)]


def _named(*methods: FrictionMethod) -> dict[str, FrictionMethod]:
    return {f"{method.kind} {method.label}".strip(): method for method in methods}


METHODS: Mapping[str, Mapping[str, FrictionMethod]] = {
    "force": _named(
        FrictionMethod("scaled pressure", scaled_pull),
        FrictionMethod(FROM_PRESS, ramp_pull),
        FrictionMethod(SUPERPOSED, superposed_pull, 1e-3),  # the generator's tolerance
        *_to_tolerance(spg("force")),
    ),
    "slide": _named(
        FrictionMethod("full slip", full_slip),
        FrictionMethod(FROM_PRESS, ramp_slide),
        *_to_tolerance(spg("slide")),
        *_with_iterations(plain("slide")),
    ),
    "twist": _named(
        FrictionMethod("full slip", full_twist), *_to_tolerance(spg("twist")), *_with_iterations(plain("twist"))
    ),
    SEQUENCE: _named(
        FrictionMethod("full slip", full_slip_frames), *_to_tolerance(spg_frames), *_with_iterations(plain_frames)
    ),
}
"""Task → name → method, cheapest first within each kind."""


def _series(of: FrictionContact | FrictionSequence, kernels: FrictionKernels) -> Compliance:
    return in_series(kernels.gel, kernels.body, 1.0, of.modulus_mpa)


def _target(task: str, case: FrictionContact, kernels: FrictionKernels) -> Array:
    """Prescribed displacement of the object's surface by a slide or a twist, [N, N] mm."""
    if task == "slide":
        return jnp.broadcast_to(case.slide_mm * case.direction, case.gap_mm.shape)
    still = jnp.zeros_like(kernels.x_mm, shape=(2,))
    return rigid_field(kernels.x_mm, still, case.twist_rad, still)


def _tensor(compliance: Compliance) -> Array:
    """The compliance of real components on a half plane, [2, 2, M, K]."""
    half = compliance.even.shape[-1] // 2 + 1
    even, odd = compliance.even[:, :half], compliance.odd[:, :half]
    return jnp.stack([jnp.stack([even + odd.real, odd.imag]), jnp.stack([odd.imag, even - odd.real])])


def _double(tree: Any) -> Any:
    """The same numbers in double precision."""
    wide = {np.dtype(np.float32): np.float64, np.dtype(np.complex64): np.complex128}
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), wide[np.asarray(leaf).dtype]), tree)
