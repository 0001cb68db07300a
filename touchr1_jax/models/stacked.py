"""Layers of one shape as one layer with stacked parameters: a program and its compilation do not grow with depth."""

import re
from collections.abc import Callable, Mapping
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

ADAPTERS = "adapters"
"""Collection of variables that holds low-rank adapters of dense layers (see `models.lora`)."""

STACKED = frozenset({"layers", "blocks"})
"""Names of modules whose parameters have a first axis for the layer."""

LAST = "last_layer"
"""Name of the module of the decoder's last layer, which stands alone."""


UNROLLED = 8
"""Most layers whose loop is written out: a step then takes nine tenths of the time."""

LAYER_BY_LAYER = {"xla_disable_hlo_passes": "while-loop-invariant-code-motion"}
"""Option of programs on weights in bfloat16: XLA multiplies these as float32 on CPUs, and would convert all layers at
once, before its loop over them."""


def scan_layers(each: Callable[..., tuple[Any, Any]], count: int) -> Callable[..., tuple[Any, Any]]:
    """The function (layer, carry, *of each layer) → carry, stacked results, from that of one layer.

    Args:
      each: (layer, carry, *of this layer) → carry, result.
      count: number of layers.
    """
    return nn.scan(
        each,
        variable_axes=dict.fromkeys(("params", ADAPTERS), 0),
        split_rngs={"params": True},
        length=count,
        unroll=count if count <= UNROLLED else 1,
        check_constancy_invariants=False,
    )


def before_the_loop(x: Array) -> Array:
    """The same array, which XLA on CPU makes before a loop, and not in each of its rounds.

    It moves no slice of a stack and no transposition out of a loop by itself, but a barrier and all that it needs.
    Arrays in bfloat16 stay in the loop (see `LAYER_BY_LAYER`).
    """
    moves = x.dtype != jnp.bfloat16 and jax.default_backend() == "cpu"
    return jax.lax.optimization_barrier(x) if moves else x


def layer_by_layer(weights: Any) -> dict[str, Any]:
    """Options of the compiler for programs on weights of a type: `LAYER_BY_LAYER` where it is needed."""
    return LAYER_BY_LAYER if weights == jnp.bfloat16 and jax.default_backend() == "cpu" else {}


def unstacked(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters by dotted names, those of each layer under its number, layers_0 … layers_N, as files hold them."""
    count = 1 + next((len(x) for name, x in flat.items() if ".layers." in name), 0)
    found: dict[str, Any] = {}
    for name, x in flat.items():
        (stack,) = STACKED.intersection(name.split(".")) or (None,)
        if stack is None:
            found[name.replace(f".{LAST}.", f".layers_{count - 1}.")] = x
        else:
            found |= {name.replace(f".{stack}.", f".{stack}_{i}."): row for i, row in enumerate(x)}
    return found


def restacked(flat: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Inverse of `unstacked`.

    Raises:
      ValueError: layers of which some lack a parameter or have another shape.
    """
    found: dict[str, np.ndarray] = {}
    rows: dict[str, dict[int, np.ndarray]] = {}
    for name, x in flat.items():
        numbered = re.fullmatch(r"(.*\.(?:layers|blocks))_(\d+)(\..*)", name)
        if numbered is None:
            found[name] = x
        else:
            rows.setdefault(numbered[1] + numbered[3], {})[int(numbered[2])] = x
    for name, of_layers in rows.items():
        if sorted(of_layers) != list(range(len(of_layers))):
            raise ValueError(f"{name} is there for layers {sorted(of_layers)}: must be for all; copy the file again")
        last = len(of_layers) - 1 if ".layers." in name else len(of_layers)
        if last < len(of_layers):
            found[name.replace(".layers.", f".{LAST}.")] = of_layers[last]
        if last:
            found[name] = np.stack([of_layers[i] for i in range(last)])
    return found
