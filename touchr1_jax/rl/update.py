"""The update of a step: one or several optimizer steps from the same rollouts."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl.config import GRPOConfig, ratio_to_learner
from touchr1_jax.rl.gradient import COUNTED, GROUNDING, PERTURBED, Experience, batches_of, grpo_gradient, log_probs
from touchr1_jax.rl.losses import divisor
from touchr1_jax.rl.trust_region import within_trust
from touchr1_jax.skipping import Skipping, count_lost
from touchr1_jax.types import Params

LOST = "lost_updates"
"""Metric: optimizer steps that were left out, because the gradient or the policy after them was not finite."""

Gradient = tuple[Params, dict[str, Array], Float[Array, "P G T"]]
"""Gradient, parts and old log-probabilities, as `grpo_gradient` returns them."""


def update_policy(
    fns: PolicyFns,
    optimizer: optax.GradientTransformation,
    config: GRPOConfig,
    params: Params,
    opt_state: optax.OptState,
    reference: Params,
    learn: Experience,
) -> tuple[Params, optax.OptState, dict[str, Array]]:
    """Make μ passes over the same rollouts, each with one optimizer step per minibatch.

    Ratios are relative to the learner before the first step, which needs an extra forward pass with minibatches.  At
    the same parameters, the mean of the minibatches' gradients is the gradient of the whole batch.

    Returns:
      Parameters, state of the optimizer, and parts of the first pass, with `clip_share` of the last and `LOST` of all.
    """
    algorithm, longest = config.algorithm, divisor(config, learn.rollout.mask)
    number, count = algorithm.minibatches, algorithm.updates
    if number > 1:
        alone = dataclasses.replace(algorithm, minibatches=1)
        config = dataclasses.replace(config, algorithm=alone, prompts=config.prompts // number)
        old = log_probs(fns, config, params, learn.batch, learn.rollout) if ratio_to_learner(algorithm) else learn.old
        learn = learn._replace(old=old, weight=number * learn.weight)
    before = None  # what a trust region is measured from, where that is not what ratios are to
    if algorithm.trust_nat is not None and not ratio_to_learner(algorithm):
        before = log_probs(fns, config, params, learn.batch, learn.rollout)
    whole = (learn, before)
    minibatches = whole if number == 1 else batches_of(config.prompts, whole)

    def once(carry: tuple[Params, optax.OptState, Array], place: Any):
        params, opt_state, old = carry
        first, which = place
        part, origin = minibatches if number == 1 else jax.tree.map(lambda x: x[which], minibatches)
        part = part._replace(old=old) if number == 1 else part
        grads, parts, old = bucketed_gradient(fns, config, params, reference, part, first, longest)
        norm = optax.tree.norm(grads)
        moved, after = finite_update(optimizer, grads, norm, opt_state, params)
        lost = ~jnp.isfinite(norm)
        if (trust := algorithm.trust_nat) is not None:
            part = part._replace(old=old if origin is None else origin)
            moved, size = within_trust(fns, config, params, moved, part, trust)
            parts, too_far = parts | size, size["update_scale"] == 0
            lost, after = lost | too_far, count_lost(opt_state, after, too_far)
        parts = parts | {"grad_norm": norm, LOST: lost.astype(jnp.float32)}
        return (moved, after, old if number == 1 else learn.old), parts

    start = (params, opt_state, learn.old)
    if number == count == 1:
        (params, opt_state, _), parts = once(start, (True, 0))
        return params, opt_state, parts
    steps = jnp.arange(number * count)
    places = ((steps == 0) & (number == 1), steps % number)
    (params, opt_state, _), all_parts = jax.lax.scan(once, start, places)
    of_pass = lambda steps: over_minibatches({name: x[steps] for name, x in all_parts.items()})
    parts, last = of_pass(slice(number)), of_pass(slice(-number, None))
    return params, opt_state, parts | {"clip_share": last["clip_share"], LOST: jnp.sum(all_parts[LOST])}


def over_minibatches(parts: dict[str, Float[Array, "n"]]) -> dict[str, Float[Array, ""]]:
    """Metrics over all minibatches: the largest peak, sums of counts, means of all others.

    Those of `COUNTED`, and the grounding of a stream, are weighted by the number of prompts that they are of.
    """
    found = {name: (jnp.max if name.endswith("_peak") else jnp.mean)(x) for name, x in parts.items()}
    streams = {GROUNDING + n.removeprefix(PERTURBED): n for n in parts if n.startswith(PERTURBED)}
    for mean, name in ((m, n) for m, n in (COUNTED | streams).items() if m in parts):
        found[name] = jnp.sum(count := parts[name])
        found[mean] = jnp.sum(count * parts[mean]) / jnp.maximum(found[name], 1.0)
    return found


def finite_update(
    optimizer: optax.GradientTransformation,
    grads: Params,
    norm: Float[Array, ""],
    opt_state: optax.OptState,
    params: Params,
) -> tuple[Params, optax.OptState]:
    """Parameters and optimizer state after a gradient; unchanged if its norm is NaN or infinite.

    An optimizer of `skipping.skip_nonfinite` handles and counts such gradients itself; any other receives zeros
    instead, and its result is discarded; one of `skip_nonfinite` inside it, as in `optax.MultiSteps`, counts them too.
    """
    if isinstance(opt_state, Skipping):
        updates, opt_state = optimizer.update(grads, opt_state, params)
        return optax.apply_updates(params, updates), opt_state
    finite = jnp.isfinite(norm)
    pick = lambda new, old: jnp.where(finite, new, old)
    updates, after = optimizer.update(jax.tree.map(lambda g: pick(g, jnp.zeros_like(g)), grads), opt_state, params)
    moved, after = jax.tree.map(pick, (optax.apply_updates(params, updates), after), (params, opt_state))
    return moved, count_lost(opt_state, after, ~finite)


def bucketed_gradient(
    fns: PolicyFns,
    config: GRPOConfig,
    params: Params,
    reference: Params,
    learn: Experience,
    first: bool | Bool[Array, ""] = True,
    longest: int | Float[Array, ""] | None = None,
) -> Gradient:
    """`grpo_gradient` over the tokens of the shortest bucket that holds rollouts, levels and answers."""
    lengths = (*config.buckets, config.length)

    def over(length: int) -> Callable[[Params], Gradient]:
        cut = lambda x: x[..., :length]
        rollout, by_token, answer = jax.tree.map(cut, (learn.rollout, learn.token_advantage, _answers(learn)))
        batch = dataclasses.replace(learn.batch, **answer)
        short = learn._replace(batch=batch, rollout=rollout, old=cut(learn.old), token_advantage=by_token)

        def of(params: Params) -> Gradient:
            grads, parts, old = grpo_gradient(fns, config, params, reference, short, first=first, longest=longest)
            return grads, parts, jnp.pad(old, [(0, 0), (0, 0), (0, config.length - length)])

        return of

    if len(lengths) == 1:
        return over(config.length)(params)
    bucket = jnp.sum(jnp.asarray(lengths) < _longest(config, learn))
    return jax.lax.switch(bucket, [over(length) for length in lengths], params)


def _answers(learn: Experience) -> dict[str, Array]:
    """The verified answers of a batch by the names of its fields; none without an anchor."""
    return {} if learn.batch.answer is None else {n: getattr(learn.batch, n) for n in ("answer", "answer_mask")}


def _longest(config: GRPOConfig, learn: Experience) -> Int[Array, ""]:
    """Most tokens that count of a rollout, up to its level where it is enumerated, or of an answer.

    A rollout that is cut off may be masked, and its level has a part in the advantages of the others all the same.
    """
    counts = [jnp.max(jnp.sum(learn.rollout.mask, -1))]
    if learn.levels is not None:
        counts.append(jnp.max(jnp.where(learn.levels.at < config.length, learn.levels.at + 1, 0)))
    if learn.batch.answer_mask is not None:
        counts.append(jnp.max(jnp.sum(learn.batch.answer_mask, -1)))
    return jnp.max(jnp.stack(counts))
