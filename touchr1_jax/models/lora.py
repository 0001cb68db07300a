"""Low-rank adapters as a function of parameters: a frozen base, and a small tree added to it that is trained.

    y = x W + s (x A) B,   W [in, out] frozen, A [in, r], B [r, out] trained, B = 0 at first

(Hu et al. 2021, arXiv 2106.09685, §4.1).  Parameters of an adapted policy hold the factors under `adapters`, nested as
the layers that they belong to, and the base is never changed: `adapted` adds the second term to dense layers of any
Linen module while it is applied.  `merge` exports parameters that compute the same without it.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import flax.linen as nn
import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.stacked import ADAPTERS
from touchr1_jax.models.vmappable_dense import linear
from touchr1_jax.types import Params
from touchr1_jax.validation import above, at_least


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoraConfig:
    """Which dense layers are adapted, and how.

    Raises:
      ValueError: a rank below 0, or one above 0 without targets.
    """

    rank: int = 16
    """Width of the adapters; 0 leaves them out."""
    alpha: float = 32.0
    """The change is multiplied by alpha / rank."""
    rank_stabilised: bool = False
    """Multiply by alpha / √rank instead (rsLoRA, arXiv 2312.03732), so that the rate need not fall with the rank."""
    targets: tuple[str, ...] = ("q_proj", "k_proj", "v_proj", "o_proj", "gate", "up", "down")
    """Layers of the decoder."""
    vision_targets: tuple[str, ...] = ()
    """Layers of the vision tower, of a released one qkv, proj, gate, up, down, merger_in or merger_out."""

    def __post_init__(self) -> None:
        at_least(self, 0, "rank")
        above(self, 0, "alpha")
        if self.rank and not self.towers:
            raise ValueError("targets are (): must name a layer where rank is above 0; name one, or set rank 0")

    @property
    def scale(self) -> float:
        """s, α/r or α/√r; 0 without adapters."""
        if not self.rank:
            return 0.0
        return self.alpha / (self.rank**0.5 if self.rank_stabilised else self.rank)

    @property
    def towers(self) -> dict[str, tuple[str, ...]]:
        """Tower → its layers that are adapted."""
        named = {"decoder": self.targets, "vision": self.vision_targets}
        return {tower: layers for tower, layers in named.items() if layers}


class Adapter(NamedTuple):
    """The two factors of one layer's change, or of a stack of layers."""

    a: Float[Array, "*layer inp r"]
    b: Float[Array, "*layer r out"]


Adapters = Params
"""Factors "a" and "b" of each adapted layer, nested as the parameters of the layers that they belong to."""


def by_layer(adapters: Adapters) -> dict[tuple[str, ...], Adapter]:
    """The adapter of every layer, by its path."""
    flat = flax.traverse_util.flatten_dict(adapters)
    return {path[:-1]: Adapter(x, flat[(*path[:-1], "b")]) for path, x in flat.items() if path[-1] == "a"}


def nested(adapters: Mapping[tuple[str, ...], Adapter]) -> Adapters:
    """Inverse of `by_layer`."""
    return flax.traverse_util.unflatten_dict({path: found._asdict() for path, found in adapters.items()})


def init_adapters(key: Array, base: Params, config: LoraConfig) -> Adapters:
    """Fresh adapters, float32: A uniform in ±1/√in, B zero, so that nothing changes at first.

    Args:
      key: randomness of the A.
      base: parameters, or their shapes.
      config: which layers.

    Raises:
      SizeError: a layer or tower that the base lacks.
    """
    shapes = {path: leaf.shape for path, leaf in _kernels(base, config)}
    for tower, layers in config.towers.items():
        if lacking := {*layers} - {path[-1] for path in shapes if path[0] == tower}:
            there = sorted(
                {
                    path[-2]
                    for path in flax.traverse_util.flatten_dict(base)
                    if path[0] == tower and path[-1] == "kernel"
                }
            )
            raise SizeError(f"targets {sorted(lacking)} are no dense layers of {tower}; name others, of {there}")
    keys = jax.random.split(key, len(shapes))
    fresh = {
        path: Adapter(
            a=jax.random.uniform(k, (*stack, inp, config.rank), minval=-1, maxval=1) / np.sqrt(inp),
            b=jnp.zeros((*stack, config.rank, out)),
        )
        for k, (path, (*stack, inp, out)) in zip(keys, shapes.items(), strict=True)
    }
    return nested(fresh)


