"""One GRPO step as one program: prefill, group rollouts, rewards, advantages, divergences, update.

    J = J_GRPO(R) + γ G_tg
    J_GRPO = mean_i 1/|o_i| Σ_t [ min(ρ_t A_i, clip(ρ_t) A_i) − β KL_t(π ‖ π_ref) ]
    G_tg   = mean_i 1/|o_i| Σ_t KL(π(· | q, T, o_<t) ‖ π(· | q, T_mask, o_<t))

Touch-R1 (arXiv 2605.27154), eq. 5.  T_mask is the touch with one stream, chosen uniformly among those present, replaced
by noise at the data's statistics.  Nothing leaves the device between the first line and the metrics.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.agent import Agent
from touchr1_jax.models.policy import Features
from touchr1_jax.rl.advantages import degenerate, group_advantage
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.rl.objective import Experience, GRPOBatch, objective_gradient
from touchr1_jax.rl.rollout import SampleConfig, sample
from touchr1_jax.types import Params, Parsed, Rollout, Target

ScoreFn = Callable[[Int[Array, "T"], Target], tuple[Float[Array, ""], dict[str, Array], Parsed]]
"""(tokens, target) → (total reward, its named terms, parsed completion), for one rollout."""


@struct.dataclass
class GRPOState:
    """What a step changes; `key` is the run's root key and the step is folded into it."""

    params: Params
    opt_state: optax.OptState
    step: Int[Array, ""]
    key: Array


class Fixed(NamedTuple):
    """What a run never changes: the reference policy and encoded noise, K draws of every sensor's stream.

    With the encoder frozen, the encoding of a noise stream does not depend on the prompt, so a bank of K draws stands
    for fresh noise at every step.
    """

    reference: Params
    noise: Float[Array, "K S N D"]


def make_grpo_step(
    agent: Agent, score: ScoreFn, optimizer: optax.GradientTransformation, config: GRPOConfig
) -> Callable[[GRPOState, GRPOBatch, Fixed], tuple[GRPOState, dict[str, Array]]]:
    """Build the jitted step, (state, batch, fixed) → (state, metrics); the state's buffers are donated."""
    draw = SampleConfig(group=config.group, length=config.length, end_ids=agent.end_ids, pad_id=agent.pad_id)

    def step(state: GRPOState, batch: GRPOBatch, fixed: Fixed) -> tuple[GRPOState, dict[str, Array]]:
        key = jax.random.fold_in(state.key, state.step)
        sample_key, mask_key = jax.random.split(key)
        rollout = sample_group(agent, state.params, batch, sample_key, draw)
        reward, terms, parsed = jax.vmap(jax.vmap(score, in_axes=(0, None)))(rollout.tokens, batch.target)
        flat = degenerate(reward)
        learn = Experience(
            batch=batch,
            masked_touch=mask_one_stream(batch.features, fixed.noise, mask_key),
            rollout=rollout,
            advantage=group_advantage(reward, epsilon=config.epsilon, normalise=config.normalise),
            weight=prompt_weights(~flat) if config.drop_degenerate else jnp.full(flat.shape, 1 / config.prompts),
        )
        grads, parts = objective_gradient(agent, config, state.params, fixed.reference, learn)
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        metrics = parts | {f"reward_{name}": jnp.mean(value) for name, value in terms.items()}
        metrics |= rollout_metrics(rollout, reward, flat, parsed, batch.target)
        metrics |= {"grad_norm": optax.tree.norm(grads)}
        return GRPOState(params=params, opt_state=opt_state, step=state.step + 1, key=state.key), metrics

    return jax.jit(step, donate_argnums=0)


def sample_group(agent: Agent, params: Params, batch: GRPOBatch, key: Array, draw: SampleConfig) -> Rollout:
    """Prefill each prompt once and draw its completions."""
    prefill = jax.vmap(agent.prefill, in_axes=(None, 0, 0, 0))
    first, prefix = prefill(params, batch.features, batch.ids, batch.mask)
    decode = lambda token, t, past, caches: agent.decode(params, token, t, past, caches)
    return sample(decode, first, prefix, agent.empty_cache(draw.length), key, draw)


def mask_one_stream(features: Features, noise: Float[Array, "K S N D"], key: Array) -> Float[Array, "P S N D"]:
    """T_mask: in each prompt one present stream, uniformly chosen, becomes an encoded noise draw of its sensor."""
    p = features.stream_mask.shape[0]
    stream_key, draw_key = jax.random.split(key)
    stream = jax.random.categorical(stream_key, jnp.where(features.stream_mask, 0.0, -jnp.inf))
    draw = jax.random.randint(draw_key, (p,), 0, noise.shape[0])
    replaced = features.touch.at[jnp.arange(p), stream].set(noise[draw, stream])
    any_stream = jnp.any(features.stream_mask, -1)[:, None, None, None]
    return jnp.where(any_stream, replaced, features.touch)


def prompt_weights(counts: Bool[Array, "P"]) -> Float[Array, "P"]:
    """Weight of each prompt in a mean over the prompts that count; all 0 when none does."""
    return counts / jnp.maximum(jnp.sum(counts), 1)


def rollout_metrics(
    rollout: Rollout, reward: Float[Array, "P G"], flat: Bool[Array, "P"], parsed: Parsed, target: Target
) -> dict[str, Array]:
    """What a researcher watches: reward and its spread, accuracy, parse rate, middle answers, lengths."""
    asked = target.asked[:, None]
    label, middle = target.label[:, None], (target.levels[:, None] - 1) // 2
    ordinal = asked & target.ordinal[:, None]
    right = (parsed.conclude == label) & (label >= 0)
    return {
        "reward": jnp.mean(reward),
        "reward_std": jnp.mean(jnp.std(reward, -1)),
        "degenerate_share": jnp.mean(flat),
        "accuracy": masked.mean(right, jnp.broadcast_to(asked, right.shape)),
        "middle_rate": masked.mean(parsed.conclude == middle, jnp.broadcast_to(ordinal, right.shape)),
        "parse_rate": jnp.mean(parsed.formatted & jnp.all((parsed.conclude >= 0) | ~asked, -1)),
        "truncated_share": jnp.mean(parsed.truncated),
        "length": jnp.mean(jnp.sum(rollout.mask, -1)),
    }
