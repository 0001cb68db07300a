"""Time and arithmetic of an encoder's forward pass, of its parts, and of a matrix product for comparison."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from experiments.core.timing import median_ms
from touchr1_jax.models.tactile_vit import TactileViTConfig, cut_patches, kept_patches, patch_tokens
from touchr1_jax.training.dynamics import DynamicsConfig, encode_each, read_frames
from touchr1_jax.types import Params, TouchBatch

MATRIX = 1024  # side of the matrices whose product gives the peak rate of the machine


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompiledProgram:
    """A compiled call and its arithmetic, in Gflop."""

    call: Callable[[], Any]
    gflop: float


def forward(networks: DynamicsConfig, params: Params, batch: TouchBatch) -> CompiledProgram:
    """The encoder, from the bytes of a batch to its tokens."""
    return by_contact(lambda p, b: encode_each(networks.encoder, p, read_frames(networks, b)), params, batch)


def parts(networks: DynamicsConfig, params: Params, batch: TouchBatch) -> dict[str, Callable[[], CompiledProgram]]:
    """Makers of programs that each do one thing more than the one before, up to the whole encoder."""
    e = networks.encoder
    shallow = dataclasses.replace(e, num_layers=0)
    few = {name: x for name, x in params.items() if not name.startswith("layer_")}
    stem = {name: params[name] for name in ("stem", "patch", "energy")}

    def each(one: Callable[[jax.Array, jax.Array | None], Any], b: TouchBatch) -> Any:
        b = read_frames(networks, b)
        number = None if e.rest == "merge" else e.patches_kept  # merging reads every patch
        kept = lambda x: None if number is None else kept_patches(x[0], x[1], e, number)
        return jax.lax.map(lambda x: one(x[0], kept(x)), (b.frames, b.frame_mask))

    cut = lambda x, kept: cut_patches(x, e, kept).astype(jnp.float32) / 127.5
    return {
        "cut the bytes": lambda: by_contact(lambda b: each(cut, b), batch),
        "stem, energies, embedding": lambda: by_contact(
            lambda p, b: each(lambda x, kept: _Stem(e).apply({"params": p}, x, kept), b), stem, batch
        ),
        "time, force, pooling": lambda: by_contact(
            lambda p, b: encode_each(shallow, p, read_frames(networks, b)), few, batch
        ),
        "transformer": lambda: forward(networks, params, batch),
    }


class _Stem(nn.Module):
    """`patch_tokens` as a module."""

    config: TactileViTConfig

    @nn.compact
    def __call__(self, frames: jax.Array, kept: jax.Array | None) -> jax.Array:
        return patch_tokens(frames, self.config, kept)


def matrix_product() -> CompiledProgram:
    """One product of square matrices."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(MATRIX, MATRIX)), jnp.float32)
    product = lambda a: a @ a
    return CompiledProgram(call=bind(product, x), gflop=arithmetic(product, x))


def by_contact(function: Callable[..., Any], *arguments: Any) -> CompiledProgram:
    """A program that reads the contacts of a batch, its last argument, one after the other.

    XLA counts a loop's body once, so the arithmetic is that of one contact times their number.
    """
    *others, batch = arguments
    one = jax.tree.map(lambda x: x[:1], batch)
    return CompiledProgram(
        call=bind(function, *arguments), gflop=len(batch.frames) * arithmetic(function, *others, one)
    )


def bind(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """The function compiled for these arguments, which stay on the device."""
    placed = jax.device_put(arguments)
    program = jax.jit(function).lower(*placed).compile()
    return lambda: program(*placed)


def arithmetic(function: Callable[..., Any], *arguments: Any) -> float:
    """Gflop of a call as XLA counts them before optimisation, a loop's body once."""
    cost: Any = jax.jit(function).lower(*arguments).cost_analysis()
    return float(cost["flops"]) / 1e9


def medians(programs: Mapping[str, CompiledProgram], rounds: Iterable[object]) -> dict[str, float]:
    """Median seconds of each, in interleaved rounds."""
    ms = median_ms({name: program.call for name, program in programs.items()}, rounds)
    return {name: one / 1e3 for name, one in ms.items()}
