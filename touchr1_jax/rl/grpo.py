"""One GRPO step as one program: rollouts → parsed answers → rewards → advantages → update.

    J = J_GRPO(R) + γ G_tg
    J_GRPO = mean_i 1/|o_i| Σ_t [ min(ρ_t A_i, clip(ρ_t) A_i) − β KL_t(π ‖ π_ref) ]
    G_tg   = mean_i 1/|o_i| Σ_t KL(π(· | q, T, o_<t) ‖ π(· | q, T_mask, o_<t))

Touch-R1 (arXiv 2605.27154), eq. 5; `losses.grpo_loss` is −J with all options of `config.Algorithm`.  T_mask is the
touch with one stream, chosen uniformly among those present, replaced by noise at the data's statistics.  Nothing leaves
the device between the first line and the metrics.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.policy import Features
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rewards.base import GROUP
from touchr1_jax.rl import tactile_use
from touchr1_jax.rl.advantages import (
    SPREAD_FLOOR,
    added_after,
    advantages,
    dynamic_sampling_rows,
    neutralised,
    no_signal,
    of_kept_groups,
    prompt_weights,
    zero_variance,
)
from touchr1_jax.rl.config import Average, GRPOConfig, TactileUse, at_precision, ratio_to_learner
from touchr1_jax.rl.counterfactual import mask_one_stream
from touchr1_jax.rl.enumerated import LevelRewards, all_equal, expected_of_kept, level_rewards
from touchr1_jax.rl.gradient import Experience, log_probs
from touchr1_jax.rl.losses import check_centering, over_tokens
from touchr1_jax.rl.metrics import (
    advantage_metrics,
    answer_metrics,
    reward_metrics,
    rollout_metrics,
    touch_metrics,
)
from touchr1_jax.rl.rollout import GRPOBatch, SampleConfig, encode_prompts, sample_prompts
from touchr1_jax.rl.scoring import (
    NONFINITE_IN,
    ScoreFn,
    WeightedScore,
    left_out_groups,
    ordinal_levels,
    require_stable_rewards,
    squares_fit,
)
from touchr1_jax.rl.update import update_policy
from touchr1_jax.text.constraint import Constraint
from touchr1_jax.text.template import LevelTokens
from touchr1_jax.types import SAMPLE, Params, Parsed, Rollout, StepSample
from touchr1_jax.validation import require_wide

LEAN = {"xla_cpu_use_fusion_emitters": False}
"""The newer generator holds all kernels in MLIR until the last is compiled, .5 GB even for a tiny step."""

LEAN_BEFORE = (0, 11)
"""Version of jax from which on there is the newer generator alone."""


@struct.dataclass
class GRPOState:
    """Everything that a step changes; `key` is the run's root key and the step is folded into it.

    `reference` exists only if the algorithm refreshes it; otherwise, `FrozenInputs` holds the reference.  `behind` are
    the parameters before the last `stale` updates, the oldest first; the next rollouts are sampled with the oldest.
    """

    params: Params
    opt_state: optax.OptState
    step: Int[Array, ""]
    key: Array
    reference: Params | None = None
    behind: tuple[Params, ...] = ()


class FrozenInputs(NamedTuple):
    """Inputs of a step that a run never changes: the reference policy and encoded noise, K draws of each sensor.

    The encoder is frozen, so the encoding of noise does not depend on the prompt, and a bank of K draws replaces fresh
    noise at every step.
    """

    reference: Params
    noise: Float[Array, "K S N D"]


class Group(NamedTuple):
    """The rollouts of D prompts with their rewards; every field has a leading D.

    `finite` is false if a reward was NaN or infinite: the policy gradient leaves out the group.
    """

    batch: GRPOBatch
    rollout: Rollout
    parsed: Parsed
    reward: Float[Array, "D G"]
    terms: dict[str, Float[Array, "D G"]]
    finite: Bool[Array, "D"]
    bonus: Float[Array, "D G"]
    levels: LevelRewards | None = None
    """Rewards of every conclusion, where it is enumerated."""


def start_state(params: Params, optimizer: optax.GradientTransformation, key: Array, config: GRPOConfig) -> GRPOState:
    """State before the first step, in new buffers, because steps donate their state.

    Raises:
      ValueError: as `require_wide`.
    """
    require_wide(params)
    copy = lambda: jax.tree.map(jnp.copy, params)
    own = copy()
    return GRPOState(
        params=own,
        opt_state=optimizer.init(own),
        step=jnp.zeros((), jnp.int32),
        key=jax.random.clone(key),
        reference=copy() if config.algorithm.reference_every is not None else None,
        behind=tuple(copy() for _ in range(config.algorithm.stale)),
    )


def compiles_leanly() -> bool:
    """True if this jax still has the code generator that `lean_compilation` needs."""
    return jax.__version_info__ < LEAN_BEFORE


def make_grpo_step(
    fns: PolicyFns,
    score: ScoreFn,
    optimizer: optax.GradientTransformation,
    config: GRPOConfig,
    constraint: Constraint | None = None,
    *,
    gather: Callable[[Params], Params] = lambda params: params,
    levels: LevelTokens | None = None,
    sampled: bool = False,
) -> Callable[[GRPOState, GRPOBatch, FrozenInputs], tuple[GRPOState, dict[str, Any]]]:
    """Build the jitted step, (state, batch, frozen) → (state, metrics); the state's buffers are donated.

    Args:
      fns: policy, prompts, vocabulary.
      score: reward of one rollout (see `scoring`).
      optimizer: applied to the gradient of −J.
      config: sizes and algorithm; a batch holds `config.drawn` prompts.
      constraint: which completions may be sampled; `None` leaves them free.
      gather: all-gathers sharded weights, once before the sampling loop, which reads all of them for every token (see
        `distributed.placement.gather_params`); by default they are read as they are.
      levels: token of each level, for an algorithm that enumerates conclusions.
      sampled: return a `types.StepSample` with the metrics, under the name `SAMPLE`.

    Raises:
      ValueError: an algorithm that samples constrained, without a constraint; one that enumerates conclusions, without
        the tokens of the levels; one that credits segments, with a score that `make_score` did not make; one
        with stable rewards, with a score of published ones; lean compilation where jax has none; as `check_centering`.
    """
    if config.lean_compilation and not compiles_leanly():
        raise ValueError(
            f"lean_compilation is True, but jax {jax.__version__} has one code generator only; leave it False, or "
            f"install jax < {'.'.join(map(str, LEAN_BEFORE))}"
        )
    if config.algorithm.segment_credit and not isinstance(score, WeightedScore):
        raise ValueError(
            "segment_credit is True, but the score does not say when rewards are settled; use `make_score`"
        )
    if config.algorithm.constrained and constraint is None:
        raise ValueError("constrained is True, but there is no constraint; make one with `compile_constraint`")
    if config.algorithm.enumerated is not None and levels is None:
        raise ValueError("enumerated is set, but there are no tokens of levels; make them with `level_tokens`")
    if config.algorithm.score_centering:
        check_centering(config.algorithm)
    if config.algorithm.stable_rewards:
        require_stable_rewards(score)
    if config.bfloat16:
        fns = dataclasses.replace(fns, cache_dtype=jnp.dtype(jnp.bfloat16))
    return compile_step(GRPOEngine(fns, score, optimizer, config, constraint, gather, levels, sampled), config)


def compile_step(engine: "GRPOEngine", config: GRPOConfig) -> Callable[..., tuple[GRPOState, dict[str, Array]]]:
    """The jitted step of an engine; the state's buffers are donated."""
    return jax.jit(engine.step, donate_argnums=0, compiler_options=LEAN if config.lean_compilation else None)


