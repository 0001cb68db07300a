"""What is timed: a matrix product, attention, both encoders, decoding, a GRPO step; each with the work that it must do.

Work is counted from shapes, without what a program computes twice; of the encoders it is XLA's count of the program
before it is compiled.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from experiments.engine.attention import (
    Attention,
    AttentionInputs,
    engine_attention,
    flash_attention,
    pairs,
    with_gradient,
)
from experiments.engine.gpu_config import GpuConfig
from experiments.engine.job import Job, decoder_config
from touchr1_jax.distributed.memory import Compiled, GRPOShape, counted_peak, grpo_bytes, reserved_bytes
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.work import grpo_work, model_flops
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.vision import QwenVision
from touchr1_jax.models.tactile_vit import TactileViT
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.rl.rollout import SampleConfig, encode_prompts, sample_prompts

BACKWARD = 2
"""Operations of a backward pass over those of its forward pass."""


class Workload(NamedTuple):
    """Something to time: a call whose result can be waited for, its operations, bytes it must read, what it makes."""

    call: Callable[[], Any]
    flops: float
    read_bytes: float | None
    made: float
    unit: str


def product(config: GpuConfig) -> Workload:
    """A product of two square matrices."""
    a = jax.random.normal(jax.random.key(0), (config.side, config.side), jnp.bfloat16)
    multiply = jax.jit(jnp.matmul)
    return Workload(lambda: multiply(a, a), 2 * config.side**3, None, 1, "products")


def attention(config: GpuConfig, heads: AttentionInputs, way: Attention, *, gradient: bool) -> Workload:
    """Attention of some prompts."""
    compute = jax.jit(with_gradient(way) if gradient else lambda h: way(h.q, h.k, h.v))
    flops = 4 * config.head_dim * pairs(config.prompts, config.tokens, config.heads) * (1 + BACKWARD * gradient)
    return Workload(lambda: compute(heads), flops, None, config.prompts * config.tokens, "tokens")


def ways(config: GpuConfig) -> dict[str, Attention]:
    """Both, by name."""
    return {"the engine's": engine_attention, f"flash ({config.flash})": flash_attention(config.flash)}


def tactile_encoder(config: GpuConfig) -> Workload:
    """The encoder that this codebase trains, on streams of some contacts, forward and backward; it has no bfloat16."""
    c = dataclasses.replace(config.tactile, sensors=config.streams)
    streams = config.contacts * config.streams
    shape = (streams, config.frames)
    inputs = (
        jnp.asarray(np.random.default_rng(0).integers(0, 256, (*shape, config.tactile_px, config.tactile_px, 3)), "u1"),
        jnp.ones((*shape, 3)),
        jnp.tile(jnp.arange(config.frames), (streams, 1)),
        jnp.ones(shape, bool),
        jnp.arange(streams) % config.streams,
    )
    return _encoder(TactileViT(c), streams * config.frames, *inputs, kind=jnp.float32)


def vision_tower(config: GpuConfig) -> Workload:
    """Qwen2.5-VL's tower on the streams of a contact, whose attention is `jax.nn`'s, forward and backward."""
    v = config.vision
    side = config.vision_px // v.patch_px
    grids = (Grid(config.frames // v.patch_frames, side, side),) * config.streams
    patches = jax.random.normal(jax.random.key(1), (sum(g.patches for g in grids), v.patch_size), jnp.bfloat16)
    return _encoder(QwenVision(v), config.streams * config.frames, patches, static=(grids,), kind=jnp.bfloat16)


def _encoder(module: Any, frames: int, *inputs: Any, static: tuple[Any, ...] = (), kind: DTypeLike) -> Workload:
    shapes = jax.eval_shape(lambda key: module.init(key, *inputs, *static), jax.random.key(0))["params"]
    params = drawn(shapes, kind)

    def squared(params: Any, *inputs: Any) -> jax.Array:
        out = module.apply({"params": params}, *inputs, *static)
        return jnp.mean(jnp.square(out.astype(jnp.float32)))

    step = jax.jit(jax.value_and_grad(squared))
    work: Any = step.lower(params, *inputs).cost_analysis()
    return Workload(lambda: step(params, *inputs), float(work["flops"]), None, frames, "frames")


def drawn(shapes: Any, kind: DTypeLike) -> Any:
    """Parameters of a type, N(0, .02²), scales of one."""

    def draw(path: tuple[Any, ...], x: jax.ShapeDtypeStruct) -> jax.Array:
        if path[-1].key == "scale":
            return jnp.ones(x.shape, kind)
        key = jax.random.fold_in(jax.random.key(2), x.size)
        return 0.02 * jax.random.normal(key, x.shape, kind)

    return jax.tree_util.tree_map_with_path(draw, shapes)


class PolicyWorkloads:
    """The policy that decodes and learns, made once for both."""

    def __init__(self, config: GpuConfig) -> None:
        self._config, self._job = config, Job(config.size, config.prefix, step_config(config))
        decoder = decoder_config(config.size)
        mesh = MeshConfig()
        self._shape = GRPOShape(decoder=decoder, grpo=step_config(config), mesh=mesh, prompt_tokens=config.prefix)

    def decoding(self) -> Workload:
        """Completions of encoded prompts, token by token."""
        size = self._config.size
        fns = dataclasses.replace(self._job.fns, cache_dtype=jnp.dtype(jnp.bfloat16))
        params = jax.tree.map(lambda x: x.astype(jnp.bfloat16), self._job.state.params)
        prompts = jax.jit(functools.partial(encode_prompts, fns))(params, self._job.batch)
        draw = SampleConfig(group=size.group, length=size.length, end_ids=fns.end_ids, pad_id=0, inverse=True)
        decode = jax.jit(lambda p, prompts, key: sample_prompts(fns, p, prompts, key, draw))
        work, key = grpo_work(self._shape)["sampling"], jax.random.key(3)
        made = size.prompts * size.group * size.length
        return Workload(lambda: decode(params, prompts, key), work.flops, work.read_bytes, made, "tokens")

    def step(self) -> Workload:
        """Sampling, scoring, update, with the reference and the counterfactual pass."""
        size = self._config.size
        made = size.prompts * size.group * size.length
        return Workload(self._job.step, model_flops(self._shape), None, made, "tokens")

    def memory(self) -> tuple[Compiled, int]:
        """Bytes that the compiler reserves for a step, and those counted by hand."""
        state, batch, frozen = self._job.state, self._job.batch, self._job.frozen
        return reserved_bytes(self._job.lowered().compile()), counted_peak(
            grpo_bytes(self._shape, state, batch, frozen)
        )


def step_config(config: GpuConfig) -> GRPOConfig:
    """The published objective in bfloat16."""
    size = config.size
    return GRPOConfig(
        prompts=size.prompts,
        group=size.group,
        length=size.length,
        micro_prompts=config.micro_prompts,
        algorithm=Paper(),
        inverse_draws=True,
        bfloat16=True,
        remat=True,
    )
