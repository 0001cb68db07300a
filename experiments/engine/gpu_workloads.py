"""Workloads that are timed on an accelerator: a matrix product, attention, both encoders, decoding, a GRPO step.

Each comes with the operations that it must do, counted from shapes without anything that a program computes twice; for
the encoders it is XLA's count of the program before compilation.
"""

import dataclasses
import functools
import statistics
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from experiments.core.context import Context
from experiments.engine.job import Job, decoder_config, grpo_config
from experiments.engine.peers import JobSize
from touchr1_jax.distributed.memory import Compiled, GRPOShape, counted_peak, grpo_bytes, reserved_bytes
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.work import grpo_work, model_flops
from touchr1_jax.models.lm import LayerCache, attend_causally
from touchr1_jax.models.qwen.config import QwenVisionConfig
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.vision import QwenVision
from touchr1_jax.models.tactile_vit import TactileViT, TactileViTConfig
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.rl.rollout import SampleConfig, encode_prompts, sample_prompts

BACKWARD = 2
"""Operations of a backward pass over those of its forward pass."""

Flash = Literal["cudnn", "xla"]
"""Implementation of `jax.nn.dot_product_attention`: cuDNN's fused kernel, or XLA, which works anywhere."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GpuConfig:
    """Sizes of the workloads; by default the 7B's attention and vision tower, and a policy of the 1.5B's shape.

    Raises:
      ValueError: pictures of no whole number of windows, frames that do not fill time steps, too few rounds.
    """

    anywhere: bool = False
    """Run without a GPU too, to try the code: the figures then mean nothing for a GPU."""
    rounds: int = 5
    """Timings of each piece, after two that are not timed."""
    side: int = 8192
    """Side of the matrices of the plain product."""
    prompts: int = 4
    """Prompts whose attention is timed."""
    tokens: int = 4480
    """Tokens of each prompt: four streams of 1,024, a view of 256, 128 of text."""
    heads: int = 28
    kv_heads: int = 4
    head_dim: int = 128
    flash: Flash = "cudnn"
    streams: int = 4
    frames: int = 8
    """Frames of each stream."""
    contacts: int = 16
    """Contacts that the tactile encoder reads at once; the vision tower reads one."""
    tactile: TactileViTConfig = TactileViTConfig(sensors=0, width=768, num_layers=12, num_heads=12, mlp_ratio=4)
    tactile_px: int = 112
    vision: QwenVisionConfig = QwenVisionConfig(out_size=3584)
    vision_px: int = 448
    size: JobSize = JobSize(
        prompts=8,
        group=8,
        length=256,
        vocab_size=151_936,
        hidden_size=1536,
        num_layers=28,
        num_heads=12,
        num_kv_heads=2,
        head_dim=128,
        intermediate_size=8960,
    )
    """Size of the policy, and its prompts, rollouts and tokens."""
    prefix: int = 1024
    """Prompt tokens of the policy."""
    micro_prompts: int = 1

    def __post_init__(self) -> None:
        cell = self.vision.cell_px
        if self.vision_px % cell:
            raise ValueError(f"vision_px is {self.vision_px}: must be a multiple of {cell}, a token's pixels; round it")
        if self.frames % self.vision.patch_frames:
            raise ValueError(
                f"frames is {self.frames}: must be a multiple of {self.vision.patch_frames}, the frames of a patch"
            )
        if self.rounds < 1:
            raise ValueError(f"rounds is {self.rounds}: must be at least 1; raise it")


class AttentionInputs(NamedTuple):
    """Queries [P, L, H, d], keys and values [P, L, KV, d] of P prompts, and the gradient of the output."""

    q: Float[Array, "P L H d"]
    k: Float[Array, "P L KV d"]
    v: Float[Array, "P L KV d"]
    g: Float[Array, "P L H d"]


Attention = Callable[[Array, Array, Array], Array]
"""(q, k, v) → [P, L, H, d]."""


def draw_heads(prompts: int, tokens: int, heads: int, kv_heads: int, head_dim: int) -> AttentionInputs:
    """Standard normal numbers in bfloat16."""
    keys = jax.random.split(jax.random.key(0), 4)
    shape = lambda count: (prompts, tokens, count, head_dim)
    counts = (heads, kv_heads, kv_heads, heads)
    return AttentionInputs(
        *(jax.random.normal(key, shape(count), jnp.bfloat16) for key, count in zip(keys, counts, strict=True))
    )


def engine_attention(q: Array, k: Array, v: Array) -> Array:
    """The decoder's attention, in blocks of queries, with its own gradient."""

    def of_prompt(q: Array, k: Array, v: Array) -> Array:
        major = lambda x: jnp.moveaxis(x, 1, 0)
        grouped = q.reshape(q.shape[0], k.shape[1], -1, q.shape[2])
        mixed = attend_causally(grouped, LayerCache(major(k), major(v)), jnp.ones(q.shape[0], bool))
        return mixed.reshape(q.shape)

    return jax.vmap(of_prompt)(q, k, v)


