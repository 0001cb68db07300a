"""R_tu, the reward for answers that are better than those of the policy without touch.

With s = max(R_acc, 0) and, for each control c of the touch, the mean s̄^c of its own rollouts: b = max_c s̄^c.
  Literal:      m_i = 1[s̄ > b + δ] · 1[d_i = 0], added to the reward (Touch-R1, arXiv 2605.27154, abstract).
  Recommended:  m_i = 1[s̄ > b + δ] · 1[formatted_i] · max(0, s_i − b), added to the advantage.
Both are 0 where nothing is right, and the recommended one does not cancel when all right rollouts earn it.

b is the largest mean of the controls that apply, so R_tu is paid by chance more often with fewer controls: at δ = .13,
in groups of 8 with 4 rollouts per control, if touch does not help, in up to 9 % of groups with three controls, 15 %
with two and 32 % with one (`credit_odds.false_credit`).  `control_missing_share` logs the share that does not apply.
"""

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from touchr1_jax import masked
from touchr1_jax.models.policy import Features
from touchr1_jax.rewards.accuracy import accuracy
from touchr1_jax.rl.advantages import SPREAD_FLOOR, advantages, of_kept_groups, zero_variance
from touchr1_jax.rl.config import Algorithm, TactileUse
from touchr1_jax.rl.counterfactual import Perturbed, drop_touch, noise_touch, shuffle_touch, swap_touch
from touchr1_jax.rl.rollout import GRPOBatch
from touchr1_jax.types import Parsed, Target

CONTROLS = ("drop", "noise", "order")
"""Names of the controls, in the order of `controls`."""

TERM = "tactile_use"
"""Name of the literal bonus among the terms of the reward."""

UNMOVED = 1e-2
"""A bonus that changes advantages by less, a hundredth of a standard deviation, has no effect."""

AnswerFn = Callable[[Features, Array], Parsed]
"""(features of D prompts, key) → parsed answers [D, J] of the policy to the same questions with that touch."""


def tactile_bonus(
    algorithm: Algorithm, parsed: Parsed, batch: GRPOBatch, noise: Float[Array, "K S N D"], answer: AnswerFn, key: Array
) -> tuple[Float[Array, "P G"], dict[str, Array]]:
    """Bonus m of each rollout, and metrics of the controls.

    `lead_NAME` is the lead of touch over a control in the prompts to which that applies; `touch_score` is of all.

    Args:
      algorithm: literal or recommended, δ.
      parsed: the rollouts' answers.
      batch: the prompts.
      noise: encoded noise as in `grpo.FrozenInputs`.
      answer: samples answers under perturbed touch.
      key: randomness of the perturbations and of the answers.
    """
    keys = jax.random.split(key, 5)
    scored = jax.vmap(jax.vmap(score, in_axes=(0, None)))
    own = scored(parsed, batch.target)
    control, counts = [], []
    for perturbed, draw_key in zip(controls(algorithm, batch, noise, keys), keys[2:], strict=True):
        control.append(scored(answer(perturbed.features, draw_key), batch.target))
        counts.append(perturbed.applies)
    by_prompt, applies = jnp.stack(control, 1), jnp.stack(counts, 1)
    best = jax.vmap(bar)(by_prompt, applies)
    if algorithm.tactile_use is TactileUse.LITERAL:
        is_right = jax.vmap(jax.vmap(right, in_axes=(0, None)))(parsed, batch.target)
        bonus = jax.vmap(literal, in_axes=(0, 0, 0, None))(own, best, is_right, algorithm.tactile_margin)
    else:
        bonus = jax.vmap(recommended, in_axes=(0, 0, 0, None))(own, best, parsed.formatted, algorithm.tactile_margin)
    lead = jnp.mean(own, -1, keepdims=True) - jnp.mean(by_prompt, -1)
    return bonus, {
        "touch_score": jnp.mean(own),
        **{f"lead_{n}": masked.mean(lead[:, i], applies[:, i]) for i, n in enumerate(CONTROLS)},
        **{f"control_{n}": masked.mean(by_prompt[:, i], applies[:, i, None]) for i, n in enumerate(CONTROLS)},
        **{f"control_{n}_share": jnp.mean(applies[:, i]) for i, n in enumerate(CONTROLS)},
        "tactile_credit_share": jnp.mean(jnp.any(bonus > 0, -1)),
        "control_missing_share": 1 - jnp.mean(applies),
        "credit_unearned_share": jnp.mean(jnp.any((bonus > 0) & (own <= 0), -1)),
    }


