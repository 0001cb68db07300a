"""Sharding of every parameter, of optimizer state, caches and batches on a mesh.

A parameter is placed by the last two names of its path, layer and leaf, since a layer's name states its role; one that
stacks layers is split as each of them is.  Moments
of an optimizer, averaged and reference parameters are nested as the parameters are and end in the same two names, so
that one table serves all of them.

A dimension that an axis does not divide stays whole along it; that is an error only where it costs memory.
"""

import math
import re
from typing import Any

import jax
from jax.sharding import AbstractMesh, Mesh, NamedSharding, PartitionSpec

from touchr1_jax.distributed.mesh import DATA, FSDP, TENSOR
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.stacked import STACKED

AnyMesh = Mesh | AbstractMesh
Axis = str | None
Kernel = tuple[Axis, Axis]
"""Axes along which the inputs and the outputs of a dense layer are split."""

ROWS = (DATA, FSDP)
"""Axes along which the prompts, contacts or streams of a batch are split, always their first dimension."""

LARGE_BYTES = 2**20
"""Size from which on an array must be split by its rule; a thousand smaller ones are a gigabyte."""

OPENING: Kernel = (FSDP, TENSOR)
"""A layer that reads the residual stream: each device of the tensor axis computes some of its outputs, …"""
CLOSING: Kernel = (TENSOR, FSDP)
"""… and this one, which writes the stream again, reads those outputs where they are; its sums are then added up."""
ENTRY: Kernel = (None, FSDP)
"""A layer that writes the stream from outside, from pixels, forces or times: few inputs, not worth an exchange."""
JOINED: Kernel = (FSDP, None)
"""Queries, keys and values as one kernel: cut along tensor, its pieces would hold no whole heads of each."""
UNJOINED: Kernel = (None, FSDP)
"""The layer after such heads."""

KERNELS: dict[str, Kernel] = {
    **dict.fromkeys(("q_proj", "k_proj", "v_proj", "gate", "up", "head"), OPENING),
    **dict.fromkeys(("o_proj", "down"), CLOSING),
    **dict.fromkeys(("qkv", "kv"), JOINED),
    **dict.fromkeys(("proj", "out"), UNJOINED),
    **dict.fromkeys(("tactile_in", "merge_in", "merger_in", "force_in", "linear_fc1"), OPENING),
    **dict.fromkeys(("tactile_out", "merge_out", "merger_out", "force_out", "linear_fc2"), CLOSING),
    **dict.fromkeys(("patch", "cell", "stem", "energy", "time", "latent", "pixels", "patches", "condition"), ENTRY),
}
"""Dense layers by name, a number at its end left out."""

LEAVES: dict[str, tuple[Axis, ...]] = {
    "scale": (None,),
    "embedding": (TENSOR, FSDP),
    "patch_embed": ENTRY,
    "patch_bias": (None,),
    "patch_position": (None, FSDP),
    "position": (None, FSDP),
    "query": (None, None),
    "hidden": (None,),
    "noise": (None, None, None, FSDP),
}
"""Parameters that are no dense layer's, and the bank of encoded noise, by the name of the leaf alone."""

CONVOLUTION = (None, None, None, FSDP)
"""Rows, columns, inputs, outputs."""

SPLIT_OUTPUTS = frozenset(layer for layer, (_, outputs) in KERNELS.items() if outputs == TENSOR)
"""Layers whose outputs are split along the tensor axis; keys and values that a cache holds are, and logits."""


def state_shardings(mesh: AnyMesh, state: Any) -> Any:
    """Sharding of every leaf of parameters or of a state that holds them, in the same tree; scalars are whole.

    Args:
      mesh: where it will lie.
      state: arrays, or their shapes and dtypes.

    Raises:
      ValueError: a leaf without a rule.
      SizeError: one of `LARGE_BYTES` that its rule cannot split; both name the path.
    """

    def place(path: tuple[Any, ...], leaf: Any) -> NamedSharding:
        if not leaf.shape:
            return NamedSharding(mesh, PartitionSpec())
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        axes = rule(name, len(leaf.shape))
        return NamedSharding(mesh, _fitted(mesh, name, leaf, axes))

    return jax.tree_util.tree_map_with_path(place, state)


