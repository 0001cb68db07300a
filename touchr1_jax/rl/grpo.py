"""One GRPO step as one program: prefill, group rollouts, rewards, advantages, divergences, update.

    J = J_GRPO(R) + γ G_tg
    J_GRPO = mean_i 1/|o_i| Σ_t [ min(ρ_t A_i, clip(ρ_t) A_i) − β KL_t(π ‖ π_ref) ]
    G_tg   = mean_i 1/|o_i| Σ_t KL(π(· | q, T, o_<t) ‖ π(· | q, T_mask, o_<t))

Touch-R1 (arXiv 2605.27154), eq. 5.  T_mask is the touch with one stream, chosen uniformly among those present, replaced
by noise at the data's statistics.  `config.Algorithm` says what else J may be.  Nothing leaves the device between the
first line and the metrics.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.lm import PrefixCache
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl import tactile_use
from touchr1_jax.rl.advantages import (
    added_after,
    batch_advantage,
    dynamic_sampling_rows,
    group_advantage,
    zero_variance,
)
from touchr1_jax.rl.config import Algorithm, GRPOConfig, TactileUse
from touchr1_jax.rl.counterfactual import drop_touch, mask_one_stream, noise_touch, shuffle_touch, swap_touch
from touchr1_jax.rl.holding import held
from touchr1_jax.rl.metrics import answer_metrics, group_metrics, rollout_metrics, touch_metrics
from touchr1_jax.rl.objective import Experience, GRPOBatch, at_precision, objective_gradient
from touchr1_jax.rl.rollout import SampleConfig, sample
from touchr1_jax.rl.scoring import ScoreFn
from touchr1_jax.rl.trust_region import within_trust
from touchr1_jax.text.constraint import Constraint
from touchr1_jax.types import Params, Parsed, Rollout, Target


@struct.dataclass
class GRPOState:
    """What a step changes; `key` is the run's root key and the step is folded into it.

    `reference` is there only where the algorithm refreshes it; otherwise that of `FrozenInputs` counts.
    """

    params: Params
    opt_state: optax.OptState
    step: Int[Array, ""]
    key: Array
    reference: Params | None = None


class FrozenInputs(NamedTuple):
    """What a run never changes: the reference policy and encoded noise, K draws of every sensor's stream.

    With the encoder frozen, the encoding of a noise stream does not depend on the prompt, so a bank of K draws stands
    for fresh noise at every step.
    """

    reference: Params
    noise: Float[Array, "K S N D"]


LEAN = {"xla_cpu_use_fusion_emitters": False}
"""The newer generator holds all kernels in MLIR until the last is compiled, .5 GB even for a tiny step."""

LEAN_BEFORE = (0, 11)
"""Version of jax from which on there is the newer generator alone."""

NO_MOVE = 1e-2
"""Advantages that a bonus moves by less, a hundredth of a standard deviation, are those without it."""


class Prompts(NamedTuple):
    """Encoded prompts, [P, …]: logits of the first token, and the keys that completions stand on."""

    first: Float[Array, "P V"]
    prefix: PrefixCache


class Group(NamedTuple):
    """The rollouts of D prompts and what became of them; every field has a leading D."""

    batch: GRPOBatch
    rollout: Rollout
    parsed: Parsed
    reward: Float[Array, "D G"]
    terms: dict[str, Float[Array, "D G"]]
    bonus: Float[Array, "D G"]


def start_state(params: Params, optimizer: optax.GradientTransformation, key: Array, config: GRPOConfig) -> GRPOState:
    """State before the first step, on buffers of its own, since steps take them over."""
    own = jax.tree.map(jnp.copy, params)
    reference = jax.tree.map(jnp.copy, params) if config.algorithm.reference_every is not None else None
    step = jnp.zeros((), jnp.int32)
    return GRPOState(params=own, opt_state=optimizer.init(own), step=step, key=key, reference=reference)


def compiles_leanly() -> bool:
    """Whether this jax still has the code generator that `lean_compilation` asks for."""
    return jax.__version_info__ < LEAN_BEFORE


def make_grpo_step(
    fns: PolicyFns,
    score: ScoreFn,
    optimizer: optax.GradientTransformation,
    config: GRPOConfig,
    constraint: Constraint | None = None,
) -> Callable[[GRPOState, GRPOBatch, FrozenInputs], tuple[GRPOState, dict[str, Array]]]:
    """Build the jitted step, (state, batch, frozen) → (state, metrics); the state's buffers are donated.

    Args:
      fns: policy, prompts, vocabulary.
      score: reward of one rollout (see `scoring`).
      optimizer: applied to the gradient of −J.
      config: sizes and algorithm; a batch holds `config.drawn` prompts.
      constraint: what completions may say; `None` leaves them free.

    Raises:
      ValueError: an algorithm that samples constrained, without a constraint; lean compilation where jax has none.
    """
    if config.lean_compilation and not compiles_leanly():
        raise ValueError(
            f"lean_compilation is True, but jax {jax.__version__} has one code generator only; leave it False, or "
            f"install jax < {'.'.join(map(str, LEAN_BEFORE))}"
        )
    if config.algorithm.constrained and constraint is None:
        raise ValueError("constrained is True, but there is no constraint; make one with `compile_constraint`")
    if config.bfloat16:
        fns = dataclasses.replace(fns, cache_dtype=jnp.dtype(jnp.bfloat16))
    engine = _Engine(fns, score, optimizer, config, constraint)
    return jax.jit(engine.step, donate_argnums=0, compiler_options=LEAN if config.lean_compilation else None)


@dataclasses.dataclass(frozen=True)
class _Engine:
    """The parts of a step, in the order in which it takes them."""

    fns: PolicyFns
    score: ScoreFn
    optimizer: optax.GradientTransformation
    config: GRPOConfig
    constraint: Constraint | None

    def step(self, state: GRPOState, batch: GRPOBatch, frozen: FrozenInputs) -> tuple[GRPOState, dict[str, Array]]:
        """Rollouts, what they are worth, update."""
        key = jax.random.fold_in(state.key, state.step)
        sample_key, mask_key = jax.random.split(key)
        control_key = jax.random.fold_in(key, 2)
        sampler = dataclasses.replace(self, fns=self.fns.with_context(held))
        group, control_metrics = sampler.explore(state.params, batch, frozen, sample_key, control_key)
        reference = frozen.reference if state.reference is None else state.reference
        learn = self.experience(group, frozen, mask_key)
        params, opt_state, parts = self.update(state, reference, learn)
        metrics = parts | control_metrics | self.metrics(group, learn)
        after = dataclasses.replace(state, params=params, opt_state=opt_state, step=state.step + 1)
        return self.refreshed(after), metrics

    def explore(
        self, params: Params, batch: GRPOBatch, frozen: FrozenInputs, key: Array, control_key: Array
    ) -> tuple[Group, dict[str, Array]]:
        """Sample and score; with R_tu also under every control.  Of the candidates the lively groups are kept."""
        params = held(at_precision(self.config, params))
        prompts = encode_prompts(self.fns, params, batch)
        rollout = sample_prompts(self.fns, params, prompts, key, self._draw(self.config.group))
        reward, terms, parsed = self._scored(rollout, batch.target)
        bonus = jnp.zeros_like(reward)
        metrics: dict[str, Array] = {}
        if self.config.algorithm.tactile_use is not TactileUse.OFF:
            bonus, metrics = self.tactile_bonus(params, prompts, batch, parsed, frozen, control_key)
        if self.config.algorithm.tactile_use is TactileUse.LITERAL:
            reward = reward + self.config.algorithm.tactile_weight * bonus
        group = Group(batch, rollout, parsed, reward, terms, bonus)
        if self.config.algorithm.candidates > 1:
            rows = dynamic_sampling_rows(self._flat(group), self.config.prompts)
            group = jax.tree.map(lambda x: x[rows], group)
        return group, metrics

    def tactile_bonus(
        self, params: Params, prompts: Prompts, batch: GRPOBatch, parsed: Parsed, frozen: FrozenInputs, key: Array
    ) -> tuple[Float[Array, "D G"], dict[str, Array]]:
        """m of R_tu, from rollouts of the same questions without touch, with noise, and shuffled or swapped."""
        algorithm, keys = self.config.algorithm, jax.random.split(key, 5)
        scored = jax.vmap(jax.vmap(tactile_use.score, in_axes=(0, None)))
        own = scored(parsed, batch.target)
        control, counts = [], []
        for perturbed, draw_key in zip(controls(algorithm, batch, frozen.noise, keys), keys[2:], strict=True):
            changed = dataclasses.replace(batch, features=perturbed.features)
            again = encode_prompts(self.fns, params, changed, prompts.prefix, self.fns.touch_start)
            said = sample_prompts(self.fns, params, again, draw_key, self._draw(algorithm.controls))
            control.append(scored(self._scored(said, batch.target)[2], batch.target))
            counts.append(perturbed.applies)
        by_prompt, applies = jnp.stack(control, 1), jnp.stack(counts, 1)
        best = jax.vmap(tactile_use.bar)(by_prompt, applies)
        margin = algorithm.tactile_margin
        if algorithm.tactile_use is TactileUse.LITERAL:
            right = jax.vmap(jax.vmap(tactile_use.right, in_axes=(0, None)))(parsed, batch.target)
            bonus = jax.vmap(tactile_use.literal, in_axes=(0, 0, 0, None))(own, best, right, margin)
        else:
            bonus = jax.vmap(tactile_use.recommended, in_axes=(0, 0, 0, None))(own, best, parsed.formatted, margin)
        names = ("drop", "noise", "order")
        return bonus, {
            "touch_score": jnp.mean(own),
            **{f"control_{n}": masked.mean(by_prompt[:, i], applies[:, i, None]) for i, n in enumerate(names)},
            **{f"control_{n}_share": jnp.mean(applies[:, i]) for i, n in enumerate(names)},
            "tactile_credit_share": jnp.mean(jnp.any(bonus > 0, -1)),
            "control_missing_share": 1 - jnp.mean(applies),
            "credit_unearned_share": jnp.mean(jnp.any((bonus > 0) & (own <= 0), -1)),
        }

    def experience(self, group: Group, frozen: FrozenInputs, key: Array) -> Experience:
        """Advantages and weights of the groups, and the perturbed touch of the grounding term."""
        algorithm, batch = self.config.algorithm, group.batch
        advantage = self._advantage(group.reward)
        if algorithm.tactile_use is TactileUse.RECOMMENDED:
            advantage += added_after(group.bonus, algorithm.tactile_weight)
        no_signal = self._flat(group)
        even = jnp.full(no_signal.shape, 1 / self.config.prompts)
        masked_touch, stream = mask_one_stream(batch.features, frozen.noise, key)
        return Experience(
            batch=batch,
            masked_touch=masked_touch,
            masked_stream=stream,
            rollout=group.rollout,
            old=group.rollout.log_prob,
            advantage=advantage,
            weight=prompt_weights(~no_signal) if algorithm.drop_degenerate else even,
        )

    def update(
        self, state: GRPOState, reference: Params, learn: Experience
    ) -> tuple[Params, optax.OptState, dict[str, Array]]:
        """μ gradient steps on the same rollouts; the parts are those of the first, `clip_share` that of the last."""

        def once(carry: tuple[Params, optax.OptState, Array], first: Any):
            params, opt_state, old = carry
            grads, parts = self.gradient(params, reference, learn._replace(old=old), first)
            old = parts.pop("old", old)
            updates, opt_state = self.optimizer.update(grads, opt_state, params)
            parts = parts | {"grad_norm": optax.tree.norm(grads)}
            moved = optax.apply_updates(params, updates)
            if (trust := self.config.algorithm.trust_nat) is not None:
                moved, size = within_trust(self.fns, self.config, params, moved, learn, trust)
                parts |= size
            return (moved, opt_state, old), parts

        start, count = (state.params, state.opt_state, learn.old), self.config.algorithm.updates
        if count == 1:
            (params, opt_state, _), parts = once(start, True)
            return params, opt_state, parts
        (params, opt_state, _), all_parts = jax.lax.scan(once, start, jnp.arange(count) == 0)
        parts = jax.tree.map(lambda x: x[0], all_parts)
        return params, opt_state, parts | {"clip_share": all_parts["clip_share"][-1]}

    def gradient(
        self, params: Params, reference: Params, learn: Experience, first: bool | Bool[Array, ""] = True
    ) -> tuple[Params, dict[str, Array]]:
        """The gradient of −J over as many tokens as the shortest sufficient bucket has."""
        lengths = (*self.config.buckets, self.config.length)
        longest = jnp.max(jnp.sum(learn.rollout.mask, -1))

        def over(length: int):
            cut = lambda x: x[..., :length]
            short = learn._replace(rollout=jax.tree.map(cut, learn.rollout), old=cut(learn.old))

            def of(p: Params) -> tuple[Params, dict[str, Array]]:
                grads, parts = objective_gradient(self.fns, self.config, p, reference, short, first=first)
                if "old" in parts:
                    parts["old"] = jnp.pad(parts["old"], [(0, 0), (0, 0), (0, self.config.length - length)])
                return grads, parts

            return of

        if len(lengths) == 1:
            return over(self.config.length)(params)
        bucket = jnp.sum(jnp.asarray(lengths) < longest)
        return jax.lax.switch(bucket, [over(length) for length in lengths], params)

    def refreshed(self, state: GRPOState) -> GRPOState:
        """The state with the policy as its own reference where the algorithm's period is over."""
        every = self.config.algorithm.reference_every
        if every is None:
            return state
        if state.reference is None:
            raise ValueError(f"reference_every is {every}, but the state has no reference; make it with `start_state`")
        pick = lambda new, old: jnp.where(state.step % every == 0, new, old)
        return dataclasses.replace(state, reference=jax.tree.map(pick, state.params, state.reference))

    def metrics(self, group: Group, learn: Experience) -> dict[str, Array]:
        """Everything that is logged of a step but the objective's parts."""
        target = group.batch.target
        right = jax.vmap(jax.vmap(tactile_use.right, in_axes=(0, None)))(group.parsed, target)
        metrics = {f"reward_{name}": jnp.mean(value) for name, value in group.terms.items()}
        metrics |= rollout_metrics(group.rollout, group.reward, self._flat(group), group.parsed, target)
        metrics |= answer_metrics(group.parsed, target)
        metrics |= group_metrics(group.reward, learn.advantage, right)
        metrics |= self._bonus_metrics(group, learn)
        return metrics | touch_metrics(group.batch.features)

    def _advantage(self, reward: Float[Array, "P G"]) -> Float[Array, "P G"]:
        algorithm = self.config.algorithm
        if algorithm.batch_sigma:
            return batch_advantage(reward, epsilon=algorithm.epsilon)
        return group_advantage(reward, epsilon=algorithm.epsilon, normalise=algorithm.normalise)

    def _bonus_metrics(self, group: Group, learn: Experience) -> dict[str, Array]:
        """Shares of groups whose rollouts earn different tactile bonuses, and of those whose advantages ignore them."""
        algorithm, reward = self.config.algorithm, group.reward
        if algorithm.tactile_use is TactileUse.LITERAL:
            reward = reward - algorithm.tactile_weight * group.bonus
        moved = jnp.max(jnp.abs(learn.advantage - self._advantage(reward)), -1)
        tells = ~zero_variance(group.bonus)
        return {"bonus_telling_share": jnp.mean(tells), "bonus_cancelled_share": jnp.mean(tells & (moved < NO_MOVE))}

    def _flat(self, group: Group) -> Bool[Array, "D"]:
        """Groups that teach nothing: the reward is constant, and the bonus where it counts by itself."""
        no_signal = zero_variance(group.reward)
        counts = self.config.algorithm.tactile_use is TactileUse.RECOMMENDED
        return no_signal & zero_variance(group.bonus) if counts else no_signal

    def _scored(self, rollout: Rollout, target: Target) -> tuple[Array, dict[str, Array], Parsed]:
        return jax.vmap(jax.vmap(self.score, in_axes=(0, None)))(rollout.tokens, target)

    def _draw(self, group: int) -> SampleConfig:
        return SampleConfig(
            group=group,
            length=self.config.length,
            end_ids=self.fns.end_ids,
            pad_id=self.fns.pad_id,
            inverse=self.config.inverse_draws,
            constraint=self.constraint,
        )


