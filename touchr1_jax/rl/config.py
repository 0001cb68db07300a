"""Settings of the GRPO algorithm and the presets that reports name.

A preset is a dataclass of its own, so that the command line can choose it: `… grpo.algorithm:stable`.
"""

import dataclasses
import enum
from typing import Any, Literal

import jax
import jax.numpy as jnp

from touchr1_jax.models.chunked_logits import MAX_LOGITS
from touchr1_jax.models.layers import TEMPERATURES
from touchr1_jax.types import Params
from touchr1_jax.validation import above, at_least, within

KLEstimator = Literal["k1", "k2", "k3", "exact"]
"""Estimators of the KL to the reference (see `losses.estimated_kl`); under top-p or min-p `exact` alone is unbiased."""


class Surrogate(enum.Enum):
    """Ratio π/π_old that is clipped (see `losses.surrogate`)."""

    TOKEN = "token"
    SEQUENCE = "sequence"
    CISPO = "cispo"


class Average(enum.Enum):
    """Mean over the tokens of a group (see `losses.group_mean`)."""

    ROLLOUT = "rollout"
    TOKEN = "token"
    """Over the tokens of each prompt's group, then over prompts."""
    BATCH = "batch"
    """Over the tokens of the whole batch."""
    LENGTH = "length"


class Advantage(enum.Enum):
    """Comparison that makes an advantage of a reward (see `advantages`)."""

    GROUP = "group"
    BATCH = "batch"
    NONE = "none"
    LEAVE_ONE_OUT = "leave-one-out"
    GLOBAL = "global"
    PER_REWARD = "per-reward"


class Norm(enum.Enum):
    """Divisor of expected rewards where the conclusion is enumerated (see `enumerated`)."""

    NONE = "none"
    STD = "std"
    MEAN = "mean"


