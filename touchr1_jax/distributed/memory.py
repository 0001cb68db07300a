"""Memory of a step on each device, predicted without devices or weights: counted by hand, and compiled.

The count follows from shapes and sharding rules alone.  The compiler's own figures come from lowering and compiling
the step for the mesh on as many simulated devices (`--xla_force_host_platform_device_count`); a CPU keeps bfloat16
products in float32, so that its temporary memory is an upper bound.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.rules import state_shardings
from touchr1_jax.models.layers import MOST_SCORES
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.rl.config import GRPOConfig, left_out, needs_reference
from touchr1_jax.rl.grpo import FrozenInputs, GRPOState
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.types import Params

GIB = 2**30
HALF, FLOAT = 2, 4
"""Bytes of a bfloat16 and of a float32."""


class Compiled(NamedTuple):
    """Bytes that the compiler reserves on each device; `aliased` is the part of the results in buffers of arguments.

    Source: `jax.stages.Compiled.memory_analysis`, of one device's program.
    """

    arguments: int
    results: int
    aliased: int
    temporary: int

    @property
    def peak(self) -> int:
        """Arguments, temporary memory, and results on buffers of their own."""
        return self.arguments + self.temporary + self.results - self.aliased


def compiled_bytes(step: jax.stages.Wrapped, *arguments: Any) -> Compiled:
    """Compile a jitted step for the shapes of its arguments, and return the compiler's figures.

    Raises:
      RuntimeError: a backend without memory analysis.
    """
    return reserved_bytes(step.lower(*arguments).compile())


def reserved_bytes(compiled: jax.stages.Compiled) -> Compiled:
    """The compiler's figures for a program.

    Raises:
      RuntimeError: a backend without memory analysis.
    """
    found: Any = compiled.memory_analysis()
    if found is None:
        raise RuntimeError(f"backend {jax.default_backend()} has no memory analysis; compile for CPU or GPU")
    return Compiled(
        found.argument_size_in_bytes,
        found.output_size_in_bytes,
        found.alias_size_in_bytes,
        found.temp_size_in_bytes,
    )


def held_bytes(mesh: MeshConfig, tree: Any) -> int:
    """Bytes of parameters or of a state on each device, by the rules."""
    shardings = state_shardings(mesh.abstract(), tree)
    size = lambda x, sharding: math.prod(sharding.shard_shape(x.shape)) * x.dtype.itemsize
    return sum(jax.tree.leaves(jax.tree.map(size, tree, shardings)))


@dataclasses.dataclass(frozen=True, kw_only=True)
class GRPOShape:
    """The sizes that the memory of a GRPO step depends on.

    Raises:
      ValueError: prompts or micro-batches that data · fsdp does not divide, or key heads that tensor does not.
    """

    decoder: DecoderConfig
    grpo: GRPOConfig
    mesh: MeshConfig
    prompt_tokens: int

    def __post_init__(self) -> None:
        rows = self.mesh.data * self.mesh.fsdp
        for name in ("drawn", "micro_prompts"):
            count = self.grpo.drawn if name == "drawn" else self.grpo.micro_prompts
            if count % rows:
                raise ValueError(f"{name} is {count}: must be a multiple of data · fsdp = {rows}; change either")
        if self.decoder.num_kv_heads % self.mesh.tensor:
            raise ValueError(
                f"num_kv_heads is {self.decoder.num_kv_heads}: must be a multiple of mesh tensor = {self.mesh.tensor}; "
                "choose a divisor of it"
            )

    @property
    def rows(self) -> int:
        """Prompts of a batch on each device."""
        return self.grpo.drawn // (self.mesh.data * self.mesh.fsdp)

    @property
    def micro_rows(self) -> int:
        """Prompts of a micro-batch on each device."""
        return self.grpo.micro_prompts // (self.mesh.data * self.mesh.fsdp)

    @property
    def number(self) -> int:
        """Bytes of a number in forward passes."""
        return HALF if self.grpo.bfloat16 else FLOAT


def grpo_bytes(
    shape: GRPOShape, state: GRPOState, batch: GRPOBatch, frozen: FrozenInputs, base: Params | None = None
) -> dict[str, int]:
    """Bytes of a GRPO step on each device, line by line; shapes in place of arrays will do.

    Sampling gathers all weights before its first token.  Other passes gather the weights of a layer where
    they use them and drop them: two layers at a time, with the next one on its way, and the heads of all policies that
    are compared.  Of
    two gradients one is the sum over micro-batches.  With `remat` the backward pass keeps products with weights alone;
    without it about twice that.

    Args:
      shape: sizes of the step.
      state, batch, frozen: its arguments.
      base: frozen parameters under low-rank adapters, which the state then holds.
    """
    local_bytes = lambda tree: held_bytes(shape.mesh, tree)
    layer = layer_weights(shape.decoder) // shape.mesh.tensor
    head = head_weights(shape.decoder) // shape.mesh.tensor
    half = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, jnp.bfloat16), state.params)
    rows = shape.mesh.data * shape.mesh.fsdp
    return {
        "frozen base": local_bytes(base),
        "parameters": local_bytes(state.params),
        "optimizer": local_bytes(state.opt_state),
        "reference": local_bytes(frozen.reference),
        "noise bank": local_bytes({"noise": frozen.noise}),
        "batch": sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(batch)) // rows,
        "gradients": 2 * local_bytes(state.params),
        "parameters in bfloat16": local_bytes(half) * (1 + (state.reference is not None)) if shape.grpo.bfloat16 else 0,
        "gathered weights": (2 * layer + _policies(shape) * head) * shape.number,
        "weights while sampling": _sampler_bytes(shape, (base, half if shape.grpo.bfloat16 else state.params)),
        "caches while sampling": cache_bytes(shape),
        "logits while sampling": 3 * shape.rows * shape.grpo.group * shape.decoder.vocab_size * FLOAT,
        "saved for the gradient": saved_bytes(shape),
        "attention while learning": attention_bytes(shape),
        "logits while learning": logit_bytes(shape),
    }


ARGUMENTS = ("frozen base", "parameters", "optimizer", "reference", "noise bank", "batch")
"""Lines of `grpo_bytes` that are arguments of the step; the compiler's figure must be the same."""

