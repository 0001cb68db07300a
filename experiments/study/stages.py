"""The stages that experiments are made of before GRPO: evidence, SFT, encoding.

Each is a function of its configuration and inputs; what it leaves behind lies in the run's directory, so that a stopped
run goes on from its last checkpoint.
"""

import dataclasses
import functools
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.study.assembly import Assembly
from experiments.study.dataset import Dataset
from experiments.study.feeds import AnswerFeed, touch_batch
from sensors_io.augment import AugmentConfig
from sensors_io.schema import ATTRIBUTES, LEVELS
from touchr1_jax.models.chunked_logits import MAX_LOGITS
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.lora import Adapters, LoraConfig, Trainable, adapt, init_adapters, kept_share, merge
from touchr1_jax.models.policy import Features
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.training.evidence import ProbeConfig, cross_fit, probe_log_probs, stream_features
from touchr1_jax.training.loop import LoopConfig
from touchr1_jax.training.optimizer import OptimizerConfig, make_optimizer
from touchr1_jax.training.packing import Packing
from touchr1_jax.training.sft import SFTBatch, SFTState, make_sft_step
from touchr1_jax.types import Params
from touchr1_jax.validation import above, at_least, within

KEPT = "kept"
"""Stages whose results say how much of a stage's adapters is in the merged weights (see `lora.kept_share`)."""