class TactileUse(enum.Enum):
    """Form of R_tu, the reward for answers that controls without touch do not reach (see `tactile_use`)."""

    OFF = "off"
    LITERAL = "literal"
    RECOMMENDED = "recommended"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Algorithm:
    """The objective of an update and how groups are chosen for it; the defaults are Touch-R1's (arXiv 2605.27154).

    The paper gives no value of `gamma`, the clip range and `epsilon`; these are ours, and so is the population σ.
    Weights may be traced scalars, so that one program serves a sweep over them; their sign is then not checked.
    """

    surrogate: Surrogate = Surrogate.TOKEN
    clip_low: float = 0.2
    """Clip range of the ratio below 1."""
    clip_high: float = 0.2
    """Clip range of the ratio above 1."""
    importance_cap: float | None = None
    """Largest weight of a token for π_learner/π_sampler (truncated importance sampling); `None` trusts the sampler."""
    importance_sequence: bool = False
    """Weight whole rollouts by the product of their ratios, at most `importance_cap`, instead of each token."""
    mismatch_limit: float | None = None
    """Largest mean |log π_old − log π_sampler| of a rollout, nat a token (`losses.grpo_loss`); others are left out."""
    score_centering: int = 0
    """Most likely tokens of the sampler, from which the drift towards it is computed and subtracted; 0 leaves it in."""
    average: Average = Average.ROLLOUT
    advantage: Advantage = Advantage.GROUP
    """Mean and σ that a reward is compared with: the group's, one σ for the batch, none, …"""
    best_of: int = 1
    """Compare rewards by the best of k rollouts, pass@k or max@k (see `best_of`); 1 compares single rollouts."""
    enumerated: Norm | None = None
    """Enumerate the concluding level, compared by this norm, not `advantage` (see `enumerated`); `None` samples it."""
    learn_conclusion: bool = True
    """Learn the concluding level; False needs `enumerated`, and the level follows the reference (KL, weight 1)."""
    segment_credit: bool = False
    """Credit a token only with rewards that are not known before its segment (`advantages.segment_advantages`)."""
    stable_rewards: bool = False
    """Replace each published reward by a form that no answer without touch exploits (`rewards.STABLE`)."""
    epsilon: float = 1e-4
    """Added to σ, in the units of the reward."""
    drop_degenerate: bool = False
    """Leave groups of equal rewards out of the policy-gradient mean; KL and G_tg keep all."""
    candidates: int = 1
    """Prompts sampled for each prompt of the update; groups without signal are skipped (see `advantages.no_signal`)."""
    mask_truncated: bool = False
    """Leave rollouts without an end token out of the loss; their rewards still count in the group."""
    constrained: bool = False
    """Sample only tokens from which a formatted answer can still follow; the learner scores them without constraint."""
    beta: float = 1e-3
    """Weight of the KL to the reference."""
    kl: KLEstimator = "k3"
    kl_in_reward: bool = False
    """Subtract β Σ_t log(π/π_ref), whatever `kl` is, from a reward, not β KL from J; as in verl, σ divides it too.

    Under top-p or min-p, each of the two is normalised over the tokens that it would draw from, and the drawn one.
    """
    reference_every: int | None = None
    """Steps after which the policy becomes its own reference; `None` keeps the first reference."""
    reference_share: float = 1.0
    """Share of the policy in the new reference; below 1, the reference is a moving average."""
    entropy_weight: float = 0.0
    """Weight of the entropy bonus, per nat."""
    entropy_floor_nat: float | None = None
    """Mean entropy above which a prompt gets no more bonus; `None` sets no limit."""
    gamma: float = 0.01
    """Weight of the tactile grounding G_tg."""
    grounding_stop_masked: bool = False
    """No gradient through the perturbed branch of G_tg."""
    grounding_cap_nat: float | None = None
    """Largest grounding of a token, nat."""
    grounding_budget: float | None = None
    """Largest contribution of a prompt's grounding to the objective, in standard deviations of the reward."""
    anchor: float = 0.0
    """Weight of the likelihood of the verified answer to the same question, nat a token: the loss of SFT."""
    tactile_use: TactileUse = TactileUse.OFF
    tactile_weight: float = 0.3
    """Weight α of the tactile-use reward."""
    tactile_margin: float = 0.1
    """Lead δ over the best control that R_tu requires, in units of accuracy credit."""
    controls: int = 4
    """Rollouts of each control."""
    updates: int = 1
    """Updates μ from the same rollouts."""
    minibatches: int = 1
    """Equal parts of the prompts; an update takes one optimizer step on each."""
    stale: int = 0
    """Steps by which the sampler's parameters lag behind the learner's."""
    trust_nat: float | None = None
    """Largest KL between the policies before and after an update, nat a token; longer updates are shortened."""

    def __post_init__(self) -> None:
        counted = "best_of", "candidates", "controls", "updates", "minibatches", "reference_every"
        at_least(self, 1, *(name for name in counted if getattr(self, name) is not None))
        sampled = {"best_of": 1, "segment_credit": False, "kl_in_reward": False, "tactile_use": TactileUse.OFF}
        for field, value in (sampled if self.enumerated is not None else {}).items():
            if getattr(self, field) != value:
                needs = f"must be {value} where enumerated is set, because it needs a sampled conclusion; change either"
                raise ValueError(f"{field} is {getattr(self, field)}: {needs}")
        literal = self.tactile_use is TactileUse.LITERAL
        if self.advantage is Advantage.PER_REWARD and (literal or self.kl_in_reward):
            field, weight = ("tactile_use", "tactile_weight") if literal else ("kl_in_reward", "beta")
            raise ValueError(f"{field} is {getattr(self, field)}: must go for PER_REWARD, whose σ takes {weight} away")
        if self.segment_credit and self.surrogate is Surrogate.SEQUENCE:  # its gradient is that of the credits' mean
            raise ValueError("segment_credit is True: must be False for surrogate SEQUENCE, one ratio; change either")
        at_least(self, 0, "stale", "score_centering")
        if not 0 < self.reference_share <= 1:
            raise ValueError(f"reference_share is {self.reference_share}: must lie in 0 < share ≤ 1; 1 is no average")
        sizes = "clip_low clip_high epsilon beta entropy_weight gamma anchor tactile_weight tactile_margin"
        for field in sizes.split():
            if not (isinstance(getattr(self, field), jax.Array) or 0 <= getattr(self, field) < float("inf")):
                raise ValueError(f"{field} is {getattr(self, field)}: must be ≥ 0 and finite; it is a size, not a sign")
        bounds = "importance_cap mismatch_limit grounding_cap_nat grounding_budget entropy_floor_nat trust_nat"
        for field in bounds.split():
            if (bound := getattr(self, field)) is not None and not bound > 0:
                raise ValueError(f"{field} is {bound}: must be above 0; None leaves it out")
        idle = {"learn_conclusion": "enumerated", "importance_sequence": "importance_cap", "kl_in_reward": "beta"}
        idle |= {"grounding_cap_nat": "gamma", "grounding_budget": "gamma", "entropy_floor_nat": "entropy_weight"}
        idle |= {"grounding_stop_masked": "gamma", "reference_share": "reference_every"}
        idle |= dict.fromkeys(("tactile_margin", "tactile_weight", "controls"), "tactile_use")
        idle |= {"reference_every": "beta"} if self.learn_conclusion else {}
        for field, needed in idle.items():
            value, need = getattr(self, field), getattr(self, needed)
            if left_out(need) and value not in (None, getattr(type(self), field)):
                raise ValueError(f"{field} is {value}, but {needed} is {need}: set it or drop {field}")