SAMPLING = ("weights while sampling", "caches while sampling", "logits while sampling")
LEARNING = ("gradients", "saved for the gradient", "attention while learning", "logits while learning")
"""Lines that are needed one after the other."""


def counted_peak(lines: Mapping[str, int]) -> int:
    """The sum of the lines of `grpo_bytes`, of sampling and learning only the larger."""
    either = [sum(lines[name] for name in phase) for phase in (SAMPLING, LEARNING)]
    return sum(lines.values()) - min(either)


def layer_weights(decoder: DecoderConfig) -> int:
    """Numbers in the matrices of one layer."""
    c = decoder
    return c.hidden_size * ((2 * c.num_heads + 2 * c.num_kv_heads) * c.head_dim + 3 * c.intermediate_size)


def head_weights(decoder: DecoderConfig) -> int:
    """Numbers in the matrix that makes logits."""
    return decoder.hidden_size * decoder.vocab_size


def cache_bytes(shape: GRPOShape) -> int:
    """Keys and values of the prompts and of their rollouts, of all layers."""
    c = shape.decoder
    tokens = shape.prompt_tokens + shape.grpo.group * shape.grpo.length
    return shape.rows * tokens * c.num_layers * 2 * c.num_kv_heads // shape.mesh.tensor * c.head_dim * shape.number


def saved_bytes(shape: GRPOShape) -> int:
    """Activations that the backward pass keeps of each token and layer: its input and all matrix products but the last,
    which is part of the next layer's input; twice, where the perturbed branch has a gradient too."""
    c, algorithm = shape.decoder, shape.grpo.algorithm
    split = (c.num_heads + 2 * c.num_kv_heads) * c.head_dim + 2 * c.intermediate_size
    products = split // shape.mesh.tensor + 2 * c.hidden_size
    branches = 1 if left_out(algorithm.gamma) or algorithm.grounding_stop_masked else 2
    tokens = shape.prompt_tokens + shape.grpo.group * shape.grpo.length
    kept = 1 if shape.grpo.remat else 2
    return shape.micro_rows * branches * tokens * c.num_layers * kept * products * shape.number


def attention_bytes(shape: GRPOShape) -> int:
    """Scores, weights and their gradient of one layer, float32: each completion over its prompt and itself, as far as
    they exist at once."""
    g, t = shape.grpo.group, shape.grpo.length
    scores = min(g * shape.decoder.num_heads * t * (shape.prompt_tokens + t), MOST_SCORES)
    return 3 * shape.micro_rows * scores // shape.mesh.tensor * FLOAT


def logit_bytes(shape: GRPOShape) -> int:
    """Logits of a block of tokens, their log-softmax and its gradient, of each policy."""
    v = shape.decoder.vocab_size
    tokens = min(shape.grpo.group * shape.grpo.length, max(1, shape.grpo.max_logits // v))
    return 3 * _policies(shape) * shape.micro_rows * tokens * v // shape.mesh.tensor * FLOAT


def _sampler_bytes(shape: GRPOShape, params: Params) -> int:
    """The parameters gathered along fsdp, if that axis has several devices: sampling gathers them once."""
    return held_bytes(dataclasses.replace(shape.mesh, fsdp=1), params) if shape.mesh.fsdp > 1 else 0


def _policies(shape: GRPOShape) -> int:
    """The learner, the reference and the perturbed policy, as far as their terms count."""
    return 1 + needs_reference(shape.grpo.algorithm) + (not left_out(shape.grpo.algorithm.gamma))
