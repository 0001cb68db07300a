"""The loss of GRPO on arrays, and its terms.

`grpo_loss` is the whole objective.  `gradient` computes its arguments from a policy, prompt by prompt and in blocks of
the vocabulary, and differentiates it.
"""

from typing import Literal, NamedTuple, assert_never

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.rl.config import (
    Algorithm,
    Average,
    GRPOConfig,
    KLEstimator,
    Surrogate,
    left_out,
    loss_beta,
    ratio_to_learner,
)
from touchr1_jax.rl.enumerated import ExactTerms, LevelRewards, before_level, conclude_exactly, exact_terms

LOG_RATIO_CLAMP = 20.0
"""Bound of a log-ratio before `exp`: e^20 is far past any meaning and far from float32 overflow."""

LEAST_TAIL = 1e-6
"""Least probability of all tokens past the head: in float32 1 − Σ p rounds to 0 or below."""


class TokenTerms(NamedTuple):
    """Numbers of every completion token; the loss averages them, and their gradients are those of the policy."""

    log_prob: Float[Array, "*n"]
    """log π(o_t) of the sampled token."""
    reference_kl: Float[Array, "*n"]
    """KL(π ‖ π_ref) at this token, nat, by the configured estimator."""
    grounding: Float[Array, "*n"]
    """KL(π(· | touch) ‖ π(· | one stream replaced by noise)), nat, at most `grounding_cap_nat`."""
    entropy: Float[Array, "*n"]
    """Entropy of π, nat."""
    level_log_prob: Float[Array, "*g K"] | None = None
    """log π of each level at the place where a rollout concludes, −∞ past the last one; only where it is enumerated."""
    head_log_prob: Float[Array, "*n K"] | None = None
    """log π of the sampler's most likely tokens; only where scores are centered."""
    answer_log_prob: Float[Array, "*p T"] | None = None
    """log π of each token of the prompt's verified answer; only with an anchor."""


def grpo_loss(
    terms: TokenTerms,
    old: Float[Array, "P G T"],
    sampler: Float[Array, "P G T"],
    mask: Bool[Array, "P G T"],
    advantage: Float[Array, "P G *t"],
    weight: Float[Array, "P"],
    config: GRPOConfig,
    longest: int | Float[Array, ""] | None = None,
    answer: Float[Array, "P"] | None = None,
    levels: LevelRewards | None = None,
    head: Float[Array, "P G T K"] | None = None,
) -> tuple[Float[Array, ""], dict[str, Float[Array, "P"]]]:
    """Loss −J of a micro-batch of groups; the sum over micro-batches is the loss of the step.

        J   = Σ_p w_p ⟨c_t S_t⟩ + 1/N Σ_p [ min(γ ⟨G_t⟩, budget) − β ⟨KL_t⟩ + η min(⟨H_t⟩, floor) + λ L_p ]
        S_t = min(ρ_t A, clip(ρ_t, 1 − low, 1 + high) A),   ρ_t = π(o_t) / π_old(o_t)     (`surrogate` has others)
        c_t = min(π_old(o_t) / π_sampler(o_t), cap)                       (`importance` has another)

    ⟨·⟩ is the mean over the tokens of a group: `algorithm.average` for S and KL, per rollout for G, per kept one for H.
    Source: Touch-R1 (arXiv 2605.27154, eq. 5), where N = P, w = 1/N, c = 1, η = λ = 0 and nothing bounds G.

    Args:
      terms: log-probability, reference KL, grounding G and entropy H of every token, [P, G, T].
      old, sampler: log-probabilities to which ratios are relative, and those of the sampler.
      mask: which tokens exist.
      advantage: A of each rollout, or of each of its tokens.
      weight: w, the weight of each prompt's policy gradient; 0 leaves the prompt out.
      config: `prompts` is N, `length` the longest completion; `algorithm` holds β, γ, η = `entropy_weight` and bounds.
      longest: `divisor` of the whole batch; by default that of these rollouts.
      answer: L, the mean log-likelihood of a token of each verified answer; `None` if λ = `anchor` is 0.
      levels: rewards of every enumerated conclusion, which replace `advantage` (see `enumerated`).
      head: log-probabilities of the sampler's most likely tokens, if scores are centered.

    Returns:
      The loss, and per prompt: S as averaged, means over kept rollouts, peaks of a token, and `mismatch_parts`.
    """
    algorithm, dropped = config.algorithm, too_far(config.algorithm, old - sampler, mask)
    longest = divisor(config, mask) if longest is None else longest
    drawn, mask = mask, mask & ~dropped[..., None]
    objective, clipped, expected = policy_objective(algorithm, terms, old, sampler, mask, advantage, levels, head)
    policy, kl = (group_mean(algorithm.average, x, mask, longest) for x in (objective, terms.reference_kl))
    grounding = group_mean(Average.ROLLOUT, terms.grounding, mask, longest)
    entropy = masked.mean_of_means(terms.entropy, mask)
    grounded = at_most(algorithm.gamma * grounding, algorithm.grounding_budget)
    explored = algorithm.entropy_weight * at_most(entropy, algorithm.entropy_floor_nat)
    further = grounded - loss_beta(algorithm) * kl + explored + (0.0 if answer is None else algorithm.anchor * answer)
    gain = jnp.sum(weight * policy) + jnp.sum(further) / config.prompts
    learner = old if ratio_to_learner(algorithm) else jax.lax.stop_gradient(terms.log_prob)
    peak = lambda x: jnp.max(jnp.where(mask, jax.lax.stop_gradient(x), 0.0), (-2, -1))
    return -gain, expected | {
        "surrogate": policy,
        "kl": masked.mean_of_means(terms.reference_kl, mask),
        "kl_peak": peak(terms.reference_kl),
        "grounding": masked.mean_of_means(terms.grounding, mask),
        "grounding_peak": peak(terms.grounding),
        "entropy": entropy,
        "clip_share": masked.mean_of_means(clipped.astype(jnp.float32), mask),
        **mismatch_parts(learner - sampler, drawn, dropped),
    }