def flash_attention(implementation: Flash) -> Attention:
    """FlashAttention (arXiv 2205.14135) as `jax.nn.dot_product_attention` offers it."""
    return lambda q, k, v: jax.nn.dot_product_attention(q, k, v, is_causal=True, implementation=implementation)


def with_gradient(attention: Attention) -> Callable[[AttentionInputs], tuple[Array, tuple[Array, Array, Array]]]:
    """The output, and the gradients of queries, keys and values."""

    def both(h: AttentionInputs) -> tuple[Array, tuple[Array, Array, Array]]:
        out, back = jax.vjp(attention, h.q, h.k, h.v)
        return out, back(h.g)

    return both


def pairs(prompts: int, tokens: int, heads: int) -> float:
    """Pairs of a query and a key in causal attention."""
    return prompts * heads * tokens * (tokens + 1) / 2


def attention_errors(h: AttentionInputs, variants: dict[str, Attention], context: Context) -> dict[str, float]:
    """Largest difference of the first prompt's output and gradients from float32, over the largest number in each.

    Args:
      h: inputs.
      variants: by name.
      context: shows progress.
    """
    one = jax.tree.map(lambda x: x[:1], h)
    wide = jax.tree.map(lambda x: x.astype(jnp.float32), one)
    with jax.default_matmul_precision("highest"):
        exact = jax.jit(with_gradient(flash_attention("xla")))(wide)
    found = {}
    for name, attend in context.each("comparing attention", variants.items()):
        rounded = jax.jit(with_gradient(attend))(one)
        found[name] = max(jax.tree.leaves(jax.tree.map(_error, exact, rounded)))
    return found


def _error(exact: Array, rounded: Array) -> float:
    a, b = np.asarray(exact, np.float32), np.asarray(rounded, np.float32)
    return float(np.abs(a - b).max() / np.abs(a).max())


class Workload(NamedTuple):
    """A call to time, its operations, the bytes it must read, and the number of units it produces."""

    call: Callable[[], Any]
    flops: float
    read_bytes: float | None
    made: float
    unit: str


class TimedWorkload(NamedTuple):
    """Seconds of a workload in every round, and the workload."""

    seconds: tuple[float, ...]
    workload: Workload

    @property
    def median_s(self) -> float:
        """Median of the rounds."""
        return statistics.median(self.seconds)

    @property
    def flops(self) -> float:
        """Necessary operations a second."""
        return self.workload.flops / self.median_s

    @property
    def read_bytes(self) -> float | None:
        """Necessary bytes read a second, where they are counted."""
        return None if self.workload.read_bytes is None else self.workload.read_bytes / self.median_s

    @property
    def made(self) -> str:
        """Units produced a second, such as `1,200 tokens/s`."""
        return f"{self.workload.made / self.median_s:,.0f} {self.workload.unit}/s"


def product(config: GpuConfig) -> Workload:
    """A product of two square matrices."""
    a = jax.random.normal(jax.random.key(0), (config.side, config.side), jnp.bfloat16)
    multiply = jax.jit(jnp.matmul)
    return Workload(lambda: multiply(a, a), 2 * config.side**3, None, 1, "products")


def attention_workload(config: GpuConfig, heads: AttentionInputs, attend: Attention, *, gradient: bool) -> Workload:
    """Attention of some prompts."""
    compute = jax.jit(with_gradient(attend) if gradient else lambda h: attend(h.q, h.k, h.v))
    flops = 4 * config.head_dim * pairs(config.prompts, config.tokens, config.heads) * (1 + BACKWARD * gradient)
    return Workload(lambda: compute(heads), flops, None, config.prompts * config.tokens, "tokens")


def attention_variants(config: GpuConfig) -> dict[str, Attention]:
    """Both implementations by name."""
    return {"the engine's": engine_attention, f"flash ({config.flash})": flash_attention(config.flash)}


def tactile_encoder(config: GpuConfig) -> Workload:
    """The tactile encoder on streams of some contacts, forward and backward, in float32."""
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
    """Qwen2.5-VL's tower on the streams of a contact, forward and backward; its attention is `jax.nn`'s."""
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
    """Parameters N(0, .02²), scales of one."""

    def draw(path: tuple[Any, ...], x: jax.ShapeDtypeStruct) -> jax.Array:
        if path[-1].key == "scale":
            return jnp.ones(x.shape, kind)
        key = jax.random.fold_in(jax.random.key(2), x.size)
        return 0.02 * jax.random.normal(key, x.shape, kind)

    return jax.tree_util.tree_map_with_path(draw, shapes)


class PolicyWorkloads:
    """Decoding and training steps of one policy."""

    def __init__(self, config: GpuConfig) -> None:
        self._config, self._job = config, Job(config.size, config.prefix, step_config(config))
        decoder = decoder_config(config.size)
        mesh = MeshConfig()
        self._shape = GRPOShape(decoder=decoder, grpo=step_config(config), mesh=mesh, prompt_tokens=config.prefix)

    def decoding(self) -> Workload:
        """Sample completions of encoded prompts, token by token."""
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
        """Sample, score and update, with the reference and the counterfactual pass."""
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
    return grpo_config(config.size, config.micro_prompts, Paper(), bfloat16=True, remat=True)
