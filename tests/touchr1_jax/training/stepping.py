"""A small problem with all that a checkpoint must carry: parameters, Adam's moments, a key, an iterator."""

import functools

import grain
import jax
import jax.numpy as jnp
import numpy as np
import optax

from touchr1_jax.rl.grpo import GRPOState
from touchr1_jax.skipping import skip_nonfinite

OPTIMIZER = optax.adam(0.1)
GUARDED = skip_nonfinite(OPTIMIZER)


def feed(seed: int = 0):
    """Shuffled batches of four numbers, for ever; each made when it is asked for, not 500 ahead."""
    numbers = grain.MapDataset.range(10).seed(seed).shuffle().repeat().batch(4)
    asked = grain.ReadOptions(num_threads=0, prefetch_buffer_size=0)
    return iter(numbers.map(lambda x: np.asarray(x, np.float32)).to_iter_dataset(asked))


def start(width: int = 3, optimizer: optax.GradientTransformation = OPTIMIZER) -> GRPOState:
    """Fresh state."""
    params = {"w": jnp.arange(width, dtype=jnp.float32), "b": jnp.zeros(())}
    return GRPOState(params=params, opt_state=optimizer.init(params), step=jnp.int32(0), key=jax.random.key(7))


def guarded_start() -> GRPOState:
    """Fresh state of an optimizer that leaves out what is not finite."""
    return start(optimizer=GUARDED)


def _step(
    optimizer: optax.GradientTransformation, state: GRPOState, batch: jax.Array
) -> tuple[GRPOState, dict[str, jax.Array]]:
    """The loss is NaN where the batch is negative."""
    noise = jax.random.normal(jax.random.fold_in(state.key, state.step), (3,))
    poison = jnp.where(batch[0] < 0, jnp.nan, 1.0)
    loss = lambda p: poison * jnp.mean((jnp.sum(p["w"] * noise) + p["b"] - batch) ** 2)
    value, grads = jax.value_and_grad(loss)(state.params)
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    after = GRPOState(params=params, opt_state=opt_state, step=state.step + 1, key=state.key)
    return after, {"loss": value, "first": batch[0]}


step = jax.jit(functools.partial(_step, OPTIMIZER), donate_argnums=0)
guarded_step = jax.jit(functools.partial(_step, GUARDED), donate_argnums=0)
