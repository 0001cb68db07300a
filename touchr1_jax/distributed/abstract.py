"""A GRPO step of a Qwen-VL policy in shapes alone, compiled without weights or data."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from touchr1_jax.distributed.memory import Compiled, GRPOShape, compiled_bytes
from touchr1_jax.distributed.placement import gather_params, shard_step
from touchr1_jax.models.lora import LoraConfig, init_adapters
from touchr1_jax.models.nf4 import quantised
from touchr1_jax.models.policy import Features, Slots
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.models.qwen.config import QwenConfig
from touchr1_jax.models.qwen.model import abstract_params
from touchr1_jax.models.qwen.policy import qwen_policy
from touchr1_jax.models.stacked import ADAPTERS, layer_by_layer
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.rl.config import at_precision
from touchr1_jax.rl.grpo import FrozenInputs, GRPOState, make_grpo_step, start_state
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.rl.scoring import ScoreFn
from touchr1_jax.types import Params, Target

ATTRIBUTES, NOISE_DRAWS = 4, 64  # of a question's target; of the bank of noise


@dataclasses.dataclass(frozen=True, kw_only=True)
class PromptShape:
    """Tokens of a prompt: S streams of tactile tokens, the view's, and text."""

    streams: int = 4
    stream_tokens: int = 16
    view_tokens: int = 256
    text_tokens: int = 128

    @property
    def tokens(self) -> int:
        """L."""
        return self.streams * self.stream_tokens + self.view_tokens + self.text_tokens

    @property
    def slots(self) -> Slots:
        """The view, then the streams, then the question."""
        touch = self.view_tokens + np.arange(self.streams * self.stream_tokens)
        return Slots(
            touch=touch.reshape(self.streams, self.stream_tokens),
            view=np.arange(self.view_tokens),
            stream_text=np.full(self.tokens, -1),
        )


class AbstractStep(NamedTuple):
    """Arguments of a step, as `jax.ShapeDtypeStruct`, and the policy functions."""

    fns: PolicyFns
    state: GRPOState
    batch: GRPOBatch
    frozen: FrozenInputs
    base: Params | None = None
    """Frozen parameters, an argument too, where the state holds adapters."""


def abstract_grpo(
    config: QwenConfig,
    prompt: PromptShape,
    shape: GRPOShape,
    optimizer: optax.GradientTransformation,
    *,
    lora: LoraConfig | None = None,
    four_bits: bool = False,
) -> AbstractStep:
    """The decoder of a Qwen-VL policy on encoded prompts.

    Args:
      config: towers; the decoder alone is trained.
      prompt: tokens of a prompt.
      shape: sizes of the step; its decoder is the config's.
      optimizer: whose state is counted.
      lora: adapters to train on a decoder that is frozen in bfloat16; `None` trains the decoder.
      four_bits: the kernels of the frozen decoder's layers are in four bits (`models.nf4`).
    """
    s, n, nv = prompt.streams, prompt.stream_tokens, prompt.view_tokens
    p, d, v = shape.grpo.drawn, config.decoder.hidden_size, config.decoder.vocab_size
    kind = jnp.bfloat16 if shape.grpo.bfloat16 else jnp.float32
    of: Any = jax.ShapeDtypeStruct  # shapes stand where the types say arrays, as everywhere under `eval_shape`
    features = Features(
        touch=of((p, s, n, d), kind),
        touch_time=of((p, s, n), jnp.int32),
        stream_mask=of((p, s), bool),
        view=of((p, nv, (1 + config.vision.levels) * d), kind),
        view_mask=of((p,), bool),
    )
    flags, numbers = of((p, ATTRIBUTES), bool), of((p, ATTRIBUTES), jnp.int32)
    target = Target(asked=flags, label=numbers, levels=numbers, ordinal=flags, streams=of((p, s), bool))
    length = prompt.tokens
    batch = GRPOBatch(features=features, ids=of((p, length), jnp.int32), mask=of((p, length), bool), target=target)
    decoder = {"decoder": abstract_params(config)["decoder"]}
    fns = PolicyFns(
        module=qwen_policy(config, TactileViTConfig(sensors=s)),
        slots=prompt.slots,
        banned=np.zeros(v, bool),
        end_ids=(v - 1,),
        pad_id=0,
        cache_dtype=jnp.dtype(kind),
    )
    key = jax.eval_shape(lambda: jax.random.key(0))
    base: Params | None = None
    params: Params = decoder
    if lora is not None:
        base = jax.tree.map(lambda x: of(x.shape, jnp.bfloat16), decoder)
        base = jax.eval_shape(quantised, base) if four_bits else base
        params = {ADAPTERS: jax.eval_shape(lambda k: init_adapters(k, decoder, lora), key)}
        fns = dataclasses.replace(fns, lora=lora)
    state = jax.eval_shape(lambda p, k: start_state(p, optimizer, k, shape.grpo), params, key)
    reference = jax.eval_shape(lambda p: at_precision(shape.grpo, p), params)
    return AbstractStep(
        fns, state, batch, FrozenInputs(reference=reference, noise=of((NOISE_DRAWS, s, n, d), kind)), base
    )


def compile_grpo(
    abstract: AbstractStep,
    shape: GRPOShape,
    score: ScoreFn,
    optimizer: optax.GradientTransformation,
    devices: Sequence[jax.Device] | None = None,
) -> Compiled:
    """Compile the step for the shape's mesh.

    Args:
      abstract: from `abstract_grpo`.
      shape: sizes of the step.
      score: reward of one rollout.
      optimizer: as in `abstract_grpo`.
      devices: those of a topology that is only compiled for; by default as many as needed of this process's.
    """
    found = list(jax.devices() if devices is None else devices)
    mesh = shape.mesh.build(found[: shape.mesh.devices])
    options = layer_by_layer(jnp.bfloat16) if shape.grpo.bfloat16 and found[0].platform == "cpu" else None
    arguments: tuple[Any, ...] = (abstract.state, abstract.batch, abstract.frozen)

    def step(state: GRPOState, batch: GRPOBatch, frozen: FrozenInputs, base: Params | None = None):
        fns = dataclasses.replace(abstract.fns, base=base or {})
        gather = functools.partial(gather_params, mesh)
        return make_grpo_step(fns, score, optimizer, shape.grpo, gather=gather)(state, batch, frozen)

    if abstract.base is not None:
        arguments = (*arguments, abstract.base)
    return compiled_bytes(shard_step(step, mesh, *arguments, compiler_options=options), *arguments)