ENCODE_BATCH = 8
"""Contacts that are encoded at once: eight stay in cache, sixteen take twice the time each."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SFTConfig:
    """Stage 2; the learning rate is the paper's 1e-5 times `lr_scale`."""

    steps: int = 450
    batch_size: int = 16
    questions: int = 2
    """Questions per contact and step; the contact is encoded once for all of them."""
    save_every: int = 100
    micro_contacts: int = 2
    """Contacts of a micro-batch of the gradient; two stay in cache, which on a CPU is a third faster than sixteen."""
    max_logits: int = MAX_LOGITS
    """Logits that may exist at once; more tokens than that are scored in blocks."""
    pack: int = 0
    """Tokens of a row that several questions with their answers share; 0 pads each to the longest instead."""
    lora_rank: int = 0
    """Rank of adapters that are trained in the place of the decoder's weights; 0 trains the weights."""
    lora_alpha: float = 32.0
    """The adapters' change is multiplied by lora_alpha / lora_rank."""
    remat: bool = False
    """Keep only matrix products of the decoder for the backward pass and compute the rest again: less memory."""
    curriculum: float = 0.0
    """Share of the steps within which the share of questions that all sensors feel falls from 1 to a half."""
    optimizer: OptimizerConfig = OptimizerConfig(learning_rate=1e-5, lr_scale=100.0)
    augment: AugmentConfig = AugmentConfig()
    """How what is felt is changed at random; by default not at all."""

    def __post_init__(self) -> None:
        at_least(self, 0, "steps", "pack", "lora_rank")
        at_least(self, 1, "batch_size", "questions", "save_every", "micro_contacts", "max_logits")
        above(self, 0, "lora_alpha")
        within(self, 0, 1, "curriculum")
        if self.batch_size % self.micro_contacts:
            raise ValueError(
                f"micro_contacts is {self.micro_contacts}: must divide batch_size = {self.batch_size}; change either"
            )

    @property
    def lora(self) -> LoraConfig | None:
        """Adapters of the decoder, or none."""
        return LoraConfig(rank=self.lora_rank, alpha=self.lora_alpha) if self.lora_rank else None

    def packing(self, devices: int) -> Packing | None:
        """Rows that the contacts of a micro-batch share on each of the devices; `None` pads.

        Raises:
          ValueError: a micro-batch that the devices cannot share.
        """
        if not self.pack:
            return None
        if self.micro_contacts % devices:
            raise ValueError(
                f"micro_contacts is {self.micro_contacts}: must be a multiple of the {devices} devices that share a "
                "micro-batch, for none reads the rows of another; raise it, or leave pack at 0"
            )
        micro_batches = self.batch_size // self.micro_contacts
        return Packing(width=self.pack, contacts=self.micro_contacts // devices, micro_batches=micro_batches)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Probed:
    """Fixed features of every contact's streams, float32 [contact, S, D], and of its force alone, [contact, D'].

    `present` [contact, S] says which streams were recorded.
    """

    streams: np.ndarray
    present: np.ndarray
    force: np.ndarray


def probe_features(data: Dataset, context: Context) -> Probed:
    """Summarise all contacts once; every seed shares it, and every process does its part."""
    found = context.processes.split_work(np.arange(len(data.store)), lambda rows: _features(data, rows, context))
    return Probed(**found)


def _features(data: Dataset, rows: np.ndarray, context: Context) -> dict[str, np.ndarray]:
    clips = data.batches(rows, batch_size=32, seed=0, shuffle=False, repeat=False)
    streams, present, force = [], [], []
    with context.progress("reading touch", len(rows)) as advance:
        for clip in clips:
            streams.append(np.asarray(stream_features(clip["frames"], clip["force_n"])))
            present.append(clip["stream_mask"])
            force.append(clip["force_n"].reshape(len(clip["force_n"]), -1))
            advance(len(clip["contact"]))
    parts = {"streams": streams, "present": present, "force": force}
    return {name: np.concatenate(part) for name, part in parts.items()}


def gather_evidence(
    data: Dataset, probed: Probed, config: ProbeConfig, context: Context
) -> Float[np.ndarray, "contact S A K"]:
    """Out-of-fold log-probabilities of each sensor's probe for the SFT contacts.

    Levels that an attribute lacks have −inf.  A stream that was not recorded says nothing, 0 for every level, and so
    does every stream about an attribute that too few objects are annotated for.
    """
    rows = data.parts["sft"]
    out = np.full((len(data.store), len(data.clip.sensors), len(ATTRIBUTES), max(LEVELS.values())), -np.inf, np.float32)
    every = itertools.product(enumerate(ATTRIBUTES), range(len(data.clip.sensors)))
    for (a, name), s in context.each("evidence", every):
        out[:, s, a, : LEVELS[name]] = 0.0
        felt = rows[probed.present[rows, s] & (data.label[rows, a] >= 0)]
        label, groups = data.label[felt, a], data.object_ids[felt]
        if len(np.unique(groups)) >= config.folds:
            out[felt, s, a, : LEVELS[name]] = cross_fit(probed.streams[felt, s], label, groups, LEVELS[name], config)
    return out


def run_sft(
    assembly: Assembly,
    data: Dataset,
    evidence: np.ndarray,
    config: SFTConfig,
    context: Context,
    *,
    seed: int,
    stage: str,
    blind: bool = False,
    tactile: Params | None = None,
) -> Params:
    """Train a policy on verified answers, from scratch or from a tactile encoder; a blind one never feels anything.

    Adapters are merged into the decoder's weights in the end, so that what follows need not know of them.

    Raises:
      SizeError: towers that stand still, and no adapters.
    """
    if assembly.frozen and config.lora is None:
        raise SizeError(
            f"sft.lora_rank is 0: must be at least 1 where {' and '.join(assembly.frozen)} stand still; raise it"
        )
    feed = AnswerFeed(
        assembly,
        data,
        evidence,
        batch_size=config.batch_size,
        questions=config.questions,
        seed=seed,
        blind=blind,
        augment=config.augment,
        easy_steps=round(config.curriculum * config.steps),
        packing=config.packing(math.prod(context.devices.shape[:2])),
        own=context.devices.local_rows(config.batch_size),
    )
    optimizer, step = sft_program(assembly.fns, config, blind)
    params = untrained(assembly, data, seed)
    if tactile is not None:
        params = {**params, "tactile": jax.tree.map(jnp.array, tactile)}  # a copy: the step gives its buffers away
    still = () if config.lora is None else {*assembly.frozen, *config.lora.towers}
    frozen = {name: tree for name, tree in params.items() if name in still}
    others = {name: tree for name, tree in params.items() if name not in still}
    trained = params if config.lora is None else fresh_adapters(frozen, others, config.lora, seed)
    state = SFTState(params=trained, opt_state=optimizer.init(trained), step=jnp.zeros((), jnp.int32))
    loop = LoopConfig(steps=config.steps, save_every=config.save_every)
    step, state, batches = context.devices.shard(step, state, feed, config.batch_size, *([frozen] if frozen else []))
    found = context.devices.gather(run_loop(step, state, batches, loop, context, stage).params)
    if config.lora is None:
        return found
    return {**merge_noted(frozen, found.adapters, config.lora, context, stage), **found.towers}


def untrained(assembly: Assembly, data: Dataset, seed: int) -> Params:
    """The parameters that SFT of a seed starts from."""
    clips = data.batches(data.parts["sft"][:1], batch_size=1, seed=0, repeat=False)
    return assembly.init(seed, touch_batch(next(iter(clips))))


def fresh_adapters(frozen: Params, towers: Params, lora: LoraConfig, seed: int) -> Trainable:
    """What is trained where some towers stand still: their adapters, and the other towers."""
    adapters = init_adapters(jax.random.fold_in(jax.random.key(seed), 1), frozen, lora)
    return Trainable(adapters=adapters, towers=towers)


def merge_noted(base: Params, adapters: Adapters, lora: LoraConfig, context: Context, stage: str) -> Params:
    """The base with a stage's adapters in it; what its type kept of them is noted as the result of `KEPT`/stage."""
    merged = merge(base, adapters, lora)
    context.save_stage(f"{KEPT}/{stage}", kept_share(base, merged, adapters, lora))
    return merged


@functools.cache
def sft_program(fns: PolicyFns, config: SFTConfig, blind: bool) -> tuple[optax.GradientTransformation, Any]:
    """Optimizer and compiled step, made once for all seeds; with adapters, (state, batch, frozen towers) → …"""
    optimizer = make_optimizer(config.optimizer, config.steps)
    fns = dataclasses.replace(fns, module=fns.module.clone(remat=True)) if config.remat else fns
    make = functools.partial(
        make_sft_step,
        optimizer=optimizer,
        blind=blind,
        max_logits=config.max_logits,
        micro_contacts=config.micro_contacts,
    )
    if config.lora is None:
        return optimizer, make(fns)
    lora = config.lora

    def step(state: SFTState, batch: SFTBatch, frozen: Params) -> tuple[SFTState, dict[str, Array]]:
        return make(adapt(fns, frozen, lora))(state, batch)

    return optimizer, jax.jit(step, donate_argnums=0)


def encode_contacts(
    assembly: Assembly, params: Params, data: Dataset, rows: np.ndarray, context: Context, *, blind: bool = False
) -> Features:
    """Encode contacts once, each process its part, and keep the features on the host, in the order of `rows`."""
    return context.processes.split_work(rows, lambda own: _encoded(assembly, params, data, own, context, blind=blind))


def _encoded(
    assembly: Assembly, params: Params, data: Dataset, rows: np.ndarray, context: Context, *, blind: bool
) -> Features:
    clips = data.batches(rows, batch_size=ENCODE_BATCH, seed=0, shuffle=False, repeat=False, felt=not blind)
    encode = encode_program(assembly.fns, blind)
    parts = []
    with context.progress("encoding", len(rows)) as advance:
        for clip in clips:
            parts.append(jax.device_get(encode(params, touch_batch(clip))))
            advance(len(clip["contact"]))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


@functools.cache
def encode_program(fns: PolicyFns, blind: bool) -> Any:
    """Compiled encoder, made once."""
    return jax.jit(lambda p, b: fns.encode(p, b, blind=blind))


def noise_bank(
    fns: PolicyFns, params: Params, data: Dataset, *, seed: int, draws: int = 64, probe: int = 64
) -> Float[Array, "K S N D"]:
    """Encoded noise streams: pixels and forces drawn from N(μ, σ²) at each sensor's statistics, per channel.

    The statistics are those of the recorded frames of `probe` SFT contacts; frame times are those of the same contacts,
    so that nothing but the touch itself is out of the ordinary.
    """
    clips = data.batches(data.parts["sft"], batch_size=probe, seed=seed, repeat=False)
    clip = next(iter(clips))
    seen = np.where(clip["frame_mask"], 1.0, np.nan).astype(np.float32)
    pixels = _statistics(clip["frames"].astype(np.float32) * seen[..., None, None, None], (0, 2, 3, 4))
    force = _statistics(clip["force_n"] * seen[..., None], (0, 2))
    rows = np.arange(draws) % len(clip["frame_index"])
    keys = jax.random.split(jax.random.key(seed), draws)
    times = jnp.asarray(clip["frame_index"][rows]), jnp.asarray(clip["frame_mask"][rows])
    return noise_program(fns, clip["frames"].shape[3:5])(params, pixels, force, (keys, *times))


@functools.cache
def noise_program(fns: PolicyFns, size: tuple[int, int]) -> Any:
    """Compiled encoder of noise, (params, pixel statistics, force statistics, (key, index, mask)) → features."""

    def draw(params: Params, pixel: Any, force: Any, x: tuple[Array, Array, Array]) -> Float[Array, "S N D"]:
        key, index, mask = x
        pixel_key, force_key = jax.random.split(key)
        (pixel_mean, pixel_std), (force_mean, force_std), shape = pixel, force, index.shape
        noise = jax.random.normal(pixel_key, (*shape, *size, 3)) * pixel_std[:, None, None, None]
        frames = jnp.clip(noise + pixel_mean[:, None, None, None], 0, 255)
        push = jax.random.normal(force_key, (*shape, 3)) * force_std[:, None] + force_mean[:, None]
        return fns.encode_streams(params, frames, push, index, mask, jnp.arange(shape[0]))

    return jax.jit(lambda params, pixel, force, x: jax.lax.map(functools.partial(draw, params, pixel, force), x))


def _statistics(x: np.ndarray, axes: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of what is not NaN; 0 where nothing is."""
    known = ~np.isnan(x)
    n = np.maximum(known.sum(axes), 1)
    mean = np.where(known, x, 0.0).sum(axes) / n
    shape = [1 if i in axes else size for i, size in enumerate(x.shape)]
    square = np.where(known, (x - mean.reshape(shape)) ** 2, 0.0).sum(axes)
    return mean.astype(np.float32), np.sqrt(square / n).astype(np.float32)


def force_only(data: Dataset, probed: Probed, rows: np.ndarray, config: ProbeConfig) -> np.ndarray:
    """Levels that a probe on the measured forces alone gives contacts, int [len(rows), A]: what the ramp gives away."""
    train = np.isin(np.arange(len(data.store)), np.concatenate([data.parts["sft"], data.parts["grpo"]]))
    columns = []
    for a, name in enumerate(ATTRIBUTES):
        weight = (train & (data.label[:, a] >= 0))[None]
        if not weight.any():  # nobody annotated it, so nobody is asked about it
            columns.append(np.zeros(len(rows), int))
            continue
        columns.append(
            probe_log_probs(probed.force, data.label[:, a], weight, LEVELS[name], config)[0, rows].argmax(-1)
        )
    return np.stack(columns, 1)