def policy_objective(
    algorithm: Algorithm,
    terms: TokenTerms,
    old: Float[Array, "P G T"],
    sampler: Float[Array, "P G T"],
    mask: Bool[Array, "P G T"],
    advantage: Float[Array, "P G *t"],
    levels: LevelRewards | None,
    head: Float[Array, "P G T K"] | None = None,
) -> tuple[Float[Array, "P G T"], Bool[Array, "P G T"], dict[str, Float[Array, "P"]]]:
    """c_t S_t of every token, where the clip removed its gradient, and each prompt's mean E if it is enumerated.

    With score centering, A times `expected_score` is subtracted.  The objective of an enumerated conclusion that is not
    learned is −KL to the reference, because training the trace would change the conclusion.  Arguments are those of
    `grpo_loss`.
    """
    exact = None if levels is None else exact_levels(algorithm, terms, levels)
    trace = mask if levels is None else before_level(mask, levels.at)
    a = advantage if exact is None else exact.advantage
    objective, clipped = surrogate(algorithm, terms.log_prob, old, trace, a)
    reached: float | Array = 1.0  # weight of the level, which is not drawn itself, but after a trace that is
    if algorithm.importance_cap is not None:
        importances = jnp.minimum(importance(algorithm, old - sampler, trace), algorithm.importance_cap)
        objective *= importances
        reached = importances[..., :1] if algorithm.importance_sequence else 1.0
    if algorithm.score_centering:
        check_centering(algorithm)
        wide = advantage if advantage.ndim == mask.ndim else advantage[..., None]
        objective -= wide * expected_score(algorithm, terms.head_log_prob, head)
    if levels is None or exact is None:
        return objective, clipped, {}
    expected = {"expected_reward": jnp.mean(exact.expected, -1)}
    if algorithm.learn_conclusion:
        return conclude_exactly(objective, reached * exact.objective[..., None], levels.at), clipped & trace, expected
    kept = jax.lax.stop_gradient(exact.objective)[..., None] - terms.reference_kl
    return conclude_exactly(objective, kept, levels.at), clipped & trace, expected


def exact_levels(algorithm: Algorithm, terms: TokenTerms, levels: LevelRewards) -> ExactTerms:
    """`enumerated.exact_terms` of groups of rollouts.

    Raises:
      ValueError: an algorithm that does not enumerate, or terms without the probabilities of the levels.
    """
    if algorithm.enumerated is None or terms.level_log_prob is None:
        raise ValueError("levels are given, but enumerated is None or terms lack level_log_prob; pass both or neither")
    states, epsilon = levels.at < terms.log_prob.shape[-1], algorithm.epsilon
    return exact_terms(
        algorithm.enumerated, terms.level_log_prob, levels.reward, states, levels.sampled, epsilon=epsilon
    )


