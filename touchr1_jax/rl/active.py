"""GRPO on whole trajectories of touches and an answer: the step of `grpo` with other rollouts.

    R(τ) = answer − price × seconds − price × harm                                         (`touch_reward`)

Advantages, loss, update and algorithms are those of `grpo`.  Every token that the policy wrote, of touches and answer,
gets the advantage of its trajectory; observations are not tokens.  The grounding term replaces one observation of each
trajectory by noise.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.active_policy import ActiveFns, Explored
from touchr1_jax.rl.config import GRPOConfig, TactileUse, at_precision
from touchr1_jax.rl.enumerated import level_rewards
from touchr1_jax.rl.environment import Environment
from touchr1_jax.rl.gradient import Experience
from touchr1_jax.rl.grpo import Group, GRPOEngine, GRPOState, compile_step
from touchr1_jax.rl.metrics import advantage_metrics
from touchr1_jax.rl.rollout import SampleConfig
from touchr1_jax.rl.scoring import left_out_groups
from touchr1_jax.rl.touch_reward import Prices, Spent, TouchReward, priced_answer
from touchr1_jax.rl.trajectory import ActiveBatch, Trajectories, sample_trajectories
from touchr1_jax.types import Params


class ActiveInputs(NamedTuple):
    """Inputs of a step that a run never changes."""

    reference: Params
    environment: Environment
    prices: Prices


def make_active_step(
    fns: ActiveFns,
    optimizer: optax.GradientTransformation,
    config: GRPOConfig,
    budget: int,
    reward: TouchReward = priced_answer,
) -> Callable[[GRPOState, ActiveBatch, ActiveInputs], tuple[GRPOState, dict[str, Array]]]:
    """Build the jitted step, (state, batch, inputs) → (state, metrics); the state's buffers are donated.

    Args:
      fns: the policy, constrained where `config.algorithm.constrained` is set.
      optimizer: applied to the gradient of −J.
      config: sizes and algorithm; `length` is that of the turns of a trajectory.
      budget: B, most actions of a trajectory.
      reward: terms of the reward of one trajectory.

    Raises:
      ValueError: a budget below 1, or an option that trajectories do not have.
    """
    check_active_config(fns, config, budget)
    fns = dataclasses.replace(fns, cache_dtype=jnp.dtype(jnp.bfloat16)) if config.bfloat16 else fns
    engine = ActiveEngine(fns, reward, optimizer, config, None, lambda params: params, fns.levels, False, budget)
    return compile_step(engine, config)


def check_active_config(fns: ActiveFns, config: GRPOConfig, budget: int) -> None:
    """Reject settings that trajectories cannot have.

    Raises:
      ValueError: see `make_active_step`.
    """
    algorithm, turn = config.algorithm, fns.turns.length
    if budget < 1:
        raise ValueError(f"budget is {budget}: must be at least 1 touch; raise it")
    if config.length != (budget + 1) * turn:
        raise ValueError(
            f"length is {config.length}: must be {(budget + 1) * turn}, {budget + 1} turns of {turn} tokens; set it so"
        )
    if algorithm.constrained != fns.constrained:
        raise ValueError(
            f"constrained is {algorithm.constrained}, but the policy's functions are constrained={fns.constrained}; "
            "choose the functions that fit"
        )
    if algorithm.enumerated is not None and fns.levels is None:
        raise ValueError(
            f"enumerated is {algorithm.enumerated}, but the tokenizer splits a level: each must be one token; leave it "
            "out"
        )
    if algorithm.tactile_use is not TactileUse.OFF:
        raise ValueError(
            f"tactile_use is {algorithm.tactile_use}: must be OFF for trajectories, whose touch has a price instead"
        )
    if algorithm.stable_rewards:
        raise ValueError(
            "stable_rewards is True: must be False for trajectories, whose reward is one function; leave it out"
        )
    if algorithm.segment_credit or config.buckets:
        raise ValueError("segment_credit and buckets are for single answers: leave both out for trajectories")


def make_explore(
    fns: ActiveFns, budget: int, *, group: int = 1, greedy: bool = True, temperature: float = 1.0
) -> Callable[[Params, Environment, ActiveBatch, Array], Trajectories]:
    """Build the jitted (params, environment, batch, key) → trajectories, for evaluation."""
    draw = SampleConfig(
        group=group,
        length=fns.turns.length,
        end_ids=fns.end_ids,
        pad_id=fns.pad_id,
        greedy=greedy,
        temperature=temperature,
    )
    return jax.jit(lambda params, world, batch, key: sample_trajectories(fns, params, world, batch, key, draw, budget))


@dataclasses.dataclass(frozen=True)
class ActiveEngine(GRPOEngine):
    """The parts of a step on trajectories; `score` is the reward of one trajectory."""

    budget: int

    def rollouts(
        self, params: Params, batch: ActiveBatch, frozen: ActiveInputs, key: Array, control_key: Array
    ) -> tuple[Group, dict[str, Array]]:
        """A group of trajectories of every prompt, with their rewards."""
        del control_key
        params = at_precision(self.config, params)
        draw = self.draw(self.config.group)
        found = sample_trajectories(self.fns, params, frozen.environment, batch, key, draw, self.budget)
        spent = Spent(found.seconds, found.harm, jnp.sum(found.action >= 0, -1))
        score = jax.vmap(jax.vmap(self.score, in_axes=(0, None, 0, None)), in_axes=(0, 0, 0, None))
        terms = score(found.parsed, batch.target, spent, frozen.prices)
        reward = sum(terms.values(), start=jnp.zeros_like(found.seconds))

        def with_answer(tokens: Array, level: Int[Array, ""]) -> Float[Array, "P G"]:
            answer = jnp.broadcast_to(jnp.where(batch.target.asked, level, -1)[:, None], found.parsed.conclude.shape)
            parsed = dataclasses.replace(found.parsed, conclude=answer)
            return sum(score(parsed, batch.target, spent, frozen.prices).values(), start=jnp.zeros_like(reward))

        reward, terms, finite, left_out = left_out_groups(reward, terms)
        levels = None
        if self.config.algorithm.enumerated is not None and self.levels is not None:
            follows = jnp.roll(found.rollout.mask, -1, -1)  # a trajectory may end by a tag that no turn has there
            tokens = jnp.where(follows, found.rollout.tokens, self.fns.pad_id)
            levels, finite, more = level_rewards(with_answer, self.levels, tokens, batch.target, reward, finite)
            left_out |= more
        seen = Explored(batch.features, found.touch, found.exists, jnp.any(found.exists, (1, 2, 3))[:, None])
        shown: dict[str, Any] = {"features": seen}
        group = Group(
            batch=dataclasses.replace(batch, **shown),
            rollout=found.rollout,
            parsed=found.parsed,
            reward=reward,
            terms=terms,
            finite=finite,
            bonus=jnp.zeros_like(reward),
            levels=levels,
        )
        return group, left_out | exploration_metrics(found, batch, frozen.environment.kinds)

    def perturbed(
        self, batch: ActiveBatch, frozen: ActiveInputs, key: Array
    ) -> tuple[Float[Array, "P G B N W"], Int[Array, "P"]]:
        """Observations with one of each trajectory replaced by noise at the statistics of the batch's observations."""
        del frozen
        seen = cast(Explored, batch.features)
        at_key, noise_key = jax.random.split(key)
        shown, tokens = jnp.any(seen.exists, -1), seen.exists[..., None]
        axes = tuple(range(seen.touch.ndim - 1))
        mean, std = (f(seen.touch, tokens, axes) for f in (masked.mean, masked.std))
        noise = mean + std * jax.random.normal(noise_key, seen.touch.shape)
        drawn = jnp.where(shown, jax.random.uniform(at_key, shown.shape), -1.0)
        chosen = shown & (jnp.arange(self.budget) == jnp.argmax(drawn, -1, keepdims=True))
        touch = jnp.where(chosen[..., None, None] & tokens, noise, seen.touch)
        return touch, jnp.zeros(len(touch), jnp.int32)

    def answered(self, group: Group) -> dict[str, Array]:
        """Share of prompts in which anything was observed; these answers are a conclusion alone."""
        return {"touch_share": jnp.mean(cast(Explored, group.batch.features).stream_mask)}

    def metrics(self, group: Group, learn: Experience) -> dict[str, Array]:
        """Size of the advantages."""
        return advantage_metrics(group.reward, learn.advantage)


