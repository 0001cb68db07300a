"""Gradient of the GRPO loss: forward passes of the policies, prompt by prompt, in micro-batches.

For each prompt, the policy and the reference encode the prefix once and pass over the whole group; the perturbed policy
encodes only what follows the first perturbed token.  Logits exist only in `prompt_terms`, and in blocks if the
vocabulary is large.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.chunked_logits import Rows, by_blocks
from touchr1_jax.models.lm import PrefixCache
from touchr1_jax.models.policy import Features
from touchr1_jax.models.policy_fns import PolicyFns
from touchr1_jax.rl.config import GRPOConfig, Paper, at_precision, left_out, loss_beta, ratio_to_learner
from touchr1_jax.rl.enumerated import LevelRewards
from touchr1_jax.rl.losses import TokenTerms, divisor, grpo_loss, token_log_probs, token_terms
from touchr1_jax.rl.rollout import GRPOBatch, drawn_log_probs, tempered, truncates
from touchr1_jax.types import Params, Rollout

GROUNDING, PERTURBED = "grounding_stream_", "perturbed_stream_"
"""Metrics of each stream, followed by its number: mean G of the prompts in which it was perturbed, and their number."""

COUNTED = {
    **dict.fromkeys(("kl", "grounding", "entropy", "clip_share"), "kept_prompts"),
    "sampler_gap": "drawn_prompts",
}
"""Metrics that a prompt without tokens has no part in, and the number of the others."""


class Experience(NamedTuple):
    """Rollouts and what an update needs to learn from them; every field has a leading P.

    `old` are the learner's log-probabilities before the first of several updates, to which ratios are relative.
    """

    batch: GRPOBatch
    masked_touch: Float[Array, "P S N D"]
    masked_stream: Int[Array, "P"]
    rollout: Rollout
    old: Float[Array, "P G T"]
    advantage: Float[Array, "P G"]
    weight: Float[Array, "P"]
    token_advantage: Float[Array, "P G T"] | None = None
    """Advantage of each token, in the place of the rollout's, where segments are credited apart."""
    levels: LevelRewards | None = None
    """Rewards of every conclusion, which the loss reads in the place of `advantage` where it is enumerated."""


def grpo_gradient(
    fns: PolicyFns,
    config: GRPOConfig,
    params: Params,
    reference: Params,
    experience: Experience,
    *,
    first: bool | Bool[Array, ""] = True,
    longest: int | Float[Array, ""] | None = None,
) -> tuple[Params, dict[str, Array], Float[Array, "P G T"]]:
    """Gradient of `grpo_loss` with respect to the parameters, summed over micro-batches of `micro_prompts` prompts.

    Args:
      fns, config: as in `make_grpo_step`.
      params: the learner.
      reference: the policy from which the KL is measured.
      experience: rollouts with their advantages.
      first: true before the first update from this experience: the learner's own log-probabilities are then the old
        ones, so that every ratio is 1 for any precision of the sampler.  If the sampler lags and no weights correct
        for it, ratios are relative to `experience.old` at every update.
      longest: `losses.divisor` of the whole batch, if this experience is a part of it.

    Returns:
      The gradient; the loss and the mean of each of its parts over prompts (of a peak the largest), without parts of
      weight 0, which are not computed; and the log-probabilities to which the ratios are relative.
    """
    algorithm = config.algorithm
    longest = divisor(config, experience.rollout.mask) if longest is None else longest

    def loss(params: Params, micro: Experience) -> tuple[Array, tuple[dict[str, Array], Array]]:
        terms = experience_terms(fns, config, params, reference, micro)
        old = micro.old
        if ratio_to_learner(algorithm):
            old = jnp.where(first, jax.lax.stop_gradient(terms.log_prob), old)
        rollout, w = micro.rollout, micro.weight
        a = micro.advantage if micro.token_advantage is None else micro.token_advantage
        answer = None
        if terms.answer_log_prob is not None and micro.batch.answer_mask is not None:
            answer = masked.mean(terms.answer_log_prob, micro.batch.answer_mask, -1)
        rollouts = old, rollout.log_prob, rollout.mask, a, w
        head = None if rollout.head_log_prob is None else jnp.moveaxis(rollout.head_log_prob, -2, -1)
        value, parts = grpo_loss(terms, *rollouts, config, longest, answer, micro.levels, head)
        parts |= {"loss": value} if answer is None else {"loss": value, "answer_likelihood": answer}
        return value, (parts, old)

    def add_micro_batch(grads: Params, micro: Experience) -> tuple[Params, tuple[dict[str, Array], Array]]:
        more, found = jax.grad(loss, has_aux=True)(params, micro)
        return jax.tree.map(jnp.add, grads, more), found

    zero = jax.tree.map(jnp.zeros_like, params)
    grads, (by_prompt, old) = jax.lax.scan(add_micro_batch, zero, batches_of(config.micro_prompts, experience))
    parts = _over_prompts(by_prompt)
    measured = {"kl": not left_out(loss_beta(algorithm)), "grounding": not left_out(algorithm.gamma)}
    parts = {name: x for name, x in parts.items() if measured.get(name.removesuffix("_peak"), True)}
    if measured["kl"]:
        parts["kl_cost_peak"] = loss_beta(algorithm) * parts["kl_peak"]
    if measured["grounding"]:
        parts |= _grounding_by_stream(in_order(by_prompt["grounding"]), in_order(by_prompt["kept_prompts"]), experience)
    return grads, parts, in_order(old)


