"""Tractions that Coulomb friction admits, |τ| ≤ μp per pixel, and the nearest of them that carries a given force."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

_TINY = 1e-30
_SHIFT_STEPS = 60
_LEAP = 200.0  # longest Newton step, in lengths of the safe one
_FORCE_ERROR = 1e-6  # of the prescribed force, relative to the friction limit


def onto_discs(traction: Complex[Array, "N N"], limit: Float[Array, "N N"]) -> Complex[Array, "N N"]:
    """P(τ) = τ min(1, μp/|τ|): the nearest admissible traction, of plane vectors x + iy and μp ≥ 0."""
    return traction * jnp.minimum(1, limit / jnp.maximum(jnp.abs(traction), _TINY))


def shift_to_total(
    traction: Complex[Array, "N N"], limit: Float[Array, "N N"], total: Complex[Array, ""], guess: Complex[Array, ""]
) -> Complex[Array, ""]:
    """Uniform shift λ with Σ P(τ + λ) = total; P(τ + λ) is then the nearest admissible traction that carries it.

    λ minimises a sum of Huber functions of τ + λ, less λ·total.  Newton's method goes on where it halves what is
    missing; elsewhere a step of reweighted least squares does, which never overshoots and converges from anywhere.

    Args:
      traction: τ, any [N, N].
      limit: μp ≥ 0 [N, N].
      total: Σ τ to be carried, |total| ≤ Σ μp.
      guess: first λ.
    """

    def missing(shift: Array) -> Array:
        return total - jnp.sum(onto_discs(traction + shift, limit))

    def refine(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        shift, missed, count = state
        newton, safe = (shift + step for step in _shift_steps(traction + shift, limit, missed))
        left = missing(newton)
        # where all slips one way there is no derivative to come back by: leap there only by a step that is sure
        sure = jnp.abs(newton - shift) < _LEAP / 2 * jnp.abs(safe - shift)
        returns = sure | jnp.any(jnp.abs(traction + newton) < limit)
        better = returns & (jnp.abs(left) < jnp.abs(missed) / 2)
        shift, missed = jax.lax.cond(better, lambda: (newton, left), lambda: (safe, missing(safe)))
        return shift, missed, count + 1

    def off(state: tuple[Array, Array, Array]) -> Array:
        return (jnp.abs(state[1]) > _FORCE_ERROR * jnp.sum(limit)) & (state[2] < _SHIFT_STEPS)

    return jax.lax.while_loop(off, refine, (guess, missing(guess), jnp.zeros((), jnp.int32)))[0]


def dot(a: Array, b: Array) -> Array:
    """Scalar product of plane vectors, per pixel."""
    return a.real * b.real + a.imag * b.imag


def _shift_steps(traction: Array, limit: Array, missed: Array) -> tuple[Array, Array]:
    """(Σ DP)⁻¹ missed, DP = 1 where it sticks, ρ(1 − ûûᵀ) where it slips, ρ = μp/|τ|; and (Σ min(1, ρ))⁻¹ missed."""
    length = jnp.maximum(jnp.abs(traction), _TINY)
    share = jnp.where(limit > 0, jnp.minimum(1, limit / length), 0)
    slips = jnp.where(length > limit, share, 0)
    even = jnp.sum(share - slips / 2)
    odd = -jnp.sum(slips * (traction / length) ** 2) / 2  # ûûᵀd = (d + û² d̄)/2
    newton = (even * missed - odd * jnp.conj(missed)) / jnp.maximum(even**2 - jnp.abs(odd) ** 2, _TINY)
    safe = missed / jnp.maximum(jnp.sum(share), _TINY)
    return newton * jnp.minimum(1, _LEAP * jnp.abs(safe) / jnp.maximum(jnp.abs(newton), _TINY)), safe