def exploration_metrics(found: Trajectories, batch: ActiveBatch, kinds: tuple[str, ...]) -> dict[str, Array]:
    """Statistics of the actions of all trajectories.

    `actions` is the mean number of actions, `seconds` and `harm` mean totals; `no_action_share`, `one_action_share` and
    `all_actions_share` are shares of trajectories with none, one and as many actions as allowed; `silent_share` is the
    share of actions without observation; `first_kind_peak` is the share of the most frequent kind among first actions,
    and `first_kind_information` the mutual information of question and that kind in the batch, nat; `kinds` and
    `questions` are the numbers of kinds and of different questions in the batch, `budget` is the most actions.
    """
    acts = found.action >= 0
    number, budget = jnp.sum(acts, -1), acts.shape[-1]
    names = sorted(set(kinds))
    kind = jnp.asarray(np.array([names.index(k) for k in kinds]))[jnp.maximum(found.action[..., 0], 0)]
    is_kind = (kind[..., None] == jnp.arange(len(names))) & acts[..., :1]  # P G kinds
    joint = jnp.einsum("pa,pgk->ak", batch.target.asked.astype(jnp.float32), is_kind.astype(jnp.float32))
    first = masked.mean(is_kind, acts[..., :1], (0, 1))
    return {
        "actions": jnp.mean(number.astype(jnp.float32)),
        "seconds": jnp.mean(found.seconds),
        "harm": jnp.mean(found.harm),
        "no_action_share": jnp.mean(number == 0),
        "one_action_share": jnp.mean(number == 1),
        "all_actions_share": jnp.mean(number == budget),
        "silent_share": masked.mean(~jnp.any(found.exists, -1), acts),
        "first_kind_peak": jnp.max(first),
        "first_kind_information": mutual_information(joint),
        "kinds": jnp.float32(len(names)),
        "questions": jnp.sum(jnp.any(batch.target.asked, 0)).astype(jnp.float32),
        "budget": jnp.float32(budget),
    }


def mutual_information(count: Float[Array, "A K"]) -> Float[Array, ""]:
    """Mutual information Σ p_ak log(p_ak / (p_a p_k)) of two variables from their joint counts, nat."""
    p = count / jnp.maximum(jnp.sum(count), 1.0)
    apart = jnp.sum(p, 0) * jnp.sum(p, 1, keepdims=True)
    return jnp.sum(jnp.where(p > 0, p * jnp.log(jnp.where(p > 0, p, 1.0) / jnp.where(p > 0, apart, 1.0)), 0.0))
