"""Put states and batches on a mesh, and compile a step for their shardings.

The steps of all stages, (state, batch, …) → (state, metrics), stay as they are: GSPMD (arXiv 2105.04663) splits the one
program that they trace to by the shardings of its arguments and results.
"""

import functools
import inspect
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any, Self

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding

from touchr1_jax.distributed.rules import activation_axes, batch_shardings, gathered_shardings, state_shardings, whole
from touchr1_jax.models.layers import RMSNorm
from touchr1_jax.training.loop import Batches, SingleDevice, Step

LAYERS = (nn.Dense, nn.Embed, RMSNorm)
"""Layers whose results are constrained to a sharding; others follow from them."""

OUTPUTS = ("__call__", "attend")
"""Their methods; by `attend` a table of embeddings computes logits."""


def place_state(mesh: Mesh, state: Any) -> Any:
    """A state on the mesh, on buffers of its own; every process must hold the same.

    Make a state that does not fit into one device in place, by `jax.jit(make, out_shardings=state_shardings(…))`.
    """
    return jax.tree.map(_placed, state, state_shardings(mesh, state))


def _placed(x: Any, sharding: NamedSharding) -> jax.Array:
    if not jnp.issubdtype(jnp.asarray(x).dtype, jax.dtypes.prng_key):
        return jnp.copy(jax.device_put(x, sharding))
    data = _placed(jax.random.key_data(x), sharding)  # keys cannot be put on devices of other processes, their bits can
    return jax.random.wrap_key_data(data, impl=jax.random.key_impl(x))


def place_batch(mesh: Mesh, rows: Any, batch_size: int) -> Any:
    """A batch on the mesh from the rows that this process has read, those of `local_rows`.

    Args:
      mesh: where the step runs.
      rows: tree of arrays, first dimension as long as `local_rows`.
      batch_size: rows of the whole batch.

    Raises:
      ValueError: an array of another number of rows.
    """
    count = len(local_rows(mesh, batch_size))

    def place(path: tuple[Any, ...], x: Any) -> jax.Array:
        x = np.asarray(x)
        if not x.shape or len(x) != count:
            name = jax.tree_util.keystr(path, simple=True, separator="/")
            raise ValueError(
                f"batch {name} has shape {x.shape}: must have the {count} rows of `local_rows`; read those"
            )
        shape = (batch_size, *x.shape[1:])
        sharding = batch_shardings(mesh, jax.ShapeDtypeStruct(shape, x.dtype))
        return jax.make_array_from_process_local_data(sharding, x, shape)

    return jax.tree_util.tree_map_with_path(place, rows)


def local_rows(mesh: Mesh, batch_size: int) -> np.ndarray:
    """Rows of a batch that the devices of this process hold, ascending: all that it must read.

    A pipeline that draws the rows of the whole batch and then reads these gives the same batches whatever the number of
    processes, so that a run can resume with another number of them.

    Raises:
      ValueError: as `batch_shardings`.
    """
    sharding = batch_shardings(mesh, jax.ShapeDtypeStruct((batch_size,), np.int32))
    slices = [index[0] for index in sharding.addressable_devices_indices_map((batch_size,)).values()]
    return np.unique(np.concatenate([np.arange(batch_size)[s] for s in slices]))


def shard_step(
    step: Step,
    mesh: Mesh,
    state: Any,
    batch: Any,
    *shared: Any,
    compiler_options: Mapping[str, Any] | None = None,
) -> jax.stages.Wrapped:
    """The step compiled for the mesh, (state, batch, *shared) → (state, metrics); the state's buffers are donated.

    Args:
      step: a stage's step, jitted or not.
      mesh: where it runs.
      state, batch, shared: arguments, or their shapes and dtypes; a run never changes `shared`.
      compiler_options: of `jax.jit`; those that the step was made with do not carry over.

    Raises:
      ValueError: as `state_shardings` and `batch_shardings`.
    """
    placed = state_shardings(mesh, state)
    given = (placed, batch_shardings(mesh, batch), *(state_shardings(mesh, x) for x in shared))
    plain = inspect.unwrap(step)  # a jitted step would bring along a trace from before, or of another mesh

    def on_mesh(*arguments: Any) -> tuple[Any, dict[str, jax.Array]]:
        with split_activations(mesh):
            return plain(*arguments)

    results = (placed, whole(mesh))
    options = None if compiler_options is None else dict(compiler_options)
    return jax.jit(on_mesh, in_shardings=given, out_shardings=results, donate_argnums=0, compiler_options=options)


def gather_params(mesh: Mesh, params: Any) -> Any:
    """All-gather the parameters of a traced program along fsdp; a loop that reads them then exchanges nothing.

    Partially applied to a mesh it is the `gather` of `rl.grpo.make_grpo_step`.
    """
    return jax.tree.map(jax.lax.with_sharding_constraint, params, gathered_shardings(mesh, params))


def split_activations(mesh: Mesh) -> AbstractContextManager[None]:
    """Context in which the result of every layer has the sharding of `rules.activation_axes`."""

    def constrain(call: Callable[..., Any], args: Any, kwargs: Any, context: nn.module.InterceptorContext) -> Any:
        y = call(*args, **kwargs)
        if not isinstance(context.module, LAYERS) or context.method_name not in OUTPUTS:
            return y
        layer = "head" if context.method_name == "attend" else str(context.module.name)
        return jax.lax.with_sharding_constraint(y, NamedSharding(mesh, activation_axes(layer, y.ndim)))

    return nn.intercept_methods(constrain)


class DeviceMesh(SingleDevice):
    """Training steps run on the devices of a mesh, including those of other processes."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self.shape = mesh.devices.shape
        self.gather_params = functools.partial(gather_params, mesh)
        self._compiled: dict[Step, Step] = {}

    def local_rows(self, batch_size: int) -> np.ndarray:
        """Rows whose devices belong to this process."""
        return local_rows(self._mesh, batch_size)

    def shard(
        self, step: Step, state: Any, batches: Batches, batch_size: int, *constants: Any
    ) -> tuple[Step, Any, Batches]:
        """The same, split by the sharding rules; one step is compiled once."""
        placed = PlacedBatches(batches, self._mesh, batch_size)
        if step not in self._compiled:
            self._compiled[step] = shard_step(step, self._mesh, state, placed.shapes(), *constants)
        on_mesh, there = self._compiled[step], [place_state(self._mesh, x) for x in constants]
        return lambda s, b: on_mesh(s, b, *there), place_state(self._mesh, state), placed

    def gather(self, tree: Any) -> Any:
        """Arrays gathered from all devices of all processes."""
        return jax.tree.map(jnp.asarray, multihost_utils.process_allgather(tree, tiled=True))


class PlacedBatches:
    """Batches on a mesh, made from the rows that each process reads."""

    def __init__(self, batches: Batches, mesh: Mesh, batch_size: int) -> None:
        self._batches, self._mesh, self._size = batches, mesh, batch_size

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Any:
        return place_batch(self._mesh, next(self._batches), self._size)

    def get_state(self) -> Any:
        """Position in the data; the same in all processes, whatever their number."""
        return self._batches.get_state()

    def set_state(self, state: Any) -> None:
        """Return to a position."""
        self._batches.set_state(state)

    def shapes(self) -> Any:
        """Shapes and dtypes of a whole batch, from the first one, which is read again."""
        before = self.get_state()
        first = next(self._batches)
        self.set_state(before)
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct((self._size, *x.shape[1:]), x.dtype), first)
