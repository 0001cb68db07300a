"""One sequence of tangential contact, frame by frame: what sticks carries its displacement on, what slips forgets it.

Between two frames the object's surface moves by Δs and its pressure changes.  Where the surfaces stick, the relative
displacement that elasticity carries, c = C ∗ τ + lateral displacement by p, grows by Δs; elsewhere friction is at its
limit.  So each frame is one solve with the target c_before + Δs − lateral(p), which makes loading paths, reversals and
their hysteresis come out right to the order of the steps (Mindlin & Deresiewicz 1953; Kalker 1990, ch. 1).
"""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Complex, Float, Int

from sensors_io.scenes import tangential
from sensors_io.scenes.traction import (
    Compliance,
    Response,
    displacement,
    lateral_displacement,
    resultant,
    rigid_field,
)


@struct.dataclass
class History:
    """State that one frame passes to the next: its traction, MPa, and the carried relative displacement c, mm."""

    traction_mpa: Complex[Array, "N N"]
    carried_mm: Complex[Array, "N N"]


@struct.dataclass
class RigidMotion:
    """Rigid motion of the object since the frame before: slide, and twist about `centre_mm`, which moves along."""

    slide_mm: Float[Array, "2"]
    twist_rad: Float[Array, ""]
    centre_mm: Float[Array, "2"]


@struct.dataclass
class Bodies:
    """Spectra of one contact: tangential compliance in series, lateral displacement by pressure (the gel's less the
    body's) or `None` to leave it out, and the gel's response at the depth that is observed.
    """

    compliance: Compliance
    coupling: Complex[Array, "M M"] | None
    response: Response


@struct.dataclass
class Frame:
    """One frame solved: displacement of the observed depth (x, y, into the gel), force and moment on the gel.

    `moment_nmm` is about the window's centre; `stick_share`, `residual`, `iterations`, `converged` are those of
    `tangential.Traction`.
    """

    traction_mpa: Complex[Array, "N N"]
    displacement_mm: Float[Array, "3 N N"]
    force_n: Float[Array, "3"]
    moment_nmm: Float[Array, "3"]
    stick_share: Float[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


def at_rest(points: int) -> History:
    """Before the first touch, on a grid of `points`² pixels."""
    still = jnp.zeros((points, points), jnp.complex64)
    return History(traction_mpa=still, carried_mm=still)


def advance(
    history: History,
    pressure_mpa: Float[Array, "N N"],
    friction: Array | float,
    step: RigidMotion,
    bodies: Bodies,
    x_mm: Float[Array, "N"],
    tolerance: Array | float = tangential.TOLERANCE,
    max_iterations: int = tangential.MAX_ITERATIONS,
) -> tuple[History, Frame]:
    """Go on by one frame: scan it over the frames of a sequence.

    Args:
      history: of the frame before, `at_rest` before the first.
      pressure_mpa: normal pressure of this frame at the object's present pose [N, N]; zeros where nothing touches.
      friction: μ.
      step: motion of the object since the frame before.
      bodies: spectra.
      x_mm: pixel centres along both axes.
      tolerance: of `tangential.solve`.
      max_iterations: its cap.

    Returns:
      The history for the next frame and the solved frame.
    """
    lateral = jnp.zeros_like(history.carried_mm)
    if bodies.coupling is not None:
        lateral = lateral_displacement(pressure_mpa, bodies.coupling)
    moved = rigid_field(x_mm, step.slide_mm, step.twist_rad, step.centre_mm)
    target = history.carried_mm + moved - lateral
    solved = tangential.solve(
        friction * pressure_mpa, target, bodies.compliance, history.traction_mpa, tolerance, max_iterations
    )
    along, depth = displacement(pressure_mpa, solved.traction_mpa, bodies.response)
    force, moment = resultant(pressure_mpa, solved.traction_mpa, x_mm, x_mm[1] - x_mm[0])
    frame = Frame(
        traction_mpa=solved.traction_mpa,
        displacement_mm=jnp.stack([along.real, along.imag, depth]),
        force_n=force,
        moment_nmm=moment,
        stick_share=solved.stick_share,
        residual=solved.residual,
        iterations=solved.iterations,
        converged=solved.converged,
    )
    return History(traction_mpa=solved.traction_mpa, carried_mm=solved.displacement_mm + lateral), frame