def importance(
    algorithm: Algorithm, log_ratio: Float[Array, "*n T"], mask: Bool[Array, "*n T"]
) -> Float[Array, "*n T"]:
    """π_old/π_sampler of every token, or their product over a rollout; the loss caps them.

    Truncated importance sampling (Yao et al. 2025, "Your efficient RL framework secretly brings you off-policy RL
    training"); TRL's `token_truncate` and `sequence_truncate`.
    """
    if algorithm.importance_sequence:
        log_ratio = jnp.broadcast_to(masked.total(log_ratio, mask, -1, keepdims=True), log_ratio.shape)
    return _ratio(log_ratio)


def too_far(algorithm: Algorithm, log_ratio: Float[Array, "*n T"], mask: Bool[Array, "*n T"]) -> Bool[Array, "*n"]:
    """Rollouts whose mean |log π_old − log π_sampler| of a token is above `mismatch_limit`.

    Departure from the geometric mask of a sequence (Liu et al. 2025, "When speed kills stability"; SkyRL), which bounds
    |mean log π_old / π_sampler|: here, tokens that are too likely do not offset tokens that are too unlikely.
    """
    if algorithm.mismatch_limit is None:
        return jnp.zeros(mask.shape[:-1], bool)
    return masked.mean(jnp.abs(log_ratio), mask, -1) > algorithm.mismatch_limit


def mismatch_parts(
    gap: Float[Array, "P G T"], mask: Bool[Array, "P G T"], dropped: Bool[Array, "P G"]
) -> dict[str, Float[Array, "P"]]:
    """Of each prompt: mean and largest |gap|, shares of rollouts dropped and learned from, if tokens stay, exist."""
    return {
        "sampler_gap": masked.mean_of_means(jnp.abs(gap), mask),
        "sampler_gap_peak": jnp.max(jnp.where(mask, jnp.abs(gap), 0.0), (-2, -1)),
        "dropped_share": jnp.mean(dropped, -1),
        "learned_share": jnp.mean(jnp.any(mask, -1) & ~dropped, -1),
        "kept_prompts": jnp.any(mask & ~dropped[..., None], (-2, -1)).astype(jnp.float32),
        "drawn_prompts": jnp.any(mask, (-2, -1)).astype(jnp.float32),
    }


def check_centering(algorithm: Algorithm) -> None:
    """Refuse settings without defined score centering: ratios other than 1, conclusions that are not sampled.

    Raises:
      ValueError: naming the field.
    """
    wanted = {"surrogate": Surrogate.TOKEN, "importance_sequence": False, "updates": 1, "minibatches": 1}
    for field, value in {**wanted, "enumerated": None}.items():
        if getattr(algorithm, field) != value:
            raise ValueError(
                f"{field} is {getattr(algorithm, field)}: must be {value} where score_centering is set; change either"
            )
    if not ratio_to_learner(algorithm):
        raise ValueError(f"stale is {algorithm.stale}: must be 0 for score_centering without importance_cap; set a cap")


def expected_score(
    algorithm: Algorithm, log_p: Float[Array, "*n K"] | None, log_q: Float[Array, "*n K"] | None
) -> Float[Array, "*n"]:
    """A number whose gradient is the mean score E_q[w ∇log p] under the sampler q, by its K most likely tokens.

        Σ_v sg(q_v w_v − α p_v) log p_v,   w = min(p/q, cap),   α = r min(1/r, cap),   r = (1 − Σ q) / (1 − Σ p)

    Without a cap, w is 1 and α = r.  The other tokens have q ≈ r p.  Subtracting this number from the score of each
    drawn token leaves Cov_q(A, w ∇log p) of E_q[A w ∇log p] and removes the learner's drift towards a different
    sampler: score centering (Marek & Ryabinin, arXiv 2609.20807, eq. 3 and 7 to 12).

    Args:
      algorithm: its `importance_cap` is the cap.
      log_p: the learner's log-probabilities of these tokens.
      log_q: the sampler's.

    Raises:
      ValueError: rollouts without the sampler's most likely tokens.
    """
    if log_p is None or log_q is None:
        raise ValueError(
            "score_centering is set, but rollouts lack the sampler's most likely tokens, which a server returns; "
            "set rollouts.url, or score_centering 0"
        )
    p, q, cap = jnp.exp(jax.lax.stop_gradient(log_p)), jnp.exp(log_q), algorithm.importance_cap
    tail = lambda x: jnp.maximum(1 - jnp.sum(x, -1, keepdims=True), LEAST_TAIL)
    ratio = tail(q) / tail(p)
    weighted, alpha = (q, ratio) if cap is None else (jnp.minimum(p, cap * q), jnp.minimum(1.0, cap * ratio))
    return jnp.sum((weighted - alpha * p) * log_p, -1)


