"""Workloads that are timed on an accelerator: a matrix product, attention, both encoders, decoding, a GRPO step.

Each workload states its necessary operations, counted from shapes without recomputation; for the encoders, this is
XLA's count for the program before compilation.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from experiments.engine.job import Job, config_of, decoder_config
from experiments.engine.peers import JobSize
from experiments.engine.speed import Workload
from touchr1_jax.distributed.memory import Compiled, GRPOShape, counted_peak, grpo_bytes, reserved_bytes
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.work import grpo_work, model_flops
from touchr1_jax.models.blocked_attention import LayerCache, attend_causally
from touchr1_jax.models.qwen.config import QwenVisionConfig
from touchr1_jax.models.qwen.geometry import Grid
from touchr1_jax.models.qwen.vision import QwenVision
from touchr1_jax.models.tactile_vit import TactileViT, TactileViTConfig
from touchr1_jax.rl.config import Paper
from touchr1_jax.rl.rollout import SampleConfig, encode_prompts, sample_prompts
from touchr1_jax.validation import at_least

BACKWARD = 2  # operations of a backward pass over those of its forward pass

Flash = Literal["cudnn", "xla"]
"""Implementation of `jax.nn.dot_product_attention`: cuDNN's fused kernel, or XLA, which works anywhere."""


POLICY = JobSize(
    prompts=8, group=8, length=256, vocab_size=151_936, hidden_size=1536, num_layers=28, num_heads=12, num_kv_heads=2,
    head_dim=128, intermediate_size=8960,
)  # fmt: skip
"""Qwen2.5's 1.5B."""


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
    size: JobSize = POLICY
    """Size of the policy, and its prompts, rollouts and tokens."""
    prefix: int = 1024
    """Prompt tokens of the policy."""

    def __post_init__(self) -> None:
        cell = self.vision.cell_px
        if self.vision_px % cell:
            raise ValueError(f"vision_px is {self.vision_px}: must be a multiple of {cell}, a token's pixels; round it")
        if self.frames % self.vision.patch_frames:
            raise ValueError(
                f"frames is {self.frames}: must be a multiple of {self.vision.patch_frames}, the frames of a patch"
            )
        at_least(self, 1, "rounds")


class AttentionInputs(NamedTuple):
    """Queries [P, L, H, d], keys and values [P, L, KV, d] of P prompts, and the gradient of the output."""

    q: Float[Array, "P L H d"]
    k: Float[Array, "P L KV d"]
    v: Float[Array, "P L KV d"]
    g: Float[Array, "P L H d"]


Attention = Callable[[Array, Array, Array], Array]  # (q, k, v) → [P, L, H, d]


def draw_heads(config: GpuConfig) -> AttentionInputs:
    """Standard normal numbers in bfloat16."""
    c, keys = config, jax.random.split(jax.random.key(0), 4)
    draw = lambda key, count: jax.random.normal(key, (c.prompts, c.tokens, count, c.head_dim), jnp.bfloat16)
    return AttentionInputs(*map(draw, keys, (c.heads, c.kv_heads, c.kv_heads, c.heads)))


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


def attention_errors(h: AttentionInputs, variants: Mapping[str, Attention]) -> dict[str, float]:
    """Largest difference of the first prompt's output and gradients from float32, over the largest number in each."""
    one = jax.tree.map(lambda x: x[:1], h)
    wide = jax.tree.map(lambda x: x.astype(jnp.float32), one)
    with jax.default_matmul_precision("highest"):
        exact = jax.jit(with_gradient(flash_attention("xla")))(wide)

    def error(exact: Array, rounded: Array) -> float:
        a, b = np.asarray(exact, np.float32), np.asarray(rounded, np.float32)
        return float(np.abs(a - b).max() / np.abs(a).max())

    errors = lambda attend: jax.tree.map(error, exact, jax.jit(with_gradient(attend))(one))
    return {name: max(jax.tree.leaves(errors(attend))) for name, attend in variants.items()}


def attention_workload(config: GpuConfig, heads: AttentionInputs, attend: Attention, *, gradient: bool) -> Workload:
    """Attention of some prompts."""
    compute = jax.jit(with_gradient(attend) if gradient else lambda h: attend(h.q, h.k, h.v))
    pairs = config.prompts * config.heads * config.tokens * (config.tokens + 1) / 2  # of a query and a key
    flops = 4 * config.head_dim * pairs * (1 + BACKWARD * gradient)
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

    def draw(path: tuple[Any, ...], x: jax.ShapeDtypeStruct) -> jax.Array:
        """N(0, .02²), scales of one."""
        if path[-1].key == "scale":
            return jnp.ones(x.shape, kind)
        return 0.02 * jax.random.normal(jax.random.fold_in(jax.random.key(2), x.size), x.shape, kind)

    params = jax.tree_util.tree_map_with_path(draw, shapes)

    def squared(params: Any, *inputs: Any) -> jax.Array:
        out = module.apply({"params": params}, *inputs, *static)
        return jnp.mean(jnp.square(out.astype(jnp.float32)))

    step = jax.jit(jax.value_and_grad(squared))
    work: Any = step.lower(params, *inputs).cost_analysis()
    return Workload(lambda: step(params, *inputs), float(work["flops"]), None, frames, "frames")


class PolicyWorkloads:
    """Decoding and training steps of one policy by the published objective in bfloat16."""

    def __init__(self, config: GpuConfig) -> None:
        size, grpo = config.size, config_of(config.size, Paper(), bfloat16=True, remat=True)
        self._size, self._job = size, Job(size, config.prefix, grpo)
        self._shape = GRPOShape(decoder=decoder_config(size), grpo=grpo, mesh=MeshConfig(), prompt_tokens=config.prefix)
        self._made = size.prompts * size.group * size.length

    def decoding(self) -> Workload:
        """Sample completions of encoded prompts, token by token."""
        fns, size = dataclasses.replace(self._job.fns, cache_dtype=jnp.dtype(jnp.bfloat16)), self._size
        params = jax.tree.map(lambda x: x.astype(jnp.bfloat16), self._job.state.params)
        prompts = jax.jit(functools.partial(encode_prompts, fns))(params, self._job.batch)
        draw = SampleConfig(group=size.group, length=size.length, end_ids=fns.end_ids, pad_id=0, inverse=True)
        decode = jax.jit(lambda p, prompts, key: sample_prompts(fns, p, prompts, key, draw))
        work, key = grpo_work(self._shape)["sampling"], jax.random.key(3)
        return Workload(lambda: decode(params, prompts, key), work.flops, work.read_bytes, self._made, "tokens")

    def step(self) -> Workload:
        """Sample, score and update, with the reference and the counterfactual pass."""
        return Workload(self._job.step, model_flops(self._shape), None, self._made, "tokens")

    def memory(self) -> tuple[Compiled, int]:
        """Bytes that the compiler reserves for a step, and those counted by hand."""
        job = self._job
        counted = grpo_bytes(self._shape, job.state, job.batch, job.frozen)
        return reserved_bytes(job.lowered().compile()), counted_peak(counted)
