"""Updates that are left out because their gradient, or the policy after them, is not finite, and their number."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Int


class Skipping(NamedTuple):
    """State of `skip_nonfinite`: that of the wrapped optimizer, updates left out so far, and in a row until now."""

    inner: optax.OptState
    skipped: Int[Array, ""]
    in_a_row: Int[Array, ""]


def skip_nonfinite(optimizer: optax.GradientTransformation) -> optax.GradientTransformation:
    """The optimizer, which keeps its state and moves nothing where the gradient's norm is NaN or infinite.

    As `optax.apply_if_finite`, but by selection instead of a branch: a branch keeps old and new moments at once, a
    selection is written over the old ones.  It never gives in; whoever runs the steps stops, see `count_skipped`.

    Args:
      optimizer: any whose state consists of arrays.
    """

    def init(params: Any) -> Skipping:
        return Skipping(optimizer.init(params), jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))

    def update(grads: Any, state: Skipping, params: Any = None) -> tuple[Any, Skipping]:
        finite = jnp.isfinite(optax.tree.norm(grads))
        updates, inner = optimizer.update(grads, state.inner, params)
        pick = lambda new, old: jnp.where(finite, new, old)
        return jax.tree.map(lambda u: pick(u, jnp.zeros_like(u)), updates), Skipping(
            inner=jax.tree.map(pick, inner, state.inner),
            skipped=state.skipped + ~finite,
            in_a_row=jnp.where(finite, 0, state.in_a_row + 1),
        )

    return optax.GradientTransformation(init, update)


def count_lost(before: Any, after: Any, lost: Bool[Array, ""]) -> Any:
    """The state `after` an update that was not taken where `lost`: every `skip_nonfinite` in it counts the update.

    Any other update ends the row, also one that none of them received, as the first of those that
    `optax.MultiSteps` gathers.
    """
    counts = lambda node: isinstance(node, Skipping)

    def counted(old: Any, new: Any) -> Any:
        if not counts(new):
            return new
        skipped = jnp.where(lost, old.skipped + 1, new.skipped)
        in_a_row = jnp.where(lost, old.in_a_row + 1, jnp.where(skipped == old.skipped, 0, new.in_a_row))
        return new._replace(skipped=skipped, in_a_row=in_a_row)

    return jax.tree.map(counted, before, after, is_leaf=counts)


def count_skipped(state: Any) -> Int[Array, "2"] | None:
    """Updates that were left out so far and in a row until now, or `None` where no optimizer of a state counts them.

    Where several count, the most that one of them did: an update that all of them left out is one.

    Args:
      state: any pytree; an array of its own comes back, for a step may take the state's buffers over.
    """
    nodes = jax.tree.leaves(state, is_leaf=lambda node: isinstance(node, Skipping))
    counts = [jnp.stack([node.skipped, node.in_a_row]) for node in nodes if isinstance(node, Skipping)]
    return functools.reduce(jnp.maximum, counts) if counts else None