def surrogate(
    algorithm: Algorithm,
    log_prob: Float[Array, "*n T"],
    old: Float[Array, "*n T"],
    mask: Bool[Array, "*n T"],
    advantage: Float[Array, "*n"] | Float[Array, "*n T"],
) -> tuple[Float[Array, "*n T"], Bool[Array, "*n T"]]:
    """Clipped policy-gradient objective of every token, to be maximised, and where the clip removed its gradient.

    TOKEN: min(ρ_t A, clip(ρ_t, 1 − low, 1 + high) A) with ρ_t = π/π_old (PPO, arXiv 1707.06347, eq. 7; DAPO, arXiv
    2503.14476, sets high above low).  SEQUENCE: the same with one ratio for all tokens, ρ = exp(1/|o| Σ_t log π/π_old),
    whose mean over a rollout is GSPO's objective (arXiv 2507.18071, eq. 5 and 7).  CISPO: sg(clip(ρ_t)) A log π_t, in
    which every token keeps its gradient and the flag marks a clipped weight (MiniMax-M1, arXiv 2506.13585, eq. 4).

    Args:
      algorithm: kind and clip range.
      log_prob: the learner's log-probabilities of the sampled tokens.
      old: those of the policy to which the ratio is relative.
      mask: which tokens exist; the values of others have no meaning.
      advantage: one number for a whole rollout, or one for each token.
    """
    a = advantage if advantage.ndim == log_prob.ndim else advantage[..., None]
    low, high, log_ratio = algorithm.clip_low, algorithm.clip_high, log_prob - old
    if algorithm.surrogate is Surrogate.SEQUENCE:
        log_ratio = masked.mean(log_ratio, mask, -1, keepdims=True)
    ratio = jnp.broadcast_to(_ratio(log_ratio), log_prob.shape)
    if algorithm.surrogate is Surrogate.CISPO:
        ratio = jax.lax.stop_gradient(ratio)
        weight = jnp.clip(ratio, 1.0 - low, 1.0 + high)
        return weight * a * log_prob, weight != ratio
    free, bound = ratio * a, jax.lax.stop_gradient(jnp.clip(ratio, 1.0 - low, 1.0 + high)) * a
    return jnp.where(free > bound, bound, free), free > bound  # `minimum` halves a gradient where both are equal


def divisor(config: GRPOConfig, mask: Bool[Array, "P G T"]) -> int | Float[Array, ""]:
    """N of `group_mean`: the rollouts' mean length (1 without tokens) if tokens are averaged over the batch, else T."""
    if config.algorithm.average is not Average.BATCH:
        return config.length
    return jnp.where(jnp.any(mask), jnp.mean(jnp.sum(mask, -1)), 1.0)


def over_tokens(weight: Float[Array, "P"], mask: Bool[Array, "P G T"]) -> Float[Array, "P"]:
    """Weights of prompts such that the mean over the batch's tokens includes only prompts that count."""
    length = jnp.mean(jnp.sum(mask, -1), -1)
    kept = jnp.sum(weight * length)
    return jnp.where(kept > 0, weight * jnp.sum(weight) * jnp.mean(length) / jnp.where(kept > 0, kept, 1.0), 0.0)


def group_mean(kind: Average, x: Float[Array, "*p G T"], mask: Bool[Array, "*p G T"], longest: int | Array) -> Array:
    """Mean over the tokens of each group, [*p].

    ROLLOUT: mean_i 1/|o_i| Σ_t x (GRPO).  TOKEN: Σ_i Σ_t x / Σ_i |o_i| (DAPO, arXiv 2503.14476, eq. 8), so that long
    rollouts weigh more.  LENGTH: mean_i 1/N Σ_t x with the longest allowed length N (Dr. GRPO), so that no length is
    favoured.  BATCH: the same with the mean length of the batch's rollouts as N: in the mean over prompts, all tokens
    of the batch weigh the same, as in DAPO's code.  What `mismatch_limit` drops counts in N, as in TRL (not in verl).

    Args:
      kind: one of these.
      x: value of each token.
      mask: which tokens exist.
      longest: N, which may differ from T.
    """
    match kind:
        case Average.ROLLOUT:
            return jnp.mean(masked.mean(x, mask, -1), -1)
        case Average.TOKEN:
            return masked.mean(x, mask, (-2, -1))
        case Average.LENGTH | Average.BATCH:
            return jnp.mean(masked.total(x, mask, -1), -1) / longest
        case _:
            assert_never(kind)


