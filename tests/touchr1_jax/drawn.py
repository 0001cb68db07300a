"""Parameters drawn in NumPy from traced shapes: compiling an initialisation takes longer than all else in a test."""

import jax
import jax.numpy as jnp
import numpy as np

from touchr1_jax.types import Params


def draw_params(shapes: Params, seed: int = 0, *, loud: float = 0.4) -> Params:
    """Drawn from N(0, loud²), scales from N(1, loud²), so that attention is not uniform and no bias trivial.

    Args:
      shapes: a tree of `jax.ShapeDtypeStruct`, what `jax.eval_shape` makes of the initialisation.
    """
    rng = np.random.default_rng(seed)

    def draw(path: tuple, leaf: jax.ShapeDtypeStruct) -> jax.Array:
        centre = 1.0 if path[-1].key == "scale" else 0.0
        return jnp.asarray(rng.normal(centre, loud, leaf.shape), leaf.dtype)

    with jax.ensure_compile_time_eval():  # a caller that caches must not keep a tracer of whoever asks first
        return jax.tree_util.tree_map_with_path(draw, shapes)