def ratio_to_learner(algorithm: Algorithm) -> bool:
    """True if ratios are relative to the learner before its first update, false if to the older sampling parameters.

    With an importance cap, weights correct for the lag, as in the decoupled objective of AReaL (arXiv 2505.24298).
    """
    return algorithm.stale == 0 or algorithm.importance_cap is not None


def loss_beta(algorithm: Algorithm) -> float:
    """β of the KL in the loss; none where the KL is in the reward."""
    return 0.0 if algorithm.kl_in_reward else algorithm.beta


def needs_reference(algorithm: Algorithm) -> bool:
    """True if a step runs the reference: for its KL, or for conclusions that follow it."""
    return not (left_out(algorithm.beta) and algorithm.learn_conclusion)


def left_out(weight: Any) -> bool:
    """True for a term that is off, or whose weight is the number 0, not an array that may have another value."""
    return not isinstance(weight, jax.Array) and weight in (0.0, None, TactileUse.OFF)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Paper(Algorithm):
    """The published objective, literally: gradient through both branches of G_tg, k3 for the reference KL, no R_tu."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stable(Algorithm):
    """Departures that keep the objective bounded: no gradient through the masked branch, G_tg capped at 1 nat a token,
    exact KL, groups of equal rewards left out of the policy-gradient mean, R_tu added after normalisation, and strict
    rewards instead of the published ones (`stable_rewards`).

    Further departures: one σ for all groups, which keeps a debiased reward unbiased; a prompt's grounding adds at most
    a twentieth of a standard deviation of the reward, so that at no γ it outweighs the answer; an entropy bonus up to
    .1 nat a token, about the entropy of supervised policies, so that the rollouts of a group stay different; an update
    moves the policy by about .003 nat a token at most; β is .1, a hundred times the published value: where touch is
    uninformative, all answers earn the same under a debiased reward, the policy drifts at random until one answer is
    left, and only the reference pulls it back.

    If touch does not help, R_tu is paid in at most 9 % of groups (see `tactile_use`); at the literal δ = .1, a single
    right answer in eight would earn it (18 %).
    """

    advantage: Advantage = Advantage.BATCH
    stable_rewards: bool = True
    drop_degenerate: bool = True
    beta: float = 0.1
    kl: KLEstimator = "exact"
    grounding_stop_masked: bool = True
    grounding_cap_nat: float | None = 1.0
    grounding_budget: float | None = 0.05
    entropy_weight: float = 0.1
    entropy_floor_nat: float | None = 0.1
    trust_nat: float | None = 0.003
    tactile_use: TactileUse = TactileUse.RECOMMENDED
    tactile_margin: float = 0.13


@dataclasses.dataclass(frozen=True, kw_only=True)
class Dapo(Algorithm):
    """DAPO (arXiv 2503.14476): clip .2/.28, tokens averaged, dynamic sampling, no KL; `overlong` penalises length."""

    clip_high: float = 0.28
    average: Average = Average.TOKEN
    drop_degenerate: bool = True
    candidates: int = 2
    beta: float = 0.0
    gamma: float = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class DrGrpo(Algorithm):
    """Dr. GRPO (arXiv 2503.20783): advantages without σ, tokens summed over a constant length, no KL."""

    average: Average = Average.LENGTH
    advantage: Advantage = Advantage.NONE
    beta: float = 0.0
    gamma: float = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Gspo(Algorithm):
    """GSPO (arXiv 2507.18071): one length-normalised ratio for a rollout, clipped at 3e-4 and 4e-4, no KL."""

    surrogate: Surrogate = Surrogate.SEQUENCE
    clip_low: float = 3e-4
    clip_high: float = 4e-4
    beta: float = 0.0
    gamma: float = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cispo(Algorithm):
    """CISPO (MiniMax-M1, arXiv 2506.13585): the ratio is a clipped weight without gradient, tokens averaged, no KL."""

    surrogate: Surrogate = Surrogate.CISPO
    clip_low: float = 1.0
    clip_high: float = 4.0
    average: Average = Average.TOKEN
    beta: float = 0.0
    gamma: float = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rloo(Algorithm):
    """RLOO (arXiv 2402.14740): REINFORCE on whole answers, with the mean of the group's others as baseline, without σ.

    The KL in its reward needs `beta` and `kl_in_reward`; the preset has none.
    """

    average: Average = Average.LENGTH
    advantage: Advantage = Advantage.LEAVE_ONE_OUT
    beta: float = 0.0
    gamma: float = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReinforcePlusPlus(Algorithm):
    """REINFORCE++ (arXiv 2501.03262): mean and σ of the batch, so that `group` may be 1; tokens averaged, no KL."""

    average: Average = Average.TOKEN
    advantage: Advantage = Advantage.GLOBAL
    beta: float = 0.0
    gamma: float = 0.0


AnyAlgorithm = Paper | Stable | Dapo | DrGrpo | Gspo | Cispo | Rloo | ReinforcePlusPlus


@dataclasses.dataclass(frozen=True, kw_only=True)
class GRPOConfig:
    """Sizes, learning rate and algorithm of a step.

    `lr_scale` multiplies the paper's learning rate, which is too small for models trained from scratch; the rate falls
    linearly to `final_share` of its start (not in the paper).
    """

    prompts: int = 8
    group: int = 8
    length: int = 20
    micro_prompts: int = 4
    """Prompts whose gradient is computed at once; the rest is accumulated."""
    learning_rate: float = 1e-6
    lr_scale: float = 200.0
    final_share: float = 0.05
    max_grad_norm: float = 1.0
    algorithm: AnyAlgorithm = dataclasses.field(default_factory=Paper)
    temperature: float = 1.0
    """Divisor of the logits of sampler, learner and reference."""
    top_p: float = 1.0
    """Sample from the fewest most likely tokens with this total probability; the learner renormalises alike."""
    min_p: float = 0.0
    """Sample from tokens with at least this share of the largest probability; the learner renormalises alike."""
    buckets: tuple[int, ...] = ()
    """Lengths below `length`, ascending: an update computes the shortest that holds its rollouts; each is compiled."""
    inverse_draws: bool = False
    """Draw a token with one uniform number per rollout, not one Gumbel number per word: faster, other random bits."""
    remat: bool = False
    """Keep only matrix products for the backward pass and compute the rest again: less memory, more time."""
    max_logits: int = MAX_LOGITS
    """Logits of a prompt that may exist at once; more tokens are scored in blocks (`models.chunked_logits`)."""
    lean_compilation: bool = False
    """Compile with XLA's older code generator on CPUs: half the memory, 1.5 times as long, slower steps."""
    bfloat16: bool = False
    """Compute forward passes in bfloat16; parameters, softmax, losses and optimizer stay in float32."""

    def __post_init__(self) -> None:
        at_least(self, 1, "prompts", "group", "length", "micro_prompts", "max_logits")
        at_least(self, 0, "learning_rate", "lr_scale")
        above(self, 0, "max_grad_norm", "top_p")
        within(self, 0, 1, "final_share", "top_p", "min_p")
        within(self, *TEMPERATURES, "temperature")
        if self.prompts % (self.micro_prompts * (parts := self.algorithm.minibatches)):
            micro = f"{self.micro_prompts} of each of {parts} minibatches" if parts > 1 else f"{self.micro_prompts}"
            raise ValueError(f"micro_prompts {micro} must divide prompts {self.prompts}; choose a divisor of it")
        of_batch, bonus = self.algorithm.advantage is Advantage.GLOBAL, self.algorithm.tactile_use
        if self.group < 2 and not (of_batch and self.algorithm.enumerated is None and bonus != TactileUse.RECOMMENDED):
            raise ValueError(f"group is {self.group}: must be at least 2 to compare rollouts (GLOBAL can do without)")
        apart = self.algorithm.advantage is Advantage.PER_REWARD or self.algorithm.segment_credit
        if (best_of := self.algorithm.best_of) > 1 and (best_of > self.group - (not of_batch) or apart):
            raise ValueError(  # the best of all is one for all, which only other groups differ from
                f"best_of is {best_of}: must be below group {self.group} (up to it for GLOBAL), and 1 for advantage "
                "PER_REWARD and for segment_credit, which have no total to take the best of; lower it"
            )
        for field in ("enumerated", "score_centering"):
            if getattr(self.algorithm, field) and (self.top_p, self.min_p) != (1, 0):
                cuts = f"top_p is {self.top_p}, min_p {self.min_p}"
                raise ValueError(f"{cuts}: must be 1 and 0 where {field} is set, which needs all tokens; change either")
        if list(self.buckets) != sorted({n for n in self.buckets if 2 <= n < self.length}):
            raise ValueError(f"buckets is {self.buckets}: must ascend within 2 … {self.length - 1}; sort it")

    @property
    def drawn(self) -> int:
        """Prompts of a batch: `candidates` for each prompt that is learned from."""
        return self.prompts * self.algorithm.candidates


def at_precision(config: GRPOConfig, params: Params) -> Params:
    """The parameters in the type that forward passes compute in."""
    return jax.tree.map(lambda x: x.astype(jnp.bfloat16), params) if config.bfloat16 else params