@dataclasses.dataclass(frozen=True)
class GRPOEngine:
    """The parts of a step, in the order in which it takes them."""

    fns: Any
    score: Callable[..., Any]
    optimizer: optax.GradientTransformation
    config: GRPOConfig
    constraint: Constraint | None
    gather: Callable[[Params], Params]
    levels: LevelTokens | None
    sampled: bool

    def step(self, state: GRPOState, batch: Any, frozen: Any) -> tuple[GRPOState, dict[str, Any]]:
        """Rollouts, rewards, advantages, update."""
        key = jax.random.fold_in(state.key, state.step)
        sample_key, mask_key = jax.random.split(key)
        control_key = jax.random.fold_in(key, 2)
        if len(state.behind) != self.config.algorithm.stale:
            lag = f"stale is {self.config.algorithm.stale}, but the state holds {len(state.behind)} older parameters"
            raise ValueError(f"{lag}; make it with `start_state`")
        sampler = state.behind[0] if state.behind else state.params
        group, metrics = self.rollouts(sampler, batch, frozen, sample_key, control_key)
        sample: dict[str, Any] = {}
        if self.sampled:
            asked, label = group.batch.target.asked[0], group.batch.target.label[0]
            earned = jnp.where(group.finite[0], group.reward[0, 0], jnp.nan)  # else it is the mean of other groups
            sample[SAMPLE] = StepSample(asked, label, group.rollout.tokens[0, 0], earned)
        if self.config.algorithm.candidates > 1:
            drawn = self.group_metrics(group) | self.answered(group)
            metrics |= {f"drawn_{name}": value for name, value in drawn.items()}
            rows = dynamic_sampling_rows(self.no_signal(group), self.config.prompts)
            group = jax.tree.map(lambda x: x[rows], group)
        reference = frozen.reference if state.reference is None else state.reference
        passed = functools.partial(log_probs, self.fns, self.config, batch=group.batch, rollout=group.rollout)
        lagged, in_reward = not ratio_to_learner(self.config.algorithm), self.config.algorithm.kl_in_reward
        rounds_otherwise = self.fns.cache_dtype != jnp.float32 or group.batch.rollout is not None
        own = passed(sampler) if lagged or (in_reward and rounds_otherwise) else group.rollout.log_prob
        if in_reward:
            group, left_out = self.penalised(group, own - passed(reference))
            metrics |= left_out
        learn = self.experience(group, self.perturbed(group.batch, frozen, mask_key))
        learn = learn._replace(old=own) if lagged else learn
        params, opt_state, parts = update_policy(
            self.fns, self.optimizer, self.config, state.params, state.opt_state, reference, learn
        )
        parts = expected_of_kept(parts, group.finite)
        metrics |= parts | self.group_metrics(group) | self.answered(group) | self.metrics(group, learn)
        step, behind = state.step + 1, (*state.behind, state.params)[1:]
        after = dataclasses.replace(state, params=params, opt_state=opt_state, step=step, behind=behind)
        return self.refreshed(after), {**metrics, **sample}

    def rollouts(
        self, params: Params, batch: Any, frozen: Any, key: Array, control_key: Array
    ) -> tuple[Group, dict[str, Array]]:
        """A group of answers to every prompt, parsed and rewarded; with R_tu also answers under every control."""
        algorithm = self.config.algorithm
        fns, params = self.fns.with_context(self.gather), self.gather(at_precision(self.config, params))
        prompts = encode_prompts(fns, params, batch)
        rollout = batch.rollout
        if rollout is None:
            rollout = sample_prompts(fns, params, prompts, key, self.draw(self.config.group))
        score = jax.vmap(jax.vmap(self.score, in_axes=(0, None), axis_name=GROUP))
        reward, terms, parsed = score(rollout.tokens, batch.target)
        reward, terms, finite, left_out = left_out_groups(reward, terms)

        def answer(features: Features, key: Array) -> Parsed:
            changed = dataclasses.replace(batch, features=features)
            again = encode_prompts(fns, params, changed, prompts.prefix, fns.touch_start)
            answers = sample_prompts(fns, params, again, key, self.draw(algorithm.controls))
            return score(answers.tokens, batch.target)[2]

        bonus, metrics = jnp.zeros_like(reward), dict[str, Array]()
        if algorithm.tactile_use is not TactileUse.OFF:
            bonus, metrics = tactile_use.tactile_bonus(algorithm, parsed, batch, frozen.noise, answer, control_key)
        if algorithm.tactile_use is TactileUse.LITERAL:
            terms = {**terms, tactile_use.TERM: neutralised(algorithm.tactile_weight * bonus, finite)}
            reward = reward + terms[tactile_use.TERM]
        levels = None
        if algorithm.enumerated is not None and self.levels is not None:
            reward_of = lambda tokens, level: score(tokens, batch.target)[0]
            levels, finite, more = level_rewards(reward_of, self.levels, rollout.tokens, batch.target, reward, finite)
            left_out |= more
        return Group(batch, rollout, parsed, reward, terms, finite, bonus, levels), metrics | left_out

    def draw(self, group: int) -> SampleConfig:
        """Settings of the sampler for groups of this size."""
        return SampleConfig(
            group=group,
            length=self.config.length,
            end_ids=self.fns.end_ids,
            pad_id=self.fns.pad_id,
            temperature=self.config.temperature,
            top_p=self.config.top_p,
            min_p=self.config.min_p,
            inverse=self.config.inverse_draws,
            constraint=self.constraint,
        )

    def no_signal(self, group: Group) -> Bool[Array, "D"]:
        """Groups without a gradient: the reward is constant, and so is any bonus added to the advantage."""
        if group.levels is not None:
            return all_equal(group.levels, SPREAD_FLOOR) | ~group.finite
        equal = no_signal(self.config.algorithm, group.reward, group.terms)
        if self.config.algorithm.tactile_use is TactileUse.RECOMMENDED:
            equal &= zero_variance(group.bonus)
        return equal | ~group.finite

    def penalised(self, group: Group, log_ratio: Float[Array, "P G T"]) -> tuple[Group, dict[str, Array]]:
        """The group with −β Σ_t log(π/π_ref) as a further term of its reward: the unbiased estimate k1 of the KL.

        `log_ratio` is of one pass where the sampler rounds otherwise: σ would make an advantage of the difference among
        equal answers.  Groups that are left out, also for this term, again have the mean of all others; the share of
        those that only this term leaves out is `nonfinite_in_kl`.
        """
        term = -self.config.algorithm.beta * masked.total(log_ratio, group.rollout.mask, -1)
        finite = group.finite & squares_fit(term) & squares_fit(group.reward + term)
        neutral = functools.partial(neutralised, finite=finite)
        reward, terms = jax.tree.map(neutral, (group.reward + term, {**group.terms, "kl": term}))
        left_out = {f"{NONFINITE_IN}kl": jnp.mean(group.finite & ~finite)}
        return group._replace(reward=reward, terms=terms, finite=finite), left_out

    def perturbed(self, batch: Any, frozen: Any, key: Array) -> tuple[Array, Int[Array, "P"]]:
        """Touch with one stream of each prompt replaced by noise, for the grounding term, and which stream."""
        return mask_one_stream(batch.features, frozen.noise, key)

    def experience(self, group: Group, perturbed: tuple[Array, Int[Array, "P"]]) -> Experience:
        """Advantages and weights of the groups, with the perturbed touch of the grounding term."""
        algorithm, batch = self.config.algorithm, group.batch
        kept = functools.partial(of_kept_groups, algorithm, finite=group.finite)
        advantage, by_token = kept(advantages(algorithm, group.reward, group.terms, group.finite)), None
        if isinstance(self.score, WeightedScore) and algorithm.segment_credit:
            tokens = group.rollout.tokens
            by_token = kept(self.score.segment_advantages(algorithm, group.reward, group.terms, tokens, group.finite))
        if algorithm.tactile_use is TactileUse.RECOMMENDED:
            bonus = jnp.where(group.finite[:, None], added_after(group.bonus, algorithm.tactile_weight), 0.0)
            advantage, by_token = advantage + bonus, by_token if by_token is None else by_token + bonus[..., None]
        no_signal = self.no_signal(group)
        rollout, weight = group.rollout, jnp.full(no_signal.shape, 1 / self.config.prompts)
        if algorithm.mask_truncated:
            rollout = dataclasses.replace(rollout, mask=rollout.mask & ~group.parsed.truncated[..., None])
        if algorithm.drop_degenerate:
            weight = prompt_weights(~no_signal)
        if algorithm.average is Average.BATCH:
            weight = over_tokens(weight, rollout.mask)
        weight = jnp.where(group.finite, weight, 0.0)  # where conclusions are enumerated, no advantage of 0 does it
        masked_touch, stream = perturbed
        return Experience(
            batch=batch,
            masked_touch=masked_touch,
            masked_stream=stream,
            rollout=rollout,
            old=rollout.log_prob,
            advantage=advantage,
            token_advantage=by_token,
            weight=weight,
            levels=group.levels,
        )

    def refreshed(self, state: GRPOState) -> GRPOState:
        """The state whose reference moves to the policy, or by a share of the way, every `reference_every` steps.

        The moving average of TR-DPO (arXiv 2404.09656), TRL's `ref_model_mixup_alpha`.
        """
        every = self.config.algorithm.reference_every
        if every is None:
            return state
        if state.reference is None:
            raise ValueError(f"reference_every is {every}, but the state has no reference; make it with `start_state`")
        share = self.config.algorithm.reference_share
        mix = lambda new, old: new if share == 1.0 else share * new + (1 - share) * old
        pick = lambda new, old: jnp.where(state.step % every == 0, mix(new, old), old)
        return dataclasses.replace(state, reference=jax.tree.map(pick, state.params, state.reference))

    def group_metrics(self, group: Group) -> dict[str, Array]:
        """Metrics of rollouts and rewards; with dynamic sampling, of all candidates and of the selected ones."""
        target, no_signal = group.batch.target, self.no_signal(group)
        right = jax.vmap(jax.vmap(tactile_use.right, in_axes=(0, None)))(group.parsed, target)
        return {
            **reward_metrics(group.terms, right, no_signal, group.finite),
            **rollout_metrics(group.rollout, group.reward, no_signal, group.finite, group.parsed, target),
        }

    def answered(self, group: Group) -> dict[str, Array]:
        """Metrics of answers and touch, also of all candidates: no group whose answers are all alike is selected."""
        answers = answer_metrics(group.parsed, group.batch.target, ordinal_levels(self.score))
        return answers | touch_metrics(group.batch.features, self.fns.step_tokens)

    def metrics(self, group: Group, learn: Experience) -> dict[str, Array]:
        """Metrics of the selected groups alone: their advantages and bonuses."""
        algorithm, reward = self.config.algorithm, group.reward
        return {
            **advantage_metrics(reward, learn.advantage),
            **tactile_use.bonus_metrics(algorithm, reward, group.terms, group.bonus, learn.advantage, group.finite),
        }
