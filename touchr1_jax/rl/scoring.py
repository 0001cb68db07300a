"""Reward of one rollout from its tokens, and groups that are left out because of their rewards."""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from touchr1_jax.rewards import STABLE, stable_weights
from touchr1_jax.rewards.base import AnyReward, Decode, Reward, total_reward
from touchr1_jax.rewards.proof import prove_rewards
from touchr1_jax.rl.advantages import neutralised, segment_advantages
from touchr1_jax.rl.config import Algorithm
from touchr1_jax.text.language import SEGMENTS
from touchr1_jax.text.parser import Parser
from touchr1_jax.types import Parsed, Target

ScoreFn = Callable[[Int[Array, "T"], Target], tuple[Float[Array, ""], dict[str, Array], Parsed]]
"""(tokens, target) → (total reward, its named terms, parsed completion), for one rollout."""


def reward_weights(algorithm: Algorithm, weights: Mapping[str, float]) -> dict[str, float]:
    """Weights of the rewards for an algorithm; under `stable_rewards`, the stable forms replace the published ones."""
    return stable_weights(weights) if algorithm.stable_rewards else dict(weights)


def require_stable_rewards(score: object) -> None:
    """Refuse a score with a reward in its published form, which answers without touch can exploit.

    Raises:
      ValueError: it names the rewards.
    """
    published = sorted(STABLE.keys() & score.weights.keys()) if isinstance(score, WeightedScore) else []
    if published:
        raise ValueError(
            f"stable_rewards is True, but the score weighs {', '.join(published)}: must weigh their stable forms; make "
            "it of `reward_weights(algorithm, weights)`, or set stable_rewards False"
        )


def ordinal_levels(score: object) -> int:
    """Most levels of an ordinal attribute of a score's language; 0 for a score without a `Parser`, which has none."""
    parser = score.parser if isinstance(score, WeightedScore) else None
    return parser.ordinal_levels if isinstance(parser, Parser) else 0


NONFINITE_IN = "nonfinite_in_"
"""Prefix of the metrics that name a reward: the share of groups in which it was NaN or infinite."""


def make_score(
    parser: Callable[[Int[Array, "T"]], Parsed],
    rewards: Mapping[str, AnyReward],
    weights: Mapping[str, float],
    decode: Decode | None = None,
) -> "WeightedScore":
    """Score by weighted rewards (see `rewards.base.total_reward`), each checked to be finite when the step is traced.

    Args:
      parser: in-graph parser.
      rewards: all rewards by name.
      weights: of each reward that is used.
      decode: from tokens to text, for rewards on the host.

    Raises (when traced):
      RewardError: a reward that gives NaN or infinity for some answer; it names the reward and the answer.
    """
    return WeightedScore(parser, rewards, weights, decode)


@dataclasses.dataclass(frozen=True, eq=False)
class WeightedScore:
    """A `ScoreFn` of weighted rewards that also states when the value of each is known; made by `make_score`."""

    parser: Callable[[Int[Array, "T"]], Parsed]
    rewards: Mapping[str, AnyReward]
    weights: Mapping[str, float]
    decode: Decode | None

    def __call__(self, tokens: Int[Array, "T"], target: Target) -> tuple[Array, dict[str, Array], Parsed]:
        """Total reward, its terms and the parsed answer of one rollout."""
        parsed = self.parser(tokens)
        reward, terms = total_reward(self.rewards, self.weights, parsed, target, tokens, self.decode)
        sensors, attributes = parsed.perceive.shape
        parser = self.parser
        levels, ordinal = (parser.levels, parser.ordinal) if isinstance(parser, Parser) else ((1,) * attributes, None)
        prove_rewards(self.rewards, self.weights, sensors, levels, tokens.shape[-1], ordinal)
        return reward, terms, parsed

    def segment_advantages(
        self,
        algorithm: Algorithm,
        reward: Float[Array, "P G"],
        terms: Mapping[str, Float[Array, "P G"]],
        tokens: Int[Array, "P G T"],
        finite: Bool[Array, "P"],
    ) -> Float[Array, "P G T"]:
        """`advantages.segment_advantages` of rollouts.

        Raises:
          ValueError: a parser without segments.
        """
        if not isinstance(self.parser, Parser):
            raise ValueError(f"parser is {self.parser!r}: must be a text.parser.Parser to find segments; use one")
        settled = {n: SEGMENTS.index(r.settled) for n, r in self.rewards.items() if isinstance(r, Reward)}
        segment = jax.vmap(jax.vmap(self.parser.segments))(tokens)
        return segment_advantages(algorithm, reward, terms, settled, segment, finite)


def left_out_groups(
    reward: Float[Array, "D G"], terms: Mapping[str, Float[Array, "D G"]]
) -> tuple[Float[Array, "D G"], dict[str, Float[Array, "D G"]], Bool[Array, "D"], dict[str, Float[Array, ""]]]:
    """Leave out groups with a NaN or infinite reward: the mean of all others replaces it and gives no gradient.

    Groups of which squares cannot be summed over the batch are left out too (`squares_fit`).

    Returns: Reward and terms without such numbers; true for each group that stays; and `nonfinite_in_TERM`, the share
      of groups in which a term was not finite (`nonfinite_in_total`: every term was finite, but not their sum or a
      square).
    """
    wide = lambda x: jnp.asarray(x, jnp.promote_types(jnp.result_type(x), jnp.float32))  # in 16 bits 300² is infinite
    reward, terms = wide(reward), {name: wide(term) for name, term in terms.items()}
    is_finite = lambda x: jnp.all(jnp.isfinite(x), -1)
    by_term = {name: is_finite(term) for name, term in terms.items()}
    all_terms = functools.reduce(jnp.logical_and, by_term.values(), jnp.ones(reward.shape[:1], bool))
    finite = functools.reduce(jnp.logical_and, map(squares_fit, (reward, *terms.values())), all_terms)
    neutral = lambda x: neutralised(x, finite)
    shares = {f"{NONFINITE_IN}{name}": jnp.mean(~each) for name, each in by_term.items()}
    shares[f"{NONFINITE_IN}total"] = jnp.mean(all_terms & ~finite)
    return neutral(reward), {name: neutral(term) for name, term in terms.items()}, finite, shares


def squares_fit(x: Float[Array, "D *n"]) -> Bool[Array, "D"]:
    """Groups with D Σ x² < ∞, so that no σ is infinite, of a group or of the batch: all advantages would be 0."""
    return jnp.isfinite(len(x) * jnp.sum(x**2, tuple(range(1, x.ndim))))