def token_terms(
    algorithm: Algorithm,
    tokens: Int[Array, "*n"],
    log_p: Float[Array, "*n V"],
    log_ref: Float[Array, "*n V"] | None,
    log_masked: Float[Array, "*n V"] | None,
) -> TokenTerms:
    """Terms of the sampled tokens from log-probabilities of the whole vocabulary.

    Args:
      algorithm: estimator of the reference KL, bound of the grounding, weights.
      tokens: the sampled ones.
      log_p: log-probabilities under the learner.
      log_ref: under the reference policy; `None` if β is 0.
      log_masked: under the learner with one stream of touch replaced by noise; `None` if γ is 0.
    """
    nothing = jnp.zeros(tokens.shape)
    if log_masked is not None and algorithm.grounding_stop_masked:
        log_masked = jax.lax.stop_gradient(log_masked)
    return TokenTerms(
        log_prob=token_log_probs(log_p, tokens),
        reference_kl=nothing if log_ref is None else reference_kl(algorithm.kl, log_p, log_ref, tokens),
        grounding=nothing if log_masked is None else at_most(exact_kl(log_p, log_masked), algorithm.grounding_cap_nat),
        entropy=entropy(jax.lax.stop_gradient(log_p) if left_out(algorithm.entropy_weight) else log_p),
    )


def reference_kl(
    estimator: KLEstimator, log_p: Float[Array, "*n V"], log_q: Float[Array, "*n V"], tokens: Int[Array, "*n"]
) -> Float[Array, "*n"]:
    """KL(p ‖ q) at each token: exact over the vocabulary, or estimated from the sampled token."""
    if estimator == "exact":
        return exact_kl(log_p, log_q)
    return estimated_kl(token_log_probs(log_p, tokens), token_log_probs(log_q, tokens), estimator)


def exact_kl(log_p: Float[Array, "*n V"], log_q: Float[Array, "*n V"]) -> Float[Array, "*n"]:
    """KL(p ‖ q) = Σ_v p_v (log p_v − log q_v) over the whole vocabulary, from log-probabilities."""
    return jnp.sum(jnp.exp(log_p) * (log_p - log_q), -1)


def estimated_kl(
    log_p: Float[Array, "*n"], log_q: Float[Array, "*n"], estimator: Literal["k1", "k2", "k3"]
) -> Float[Array, "*n"]:
    """Estimate of KL(p ‖ q) from the sampled token's log-probabilities, with r = q/p.

    k1 = −log r, k2 = (log r)²/2, k3 = r − 1 − log r (Schulman, "Approximating KL divergence", 2020).  Under samples of
    p and the gradient of the estimate itself, E[∇k1] = 0, E[∇k2] = ∇KL(p ‖ q) and E[∇k3] = ∇KL(q ‖ p) (arXiv
    2510.01555): as a loss, k3 penalises the reverse divergence.
    """
    log_r = jnp.clip(log_q - log_p, -LOG_RATIO_CLAMP, LOG_RATIO_CLAMP)
    if estimator == "k1":
        return -log_r
    if estimator == "k2":
        return 0.5 * log_r**2
    return jnp.expm1(log_r) - log_r


def token_log_probs(log_p: Float[Array, "*n V"], tokens: Int[Array, "*n"]) -> Float[Array, "*n"]:
    """Log-probability of each given token."""
    return jnp.take_along_axis(log_p, tokens[..., None], -1)[..., 0]


def entropy(log_p: Float[Array, "*n V"]) -> Float[Array, "*n"]:
    """Shannon entropy of each distribution, nat."""
    return -jnp.sum(jnp.exp(log_p) * log_p, -1)


def at_most(x: Float[Array, "*n"], bound: float | None) -> Float[Array, "*n"]:
    """min(x, bound), without gradient where x exceeds the bound; `None` is no bound."""
    return x if bound is None else jnp.minimum(x, bound)


def _ratio(log_ratio: Array) -> Array:
    return jnp.exp(jnp.clip(log_ratio, -LOG_RATIO_CLAMP, LOG_RATIO_CLAMP))
