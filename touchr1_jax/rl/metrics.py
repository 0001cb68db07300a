"""Metrics of every step: reward and its spread, accuracy, parse rate, agreement, lengths, touch."""

from collections.abc import Mapping

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax import masked
from touchr1_jax.models.policy import Features
from touchr1_jax.rl.advantages import zero_variance
from touchr1_jax.types import Parsed, Rollout, Target


def rollout_metrics(
    rollout: Rollout,
    reward: Float[Array, "P G"],
    no_signal: Bool[Array, "P"],
    finite: Bool[Array, "P"],
    parsed: Parsed,
    target: Target,
) -> dict[str, Array]:
    """Means over all rollouts; `middle_rate` and `middle_labels` over questions whose levels have a middle one.

    `reward` and `reward_std` are of the groups that are not left out.
    """
    asked = target.asked[:, None]
    label, middle = target.label[:, None], (target.levels[:, None] - 1) // 2
    has_middle = asked & (target.ordinal & (target.levels % 2 == 1))[:, None]
    right = (parsed.conclude == label) & (label >= 0)
    return {
        "reward": masked.mean(reward, finite[:, None]),
        "reward_std": masked.mean(jnp.std(reward, -1), finite),
        "degenerate_share": jnp.mean(no_signal),
        "accuracy": masked.mean(right, jnp.broadcast_to(asked, right.shape)),
        "middle_rate": masked.mean(parsed.conclude == middle, jnp.broadcast_to(has_middle, right.shape)),
        "middle_labels": masked.mean(label == middle, has_middle),
        "parse_rate": jnp.mean(parsed.formatted & jnp.all((parsed.conclude >= 0) | ~asked, -1)),
        "truncated_share": jnp.mean(parsed.truncated),
        "length": jnp.mean(jnp.sum(rollout.mask, -1)),
    }


def answer_metrics(parsed: Parsed, target: Target, levels: int) -> dict[str, Array]:
    """Distribution of the answers: accuracy of each level, the most frequent answer, slots that repeat each other.

    `right_level_k` is the share right of ordinal questions whose label is k, `labels_level_k` their number, for each
    k < `levels`, the most levels of an ordinal attribute (0 leaves these out);
    `mode_share` the share of the most frequent level among ordinal answers, `label_mode_share` among their labels;
    `echo_share` the share of formatted ordinal answers whose slots all name one level, `echo_right` that of the right
    ones among the same; `gamed_share` the share of answers that name levels and are not formatted or name several in
    their conclusion.
    """
    asked = jnp.broadcast_to((target.asked & target.ordinal)[:, None], parsed.conclude.shape)
    label = jnp.broadcast_to(target.label[:, None], asked.shape)
    right = parsed.conclude == label
    by_level = {k: asked & (label == k) for k in range(levels)}
    formatted = asked & parsed.formatted[..., None]
    same = jnp.all((parsed.perceive == parsed.compare[..., None, :]) | ~target.streams[:, None, :, None], -2)
    same &= (parsed.compare == parsed.conclude) & (parsed.conclude >= 0)
    named = jnp.any(parsed.perceive >= 0, (-1, -2)) | jnp.any(parsed.compare >= 0, -1)
    unread = ~parsed.formatted | ~jnp.any((parsed.conclude >= 0) & target.asked[:, None], -1)
    return {
        **{f"right_level_{k}": masked.mean(right, where) for k, where in by_level.items()},
        **{f"labels_level_{k}": jnp.sum(where).astype(jnp.float32) for k, where in by_level.items()},
        "mode_share": _mode_share(parsed.conclude, asked),
        "label_mode_share": _mode_share(jnp.broadcast_to(label, asked.shape), asked),
        "echo_share": masked.mean(same, formatted),
        "echo_right": masked.mean(right, formatted),
        "gamed_share": jnp.mean(named & unread),
    }


def _mode_share(level: Int[Array, "P G A"], counted: Bool[Array, "P G A"]) -> Array:
    """Share of the most frequent of the levels ≥ 0 that count; 0 without any."""
    ordered = jnp.sort(jnp.where(counted, level, -1), axis=None)
    alike = jnp.searchsorted(ordered, ordered, side="right") - jnp.searchsorted(ordered, ordered)
    return jnp.max(jnp.where(ordered >= 0, alike, 0)) / jnp.maximum(jnp.sum(ordered >= 0), 1)


def reward_metrics(
    terms: Mapping[str, Float[Array, "P G"]],
    right: Bool[Array, "P G"],
    no_signal: Bool[Array, "P"],
    finite: Bool[Array, "P"],
) -> dict[str, Array]:
    """Mean of each term; shares of groups whose answers are all right or all wrong, and of groups left out.

    `unsolved_share` is the share of groups that are neither all right nor left out, `idle_share` that of those among
    them without signal.
    """
    unsolved = finite & ~jnp.all(right, -1)
    return {
        **{f"reward_{name}": masked.mean(value, finite[:, None]) for name, value in terms.items()},
        "all_right_share": jnp.mean(jnp.all(right, -1)),
        "none_right_share": jnp.mean(~jnp.any(right, -1)),
        "unsolved_share": jnp.mean(unsolved),
        "idle_share": jnp.mean(unsolved & no_signal),
        "nonfinite_share": jnp.mean(~finite),
    }


def advantage_metrics(reward: Float[Array, "P G"], advantage: Float[Array, "P G"]) -> dict[str, Array]:
    """Size of the advantages, and number of groups whose rewards differ."""
    return {
        "advantage_abs": jnp.mean(jnp.abs(advantage)),
        "advantage_peak": jnp.max(jnp.abs(advantage)),
        "lively_groups": jnp.sum(~zero_variance(reward)).astype(jnp.float32),
    }


def touch_metrics(features: Features, step_tokens: int) -> dict[str, Array]:
    """`static_time_share`: share of streams with several steps, of `step_tokens` each, whose time ids are all equal;
    `touch_share`: share of prompts with any token of touch.
    """
    time, there = features.touch_time, features.touch_time >= 0
    several = features.stream_mask & (jnp.sum(there, -1) > step_tokens)
    low = masked.minimum(time, there, -1, empty=0.0)
    high = masked.maximum(time, there, -1, empty=0.0)
    return {
        "static_time_share": masked.mean(low == high, several),
        "touch_share": jnp.mean(jnp.any(features.stream_mask & jnp.any(there, -1), -1)),
    }