def with_adapters(params: Params, config: LoraConfig, base: Params, seed: int) -> Params:
    """Parameters whose adapters are fresh where they have none.

    Args:
      params: which may hold `adapters`.
      config: which layers.
      base: parameters of the adapted towers.
      seed: of fresh adapters.
    """
    if ADAPTERS in params or not config.rank:
        return params
    return {**params, ADAPTERS: init_adapters(jax.random.fold_in(jax.random.key(seed), 1), base, config)}


def of_decoder(params: Params) -> Params:
    """The decoder and its adapters, of all parameters."""
    found = {"decoder": params["decoder"]}
    if "decoder" in params.get(ADAPTERS, {}):
        found[ADAPTERS] = {"decoder": params[ADAPTERS]["decoder"]}
    return found


def adapted(scale: float) -> AbstractContextManager[None]:
    """Within this context a dense layer with variables "a" and "b" in the collection `ADAPTERS` adds s (x A) B."""

    def add(call: Callable[..., Array], args: tuple[Any, ...], kwargs: dict[str, Any], context) -> Array:
        y, layer = call(*args, **kwargs), context.module
        if not isinstance(layer, nn.Dense) or context.method_name != "__call__":
            return y
        if not layer.has_variable(ADAPTERS, "a"):
            return y
        factor: Callable[[str], Array] = lambda name: layer.get_variable(ADAPTERS, name).astype(y.dtype)
        return y + scale * linear(linear(args[0].astype(y.dtype), factor("a")), factor("b"))

    return nn.intercept_methods(add)


def merge(base: Params, adapters: Adapters, config: LoraConfig) -> Params:
    """Parameters with the adapters in them, W + s A B, computed in float32 and kept in the type of W.

    A coarse type loses what moves a weight by less than half the distance to its neighbour (`merged_kernel`).

    Raises:
      ValueError: adapters of layers that the base lacks.
    """
    flat, found = flax.traverse_util.flatten_dict(base), by_layer(adapters)
    strangers = ["/".join(path) for path in found if (*path, "kernel") not in flat]
    if strangers:
        raise ValueError(f"adapters {strangers[:3]} belong to no layer of the base; merge them into their own")
    for path, adapter in found.items():
        flat[(*path, "kernel")], _ = merged_kernel(flat[(*path, "kernel")], adapter, config)
    return flax.traverse_util.unflatten_dict(flat)


def exported(params: Params, config: LoraConfig) -> Params:
    """All parameters with their adapters merged into them."""
    whole = {name: tree for name, tree in params.items() if name != ADAPTERS}
    return merge(whole, params[ADAPTERS], config) if ADAPTERS in params else whole


def merged_kernel(kernel: Array, adapter: Adapter, config: LoraConfig) -> tuple[Array, Float[Array, "2"]]:
    """W' = W + Δ, computed in float32 and kept in the type of W, with ⟨W' − W, Δ⟩ and ⟨Δ, Δ⟩ for Δ = s A B.

    The ratio of the two, also of their sums over layers, is the share of the change that is kept: 1 where nothing is
    lost; near 0 where the type is too coarse.
    """
    change, before = config.scale * adapter.a @ adapter.b, kernel.astype(jnp.float32)
    after = (before + change).astype(kernel.dtype)
    return after, jnp.stack([jnp.vdot(after.astype(jnp.float32) - before, change), jnp.vdot(change, change)])


def _kernels(base: Params, config: LoraConfig) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path and kernel of every dense layer that the config names."""
    for path, leaf in flax.traverse_util.flatten_dict(base).items():
        *modules, name = path
        if name == "kernel" and modules[-1] in config.towers.get(modules[0], ()):
            yield tuple(modules), leaf
