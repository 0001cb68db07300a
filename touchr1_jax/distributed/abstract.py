"""A GRPO step of a Qwen2.5-VL policy in shapes alone, to be compiled without weights or data."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from touchr1_jax.distributed.memory import Compiled, GRPOShape, compiled_bytes
from touchr1_jax.distributed.placement import shard_step
from touchr1_jax.models.agent import Agent
from touchr1_jax.models.policy import Features, Slots
from touchr1_jax.models.qwen.config import QwenConfig
from touchr1_jax.models.qwen.model import abstract_params
from touchr1_jax.models.qwen.policy import qwen_policy
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.rl.grpo import Fixed, GRPOState, make_grpo_step, start_state
from touchr1_jax.rl.objective import GRPOBatch
from touchr1_jax.rl.scoring import ScoreFn
from touchr1_jax.types import Target


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


class AbstractStep(NamedTuple):
    """Arguments of a step, as `jax.ShapeDtypeStruct`, and its agent."""

    agent: Agent
    state: GRPOState
    batch: GRPOBatch
    fixed: Fixed


def abstract_grpo(
    config: QwenConfig,
    prompt: PromptShape,
    shape: GRPOShape,
    optimizer: optax.GradientTransformation,
    *,
    attributes: int = 4,
    draws: int = 64,
) -> AbstractStep:
    """The decoder of a Qwen2.5-VL policy on encoded prompts.

    Args:
      config: towers; the decoder alone is trained.
      prompt: what stands in a prompt.
      shape: sizes of the step; its decoder is the config's.
      optimizer: whose state is counted.
      attributes: of a question's target.
      draws: size of the bank of noise.
    """
    s, n, nv = prompt.streams, prompt.stream_tokens, prompt.view_tokens
    p, d, v = shape.grpo.drawn, config.decoder.hidden_size, config.decoder.vocab_size
    kind = jnp.bfloat16 if shape.grpo.bfloat16 else jnp.float32
    of: Any = jax.ShapeDtypeStruct  # shapes stand where the types say arrays, as everywhere under `eval_shape`
    features = Features(
        touch=of((p, s, n, d), kind),
        touch_time=of((p, s, n), jnp.int32),
        stream_mask=of((p, s), bool),
        view=of((p, nv, d), kind),
        view_mask=of((p,), bool),
    )
    flags, numbers = of((p, attributes), bool), of((p, attributes), jnp.int32)
    target = Target(asked=flags, label=numbers, levels=numbers, ordinal=flags, streams=of((p, s), bool))
    length = prompt.tokens
    batch = GRPOBatch(features=features, ids=of((p, length), jnp.int32), mask=of((p, length), bool), target=target)
    decoder = {"decoder": abstract_params(config)["decoder"]}
    key = jax.eval_shape(lambda: jax.random.key(0))
    state = jax.eval_shape(lambda params, k: start_state(params, optimizer, k, shape.grpo), decoder, key)
    agent = Agent(
        policy=qwen_policy(config, TactileViTConfig(sensors=s)),
        slots=_slots(prompt),
        banned=np.zeros(v, bool),
        end_ids=(v - 1,),
        pad_id=0,
        cache_dtype=jnp.dtype(kind),
    )
    return AbstractStep(agent, state, batch, Fixed(reference=decoder, noise=of((draws, s, n, d), kind)))


def compile_grpo(
    abstract: AbstractStep, shape: GRPOShape, score: ScoreFn, optimizer: optax.GradientTransformation
) -> Compiled:
    """Compile the step for the shape's mesh, of as many devices as this process sees."""
    mesh = shape.mesh.build(jax.devices()[: shape.mesh.devices])
    step = make_grpo_step(abstract.agent, score, optimizer, shape.grpo)
    arguments = (abstract.state, abstract.batch, abstract.fixed)
    return compiled_bytes(shard_step(step, mesh, *arguments), *arguments)


def _slots(prompt: PromptShape) -> Slots:
    """The view, then the streams, then the question."""
    touch = prompt.view_tokens + np.arange(prompt.streams * prompt.stream_tokens)
    return Slots(
        touch=touch.reshape(prompt.streams, prompt.stream_tokens),
        view=np.arange(prompt.view_tokens),
        stream_text=np.full(prompt.tokens, -1),
    )
