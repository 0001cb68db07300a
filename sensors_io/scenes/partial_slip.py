"""Tangential traction from two normal contacts: the cheap tier, and when it is enough.

Where the tangential compliance is the normal one times a constant, a body that has been pressed by F and then pushed by
Q < μF carries τ = μ [p(F) − p(F − Q/μ)]: the contact of the smaller load is the part that sticks.  A bonded layer
breaks the proportion, more so the thinner it is against the contact, which bounds the error in advance.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from sensors_io.layer import Layer, longitudinal_compliance, normal_compliance, shear_compliance
from sensors_io.scenes.traction import Compliance, shear_displacement

WIDE_WAVE, NARROW_WAVE = 1.5, 10.0
"""Wave numbers, times the contact radius, between which the ratio of the compliances is compared."""

_ERROR_PER_CONTRAST = 0.12
_TRANSVERSE_SHARE = 0.3
_LEAST_CONTRAST = 0.01
_COMPLIANCES = (longitudinal_compliance, shear_compliance, normal_compliance)


def ciavarella_jaeger(
    pressure_mpa: Float[Array, "N N"],
    stuck_mpa: Float[Array, "N N"],
    friction: Array | float,
    direction: Complex[Array, ""],
) -> Complex[Array, "N N"]:
    """τ = μ [p(F) − p(F − Q/μ)] along one direction.

    Where the smaller contact was interpolated it may exceed the larger one; |τ| ≤ μp is kept by clipping at 0.

    Args:
      pressure_mpa: p(F) [N, N].
      stuck_mpa: p(F − Q/μ) [N, N]; zeros for full slip.
      friction: μ.
      direction: of Q, x + iy of length 1.

    Source: Ciavarella 1998 and Jäger 1998, for similar materials; for a layer an approximation, see `promised_error`.
    """
    return friction * jnp.maximum(pressure_mpa - stuck_mpa, 0) * direction


def in_ramp(
    ramp_mpa: Float[Array, "K N N"], forces_n: Float[Array, "K"], force_n: Float[Array, ""]
) -> Float[Array, "N N"]:
    """Pressure at a force between those of a press ramp, linear in the force, so that it carries the force exactly.

    Below the first force its pattern is scaled down; above the last one the last is scaled up.
    """
    forces = jnp.concatenate([jnp.zeros(1), forces_n])
    upper = jnp.clip(jnp.searchsorted(forces, force_n), 1, len(forces_n))
    low, high = forces[upper - 1], forces[upper]
    share = jnp.clip((force_n - low) / (high - low), 0, 1)
    below = jnp.where(upper > 1, 1 - share, 0) * ramp_mpa[jnp.maximum(upper - 2, 0)]
    return (below + share * ramp_mpa[upper - 1]) * jnp.maximum(force_n / forces_n[-1], 1)


def core_slide(
    ramp_mpa: Float[Array, "K N N"], compliance: Compliance, direction: Complex[Array, ""]
) -> Float[Array, "K"]:
    """Displacement along `direction` by a traction p(F_k), where the contact begins, mm: full slip by μ = 1.

    One convolution per force of the ramp.
    """
    core = ramp_mpa[0] / jnp.maximum(jnp.sum(ramp_mpa[0]), 1e-30)  # no contact, no slide

    def at_core(p: Array) -> Array:
        moved = shear_displacement(p * direction, compliance)
        return jnp.sum(core * (moved * jnp.conj(direction)).real)

    return jax.lax.map(at_core, ramp_mpa)


def stuck_force(
    forces_n: Float[Array, "K"],
    slides_mm: Float[Array, "K"],
    force_n: Float[Array, ""],
    friction: Array | float,
    slide_mm: Float[Array, ""],
) -> Float[Array, ""]:
    """F − Q/μ of a body that was pressed by F and then moved by a prescribed slide: 0 from full slip on.

    The core, which sticks, moves by μ [u(F) − u(F − Q/μ)] with u of `core_slide`.

    Args:
      forces_n: of the ramp, ascending.
      slides_mm: `core_slide` of the ramp.
      force_n: F.
      friction: μ.
      slide_mm: displacement along the direction, ≥ 0.

    On gels of 4 mm the force is off by 5 % (median; 13 % in one contact of twenty), more than at a prescribed force.
    """
    forces = jnp.concatenate([jnp.zeros(1), forces_n])
    slides = jnp.concatenate([jnp.zeros(1), slides_mm])
    left = jnp.interp(force_n, forces, slides) - slide_mm / friction
    return jnp.where(left > 0, jnp.interp(left, slides, forces), 0.0)


def promised_error(gel: Layer, body: Layer | None, contact_radius_mm: float) -> float:
    """Error of the marker displacement that `ciavarella_jaeger` keeps to in 19 of 20 contacts, relative.

        0.12 (|ln r(1.5/a) − ln r(10/a)| + 0.3 |G_l − G_t| / (G_l + G_t) + 0.01),   r = (G_l + G_t) / 2G

    with G normal, G_l longitudinal and G_t transverse compliance of both bodies in series, a the contact radius.  The
    constants are fitted to 432 contacts (six shapes, gels of 1.5, 4 and 12 mm, ν 0.3 and 0.48, two bodies, two forces,
    Q/μF from 0.3 to 0.9) against `tangential.solve_force`.  No promise covers twists, reversals, or the friction that
    lateral expansion under pressure meets: those need `tangential`.

    Args:
      gel: the gel.
      body: the object in series at its own modulus, `None` for a rigid one.
      contact_radius_mm: radius of a circle of the contact's area.
    """
    q = np.array([WIDE_WAVE, NARROW_WAVE]) / contact_radius_mm
    along, across, normal = (f(q, gel) for f in _COMPLIANCES)
    if body is not None:
        along, across, normal = (g + f(q, body) for g, f in zip((along, across, normal), _COMPLIANCES, strict=True))
    wide, narrow = np.log((along + across) / (2 * normal))
    anisotropy = abs(along[1] - across[1]) / (along[1] + across[1])
    return float(_ERROR_PER_CONTRAST * (abs(wide - narrow) + _TRANSVERSE_SHARE * anisotropy + _LEAST_CONTRAST))
