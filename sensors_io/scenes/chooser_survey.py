"""Features of a contact solved on a coarse grid that predict its error there and on finer grids.

Inside a contact the surfaces lie on each other, so whatever of the gap the grid does not resolve there is missing from
the displacement: that part of the error is read off finer gaps, without solving anything.  What the contact's edge and
the free surface lose is estimated from the roughness of the coarse solution on its own grid, and from the contact's
shape.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sensors_io.scenes import nested
from sensors_io.scenes.chooser_law import Survey

_LEAST = 1e-3
"""Least value of what a logarithm is taken of: below it a share of the slope changes no choice."""

_TINY = 1e-30

PLAIN = (
    "1",
    "ln d₂",
    "ln d₄",
    "ln c₂",
    "ln c₄",
    "ln bent",
    "ln a/h",
    "border",
    "ln edge/area",
    "ln depth/h",
    "ln gel's share",
    "extent",
)
PRODUCTS = (
    ("ln bent", "ln edge/area"),
    ("ln d₂", "ln d₄"),
    ("ln c₄", "ln a/h"),
    ("border", "ln edge/area"),
    ("ln d₄", "ln edge/area"),
    ("ln d₂", "ln edge/area"),
)
FEATURES = PLAIN + tuple(f"{a} · {b}" for a, b in PRODUCTS)
"""Names of φ.

Shares of the displacement's slope: d₂ and d₄ what the gap has inside the contact on twice finer grids and not on this
one, and from twice to four times finer ones; c₂ and c₄ what the displacement loses on grids two and four times coarser;
bent its second differences.  a is the radius of a circle of the contact's area, h the gel's thickness, border the share
of the window's border that touches, edge and area the contact's in pixels, depth the greatest displacement, the gel's
share that of the compliance to the finest wave, extent the contact's longer side over the window's.
"""


def survey(
    pressure_mpa: Float[Array, "N N"],
    displacement_mm: Float[Array, "N N"],
    gaps_mm: tuple[Float[Array, "N N"], Array, Array],
    gel_share: Float[Array, ""],
    window_mm: float,
    thickness_mm: float,
) -> Survey:
    """Features of a solved contact.

    Args:
      pressure_mpa, displacement_mm: of the contact, N a multiple of 4.
      gaps_mm: of the undeformed bodies on this grid and on grids twice and four times finer, [N, N] to [4N, 4N].
      gel_share: compliance of the gel over that of gel and object, to the finest wave of the grid.
      window_mm, thickness_mm: sides of the window, thickness of the gel.
    """
    u, touching, points = displacement_mm, pressure_mpa > 0, displacement_mm.shape[0]
    whole = jnp.maximum(_slope(u), _TINY)
    gap, finer, finest = gaps_mm
    halved, quartered = nested.refine(nested.coarsen(u, 2)), nested.refine(nested.refine(nested.coarsen(u, 4)))
    area = jnp.maximum(jnp.sum(touching), 1)
    edge = jnp.sum(touching[1:] != touching[:-1]) + jnp.sum(touching[:, 1:] != touching[:, :-1])
    radius = window_mm / points * jnp.sqrt(area / jnp.pi)
    values = (
        jnp.ones(()),
        _ln(gel_share * _slope(finer - nested.refine(gap), _spread(touching, 2)) / whole),
        _ln(gel_share * _slope(finest - nested.refine(finer), _spread(touching, 4)) / whole),
        _ln(_slope(u - halved) / whole),
        _ln(_slope(u - quartered) / whole),
        _ln(_bent(u) / whole),
        _ln(radius / thickness_mm),
        (area - jnp.sum(touching[1:-1, 1:-1])) / (4 * points),
        _ln(jnp.maximum(edge, 1) / area),
        _ln(jnp.max(u) / thickness_mm),
        _ln(gel_share),
        jnp.maximum(_extent(touching, 0), _extent(touching, 1)) / points,
    )
    plain = dict(zip(PLAIN, values, strict=True))
    return Survey(
        features=jnp.stack([*values, *(plain[a] * plain[b] for a, b in PRODUCTS)]),
        radius_mm=radius,
        slope_share=_ln(gel_share * _slope(gap, touching) / whole),
        window_mm=jnp.asarray(window_mm, jnp.float32),
        thickness_mm=jnp.asarray(thickness_mm, jnp.float32),
    )


def gel_share(gel: Float[Array, "M K"], body: Float[Array, "M K"]) -> Float[Array, ""]:
    """Compliance of the gel over that of both, to the finest wave of their grid."""
    return gel[0, -1] / (gel[0, -1] + body[0, -1])


def _ln(x: Array) -> Array:
    return jnp.log(jnp.maximum(x, _LEAST))


def _slope(field: Array, where: Bool[Array, "N N"] | None = None) -> Array:
    """Root of the sum of squared differences between neighbours, of pairs inside `where`: ∫ |∇f|² on any grid."""
    rows, columns = jnp.diff(field, axis=0), jnp.diff(field, axis=1)
    if where is not None:
        rows = jnp.where(where[1:] & where[:-1], rows, 0)
        columns = jnp.where(where[:, 1:] & where[:, :-1], columns, 0)
    return jnp.sqrt(jnp.sum(rows**2) + jnp.sum(columns**2))


def _bent(field: Array) -> Array:
    """Root of the sum of squared second differences along both axes."""
    return jnp.sqrt(jnp.sum(jnp.diff(field, 2, axis=0) ** 2) + jnp.sum(jnp.diff(field, 2, axis=1) ** 2))


def _spread(mask: Bool[Array, "N N"], factor: int) -> Bool[Array, "F F"]:
    return jnp.repeat(jnp.repeat(mask, factor, 0), factor, 1)


def _extent(mask: Bool[Array, "N N"], axis: int) -> Array:
    """Pixels from the first to the last one that touches, along the other axis."""
    hit, index = jnp.any(mask, axis), jnp.arange(mask.shape[0])
    return jnp.max(jnp.where(hit, index, 0)) - jnp.min(jnp.where(hit, index, mask.shape[0] - 1)) + 1