def controls(
    algorithm: Algorithm, batch: GRPOBatch, noise: Float[Array, "K S N D"], keys: Array
) -> tuple[Perturbed, Perturbed, Perturbed]:
    """Touch under R_tu's three controls: dropped, replaced by noise, and out of order.

    Literal: the third control is a shuffle, which applies if the question is marked as depending on order.
    Recommended: other questions get another object's touch instead, so that a policy that only detects noise does not
    pass.
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


def bonus_metrics(
    algorithm: Algorithm,
    reward: Float[Array, "P G"],
    terms: Mapping[str, Float[Array, "P G"]],
    bonus: Float[Array, "P G"],
    advantage: Float[Array, "P G"],
    finite: Bool[Array, "P"],
) -> dict[str, Array]:
    """Share of groups with different bonuses, and of those among them whose advantages ignore the bonuses.

    Groups that are left out, not `finite`, are in neither share: alarm F15 counts them.
    """
    if algorithm.tactile_use is TactileUse.LITERAL:
        reward = reward - terms[TERM]
        terms = {name: term for name, term in terms.items() if name != TERM}
    without = of_kept_groups(algorithm, advantages(algorithm, reward, terms, finite), finite)
    moved = jnp.max(jnp.abs(advantage - without), -1)
    differs = finite & ~zero_variance(bonus)
    return {"bonus_telling_share": jnp.mean(differs), "bonus_cancelled_share": jnp.mean(differs & (moved < UNMOVED))}


def score(parsed: Parsed, target: Target) -> Float[Array, ""]:
    """s = max(R_acc, 0) of one rollout."""
    return jnp.maximum(accuracy(parsed, target), 0.0)


def right(parsed: Parsed, target: Target) -> Bool[Array, ""]:
    """d = 0: every asked attribute is answered right; no answer matches an unknown label (−1)."""
    return jnp.all(((parsed.conclude == target.label) & (target.label >= 0)) | ~target.asked)


def bar(control: Float[Array, "C J"], counts: Bool[Array, "C"]) -> Float[Array, ""]:
    """b = max_c mean_j s_j^c over the controls that apply; if none applies, 1, which no reward exceeds.

    Args:
      control: s of the rollouts under each control.
      counts: controls that apply to this prompt; a shuffle applies if order matters.
    """
    return masked.maximum(jnp.mean(control, -1), counts, empty=1.0)


def literal(
    own: Float[Array, "G"], best: Float[Array, ""], is_right: Bool[Array, "G"], margin: float
) -> Float[Array, "G"]:
    """1[s̄ > b + δ] · 1[d_i = 0]."""
    return (leads(own, best, margin) & is_right).astype(jnp.float32)


def recommended(
    own: Float[Array, "G"], best: Float[Array, ""], formatted: Bool[Array, "G"], margin: float | Array
) -> Float[Array, "G"]:
    """1[s̄ > b + δ] · 1[formatted_i] · max(0, s_i − b)."""
    return jnp.where(leads(own, best, margin) & formatted, jnp.maximum(own - best, 0.0), 0.0)


def leads(own: Float[Array, "G"], best: Float[Array, ""], margin: float | Array) -> Bool[Array, ""]:
    """s̄ > b + δ, by more than the rounding of equal means of different rollouts."""
    return jnp.mean(own) > best + margin + SPREAD_FLOOR