def gathered_shardings(mesh: AnyMesh, params: Any) -> Any:
    """Sharding of parameters that are whole along fsdp, as a layer multiplies with them; in the same tree."""
    whole_along = lambda axis: None if axis == FSDP else axis
    gathered = lambda placed: NamedSharding(mesh, PartitionSpec(*map(whole_along, placed.spec)))
    return jax.tree.map(gathered, state_shardings(mesh, params))


def batch_shardings(mesh: AnyMesh, batch: Any) -> Any:
    """Sharding of every leaf of a batch, in the same tree: split along its first dimension.

    Raises:
      SizeError: a first dimension that the axes of `ROWS` do not divide.
    """
    devices = row_devices(mesh)

    def place(path: tuple[Any, ...], leaf: Any) -> NamedSharding:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        if not leaf.shape or leaf.shape[0] % devices:
            raise SizeError(
                f"batch {name} has shape {leaf.shape}: its first dimension must be a multiple of data · fsdp = "
                f"{devices}; change the number of prompts or the mesh"
            )
        return NamedSharding(mesh, PartitionSpec(ROWS))

    return jax.tree_util.tree_map_with_path(place, batch)


def activation_axes(layer: str, rank: int) -> PartitionSpec:
    """Axes of what a layer computes, channels last: split along tensor or whole, the batch as it comes.

    Left to itself the compiler may split the channels along fsdp as the kernel's are and gather the batch instead.
    """
    channels = TENSOR if layer in SPLIT_OUTPUTS else None
    return PartitionSpec(*(PartitionSpec.UNCONSTRAINED,) * (rank - 1), channels)


def whole(mesh: AnyMesh) -> NamedSharding:
    """Sharding of what every device holds, such as metrics."""
    return NamedSharding(mesh, PartitionSpec())


def row_devices(mesh: AnyMesh) -> int:
    """Parts that the prompts of a batch are split into."""
    return math.prod(mesh.shape[axis] for axis in ROWS)


def rule(path: str, rank: int) -> tuple[Axis, ...]:
    """Axes along which the dimensions of a parameter are split, from its path, a/b/layer/leaf.

    Raises:
      ValueError: a path that no rule names, or a rule for arrays of another rank.
    """
    modules = re.sub(r"(?<=/kernel)/(codes|scale)$", "", path).split("/")  # both parts of `Nf4` lie as the matrix
    *_, layer, leaf = ("", *modules)
    axes = _rule(re.sub(r"_\d+$", "", layer), leaf)
    if axes is None:
        raise ValueError(f"parameter {path} has no sharding rule; name its layer or leaf in distributed/rules.py")
    if STACKED.intersection(modules):
        axes = (None, *axes)
    if len(axes) != rank:
        raise ValueError(
            f"parameter {path} has {rank} dimensions, its sharding rule {axes} has {len(axes)}; match them"
        )
    return axes


def _rule(layer: str, leaf: str) -> tuple[Axis, ...] | None:
    if layer == "conv":
        return {"kernel": CONVOLUTION, "bias": (None,)}.get(leaf)
    if leaf in LEAVES or (layer.startswith("norm") and leaf == "bias"):
        return LEAVES.get(leaf, (None,))
    if layer not in KERNELS:
        return None
    inputs, outputs = KERNELS[layer]
    of_layer: dict[str, tuple[Axis, ...]] = {
        "kernel": (inputs, outputs),
        "bias": (outputs if outputs == TENSOR else None,),
        "a": (inputs, None),  # the factors of a low-rank change, whose rank is too small to split
        "b": (None, outputs),
    }
    return of_layer.get(leaf)


def _fitted(mesh: AnyMesh, name: str, leaf: Any, axes: tuple[Axis, ...]) -> PartitionSpec:
    """The axes that divide their dimensions."""
    fits = [axis is None or size % mesh.shape[axis] == 0 for axis, size in zip(axes, leaf.shape, strict=True)]
    if not all(fits) and math.prod(leaf.shape) * leaf.dtype.itemsize >= LARGE_BYTES:
        at = fits.index(False)
        raise SizeError(
            f"parameter {name} has shape {leaf.shape}: dimension {at} must be a multiple of mesh {axes[at]} = "
            f"{mesh.shape[axes[at]]}; choose a divisor of {leaf.shape[at]}"
        )
    return PartitionSpec(*(axis if fit else None for axis, fit in zip(axes, fits, strict=True)))
