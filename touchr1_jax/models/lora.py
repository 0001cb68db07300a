"""Low-rank adapters as a function of parameters: a frozen base, and a small tree beside it that is trained.

    y = x W + (α/r) (x A) B,   W [in, out] frozen, A [in, r], B [r, out] trained, B = 0 at first

(Hu et al. 2021, arXiv 2106.09685, §4.1).  The base is never copied: `adapted` adds the second term to the chosen dense
layers of any Linen module while it is applied.  `merge` gives the parameters that compute the same without it.
"""

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any

import flax.linen as nn
import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.types import Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class LoraConfig:
    """Which dense layers are adapted, and how: those named in `layers` inside one of `towers`.

    Raises:
      ValueError: a rank below 1.
    """

    rank: int = 16
    alpha: float = 32.0
    layers: tuple[str, ...] = ("q_proj", "k_proj", "v_proj", "o_proj", "gate", "up", "down")
    towers: tuple[str, ...] = ("decoder",)

    def __post_init__(self) -> None:
        if self.rank < 1:
            raise ValueError(f"rank is {self.rank}: must be at least 1; leave the adapters out for none")

    @property
    def scale(self) -> float:
        """α/r."""
        return self.alpha / self.rank


class Adapter(struct.PyTreeNode):
    """The two factors of one layer's change."""

    a: Float[Array, "inp r"]
    b: Float[Array, "r out"]


Adapters = Any
"""A tree of `Adapter`s, nested as the parameters of the layers that they belong to."""


def init_adapters(key: Array, base: Params, config: LoraConfig) -> Adapters:
    """Fresh adapters, float32: A uniform in ±1/√in, B zero, so that nothing changes at first.

    Args:
      key: randomness of the A.
      base: parameters, or their shapes.
      config: which layers.

    Raises:
      ValueError: a layer or tower that the base lacks.
    """
    shapes = {path: leaf.shape for path, leaf in _kernels(base, config)}
    for field, position in (("layers", -1), ("towers", 0)):
        found = {path[position] for path in shapes}
        lacking = set(getattr(config, field)) - found
        if lacking:
            raise ValueError(f"{field} {sorted(lacking)} have no dense layer in the parameters; name others")
    keys = jax.random.split(key, len(shapes))
    fresh = {
        path: Adapter(
            a=jax.random.uniform(k, (inp, config.rank), minval=-1, maxval=1) / np.sqrt(inp),
            b=jnp.zeros((config.rank, out)),
        )
        for k, (path, (inp, out)) in zip(keys, shapes.items(), strict=True)
    }
    return flax.traverse_util.unflatten_dict(fresh)


def adapted(adapters: Adapters, config: LoraConfig) -> AbstractContextManager[None]:
    """Within this context every dense layer that has an adapter computes x W + b + (α/r) (x A) B."""
    by_path = flax.traverse_util.flatten_dict(adapters)

    def add(call: Callable[..., Array], args: tuple[Any, ...], kwargs: dict[str, Any], context) -> Array:
        y = call(*args, **kwargs)
        path = context.module.path
        if not isinstance(context.module, nn.Dense) or context.method_name != "__call__" or path not in by_path:
            return y
        a, b = by_path[path].a.astype(y.dtype), by_path[path].b.astype(y.dtype)
        return y + config.scale * (args[0].astype(y.dtype) @ a) @ b

    return nn.intercept_methods(add)


def merge(base: Params, adapters: Adapters, config: LoraConfig) -> Params:
    """Parameters with the adapters in them, W + (α/r) A B, computed in float32 and kept in the type of W.

    Raises:
      ValueError: adapters of layers that the base lacks.
    """
    flat, by_path = (flax.traverse_util.flatten_dict(tree) for tree in (base, adapters))
    strangers = ["/".join(path) for path in by_path if (*path, "kernel") not in flat]
    if strangers:
        raise ValueError(f"adapters {strangers[:3]} belong to no layer of the base; merge them into their own")
    for path, adapter in by_path.items():
        kernel = flat[(*path, "kernel")]
        change = _change(adapter, config)
        flat[(*path, "kernel")] = (kernel.astype(jnp.float32) + change).astype(kernel.dtype)
    return flax.traverse_util.unflatten_dict(flat)


def kept_share(base: Params, merged: Params, adapters: Adapters, config: LoraConfig) -> float:
    """Share of the adapters' change Δ that merged weights keep, ⟨W' − W, Δ⟩ / ⟨Δ, Δ⟩ over all layers.

    1 where nothing is lost; near 0 where the weights' type is too coarse: a weight that the change moves by less than
    half the distance to its neighbour in that type stays where it is.  No change at all is kept whole.

    Args:
      base, adapters, config: as `merge` took them.
      merged: what it gave.
    """
    before, after, by_path = (flax.traverse_util.flatten_dict(tree) for tree in (base, merged, adapters))
    along, whole = 0.0, 0.0
    for path, adapter in by_path.items():
        w, v = (tree[(*path, "kernel")].astype(jnp.float32) for tree in (before, after))
        change = _change(adapter, config)
        along += float(jnp.vdot(v - w, change))
        whole += float(jnp.vdot(change, change))
    return along / whole if whole else 1.0


def _change(adapter: Adapter, config: LoraConfig) -> Array:
    """Change that an adapter adds to its kernel, (α/r) A B, in float32."""
    return config.scale * adapter.a @ adapter.b


class Trainable(struct.PyTreeNode):
    """Trained parameters of an adapted policy: adapters, and towers trained in full, such as the tactile encoder.

    The reference policy of GRPO is the base itself: fresh adapters, whose B is 0, and no towers.
    """

    adapters: Adapters
    towers: Params


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LoraFns(PolicyFns):
    """Policy functions whose parameters are a `Trainable`; the base is part of its context and gets no gradient.

    A base of gigabytes must reach a compiled step as an argument and not as a constant: build the step inside the
    compiled function, as `over_base` does.
    """

    base: Params
    lora: LoraConfig

    def with_context(self, change: Callable[[Params], Params]) -> "LoraFns":
        """The functions on a changed base."""
        return dataclasses.replace(self, base=change(self.base))

    def _apply(self, params: Trainable, method: Callable[..., Any], *args: Any) -> Any:
        with adapted(params.adapters, self.lora):
            return self.module.apply({"params": {**self.base, **params.towers}}, *args, method=method)


def adapt(fns: PolicyFns, base: Params, config: LoraConfig) -> LoraFns:
    """The same functions on a frozen base."""
    fields = {f.name: getattr(fns, f.name) for f in dataclasses.fields(PolicyFns)}
    return LoraFns(**fields, base=base, lora=config)


def over_base(fns: LoraFns, make_step: Callable[[LoraFns], Callable[..., Any]]) -> Callable[..., Any]:
    """Compile (base, state, …) → result from a maker of the step (state, …) → result; the state is donated."""

    def step(base: Params, state: Any, *rest: Any) -> Any:
        return make_step(dataclasses.replace(fns, base=base))(state, *rest)

    return jax.jit(step, donate_argnums=1)


def _kernels(base: Params, config: LoraConfig) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path and kernel of every dense layer that the config names."""
    for path, leaf in flax.traverse_util.flatten_dict(base).items():
        *modules, name = path
        if name == "kernel" and modules[0] in config.towers and modules[-1] in config.layers:
            yield tuple(modules), leaf