def controls(algorithm: Algorithm, batch: GRPOBatch, noise: Float[Array, "K S N D"], keys: Array):
    """The perturbed touch of R_tu's three controls: dropped, noise, and order.

    Literal: order is a shuffle, which counts where the question is marked as depending on order.  Recommended: where it
    is not, another object's touch takes its place, which an answer that merely tells noise from touch does not meet.
    """
    features = batch.features
    depends = jnp.zeros(features.stream_mask.shape[0], bool) if batch.ordered is None else batch.ordered
    shuffled = shuffle_touch(features, keys[1])
    use = depends & shuffled.applies
    if algorithm.tactile_use is TactileUse.LITERAL:
        third = shuffled._replace(applies=use)
    else:
        swapped = swap_touch(features, keys[1])
        choose = lambda a, b: jnp.where(use.reshape(-1, *(1,) * (a.ndim - 1)), a, b)
        third = jax.tree.map(choose, shuffled, swapped)
    return drop_touch(features), noise_touch(features, noise, keys[0]), third


def encode_prompts(
    fns: PolicyFns, params: Params, batch: GRPOBatch, known: PrefixCache | None = None, start: int = 0
) -> Prompts:
    """Prefill each prompt once, or only what follows `start` where `known` holds the rest."""
    prefill = lambda f, i, m, k: fns.prefill(params, f, i, m, k, start)
    return Prompts(*jax.vmap(prefill)(batch.features, batch.ids, batch.mask, known))


def sample_prompts(fns: PolicyFns, params: Params, prompts: Prompts, key: Array, draw: SampleConfig) -> Rollout:
    """Draw the completions of encoded prompts."""
    decode = lambda token, t, past, caches: fns.decode(params, token, t, past, caches)
    return sample(decode, prompts.first, prompts.prefix, fns.empty_cache(draw.length), key, draw)


def sample_group(fns: PolicyFns, params: Params, batch: GRPOBatch, key: Array, draw: SampleConfig) -> Rollout:
    """Prefill each prompt once and draw its completions."""
    return sample_prompts(fns, params, encode_prompts(fns, params, batch), key, draw)


def prompt_weights(counts: Bool[Array, "P"]) -> Float[Array, "P"]:
    """Weight of each prompt in a mean over the prompts that count; all 0 when none does."""
    return counts / jnp.maximum(jnp.sum(counts), 1)