def batches_of(size: int, tree: Any) -> Any:
    """Arrays [P, …] cut into [P / size, size, …], neighbours into different batches.

    If devices share the prompts, neighbours lie on one device, so each device has a part of every batch.
    """
    cut = lambda x: x.reshape(size, x.shape[0] // size, *x.shape[1:])  # not −1: a prompt without a view has 0 tokens
    return jax.tree.map(lambda x: cut(x).swapaxes(0, 1), tree)


def in_order(x: Array) -> Array:
    """Inverse of `batches_of` for one array [P, …]."""
    return x.swapaxes(0, 1).reshape(-1, *x.shape[2:])


def log_probs(
    fns: PolicyFns, config: GRPOConfig, params: Params, batch: GRPOBatch, rollout: Rollout
) -> Float[Array, "P G T"]:
    """Log-probabilities of the sampled tokens under some parameters."""
    plain = dataclasses.replace(config, algorithm=Paper(beta=0.0, gamma=0.0, advantage=config.algorithm.advantage))
    each = jnp.ones(rollout.mask.shape[:2])
    stream = jnp.zeros(len(each), jnp.int32)
    learn = Experience(batch, batch.features.touch, stream, rollout, rollout.log_prob, each, each[:, 0])
    of_micro_batch = lambda micro: experience_terms(fns, plain, params, params, micro).log_prob
    return in_order(jax.lax.map(of_micro_batch, batches_of(config.micro_prompts, learn)))


def _over_prompts(by_prompt: Mapping[str, Array]) -> dict[str, Array]:
    """Sum of the loss and of counts, largest peaks, means of all others; those of `COUNTED` over what they are of."""
    sums = {"loss", *COUNTED.values()}
    over = lambda name: jnp.sum if name in sums else jnp.max if name.endswith("_peak") else jnp.mean
    means = {name: masked.mean(by_prompt[name], by_prompt[which] > 0) for name, which in COUNTED.items()}
    return {name: over(name)(value) for name, value in by_prompt.items()} | means


def _grounding_by_stream(
    grounding: Float[Array, "P"], kept: Float[Array, "P"], experience: Experience
) -> dict[str, Array]:
    """Mean G of the kept prompts in which each stream was perturbed, and how many they were."""
    streams = experience.batch.features.stream_mask
    found = {}
    for s in range(streams.shape[1]):
        perturbed = (experience.masked_stream == s) & streams[:, s] & (kept > 0)
        found[f"{GROUNDING}{s}"] = masked.mean(grounding, perturbed)
        found[f"{PERTURBED}{s}"] = jnp.sum(perturbed).astype(jnp.float32)
    return found


def experience_terms(
    fns: PolicyFns, config: GRPOConfig, params: Params, reference: Params, micro: Experience
) -> TokenTerms:
    """`prompt_terms` of every prompt of a micro-batch; a single prompt is not batched, so that its branches stay."""
    terms = lambda e: prompt_terms(fns, config, params, reference, e)
    if micro.weight.shape[0] > 1:
        return jax.vmap(terms)(micro)
    return jax.tree.map(lambda x: x[None], terms(jax.tree.map(lambda x: x[0], micro)))


def prompt_terms(
    fns: PolicyFns, config: GRPOConfig, params: Params, reference: Params, experience: Experience
) -> TokenTerms:
    """Terms of every token of one prompt's group, [G, T], with at most `max_logits` logits of each policy at once.

    At β = 0 the reference is not run, unless conclusions follow it, and at γ = 0 the perturbed policy is not run.  With
    an anchor, the verified answer is one more completion of the policy's group.

    Raises:
      ValueError: an anchor, and a batch without answers.
    """
    algorithm, batch, tokens = config.algorithm, experience.batch, experience.rollout.tokens
    anchored = not left_out(algorithm.anchor)
    if anchored and (batch.answer is None or batch.answer_mask is None):
        raise ValueError("anchor is above 0, but the batch holds no verified answers; make it with evidence, or set 0")
    group = jnp.concatenate([tokens, batch.answer[None]]) if anchored and batch.answer is not None else tokens
    all_own, prefix = group_states(fns, config, batch, group)(params, batch.features)
    own = jax.tree.map(lambda x: x[: tokens.shape[0]], all_own)
    states = group_states(fns, config, batch, tokens)
    rows: Rows = {"own": own, "token": tokens}
    if algorithm.score_centering and experience.rollout.head_ids is not None:
        rows["head"] = jnp.moveaxis(experience.rollout.head_ids, -2, -1)
    if not (left_out(loss_beta(algorithm)) and algorithm.learn_conclusion):
        rows["reference"] = jax.lax.stop_gradient(states(reference, batch.features)[0])
    if not left_out(algorithm.gamma):
        rows["perturbed"] = perturbed_states(fns, config, params, experience, prefix)
    heads = {"own": params, "reference": reference, "perturbed": _masked_branch(config, params)}
    heads = {name: at_precision(config, p) for name, p in heads.items()}

    def of_rows(rows: Rows) -> TokenTerms:
        logits = {name: fns.logits(p, rows[name]) for name, p in heads.items() if name in rows}
        return logit_terms(config, rows["token"], logits, rows.get("head"))

    if config.remat:
        of_rows = jax.checkpoint(of_rows, policy=jax.checkpoint_policies.dots_with_no_batch_dims_saveable)
    rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
    found = by_blocks(of_rows, rows, width=len(fns.banned), most=config.max_logits)
    terms = jax.tree.map(lambda x: x.reshape(*tokens.shape, *x.shape[1:]), found)
    if anchored:
        of_answer = {"own": jax.tree.map(lambda x: x[-1], all_own), "token": batch.answer}
        log_prob = lambda r: token_log_probs(jax.nn.log_softmax(fns.logits(heads["own"], r["own"])), r["token"])
        scores = by_blocks(log_prob, of_answer, width=len(fns.banned), most=config.max_logits)
        terms = terms._replace(answer_log_prob=scores)
    if experience.levels is None:
        return terms
    return terms._replace(level_log_prob=level_log_probs(fns, config, heads["own"], own, experience.levels))


def level_log_probs(
    fns: PolicyFns, config: GRPOConfig, params: Params, states: Any, levels: LevelRewards
) -> Float[Array, "G K"]:
    """log π of each level where each completion of one prompt concludes; −∞ past the last level."""
    here = jax.tree.map(lambda x: jax.vmap(lambda row, at: row[at])(x, jnp.minimum(levels.at, x.shape[1] - 1)), states)
    log_p = jax.nn.log_softmax(tempered(fns.logits(params, here), config.temperature))
    return jnp.where(levels.ids >= 0, log_p[:, levels.ids], -jnp.inf)


def logit_terms(
    config: GRPOConfig,
    tokens: Int[Array, "*n"],
    logits: Mapping[str, Float[Array, "*n V"]],
    head: Int[Array, "*n K"] | None = None,
) -> TokenTerms:
    """`token_terms` from logits of the policies `own` and, where they are run, `reference` and `perturbed`.

    `head` are the sampler's most likely tokens, where scores are centered.
    """
    log = {name: jax.nn.log_softmax(tempered(x, config.temperature)) for name, x in logits.items()}
    terms = token_terms(config.algorithm, tokens, log["own"], log.get("reference"), log.get("perturbed"))
    if head is not None:
        terms = terms._replace(head_log_prob=jnp.take_along_axis(log["own"], head, -1))
    if not truncates(config.top_p, config.min_p):
        return terms
    return terms._replace(log_prob=drawn_log_probs(log["own"], tokens, config.top_p, config.min_p))


def group_states(
    fns: PolicyFns, config: GRPOConfig, batch: GRPOBatch, tokens: Int[Array, "G T"]
) -> Callable[..., tuple[Any, PrefixCache]]:
    """The function (params, features, known, start) → states of one prompt's completions, as `fns.logits` takes them,
    and their prefix."""
    if config.remat:
        fns = dataclasses.replace(fns, module=fns.module.clone(remat=True))

    def states(params: Params, features: Features, known: PrefixCache | None = None, start: int = 0):
        params = at_precision(config, params)
        return fns.group_states(params, features, batch.ids, batch.mask, tokens, known, start)

    return states


def perturbed_states(
    fns: PolicyFns, config: GRPOConfig, params: Params, experience: Experience, prefix: PrefixCache
) -> Any:
    """Hidden states of the completions under perturbed touch.

    A single prompt is encoded again from the perturbed stream's first token, a batch from the first stream's, because a
    batch would compute the branches of all streams.

    Args:
      prefix: the prompt as the policy encodes it.
    """
    states = group_states(fns, config, experience.batch, experience.rollout.tokens)
    features = dataclasses.replace(experience.batch.features, touch=experience.masked_touch)
    known, own = _masked_branch(config, prefix), _masked_branch(config, params)
    starts = fns.touch_starts

    def again(start: int, p: Params) -> Any:
        return states(p, features, known, start)[0]

    if config.micro_prompts > 1:
        return again(min(starts), own)
    return jax.lax.switch(experience.masked_stream, [functools.partial(again, start) for start in starts], own)


def _masked_branch(config: GRPOConfig, tree: Any) -> Any:
    """Parameters or states of the perturbed branch, without gradient where `grounding_stop_masked` is set."""
    return jax.lax.stop_gradient(tree) if config.algorithm.grounding_stop_masked else tree
