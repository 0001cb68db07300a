"""The optimizers of the stages.  They leave out updates whose gradient is not finite, and count them."""

import dataclasses

import optax

from touchr1_jax.skipping import skip_nonfinite
from touchr1_jax.validation import above, at_least, within


@dataclasses.dataclass(frozen=True, kw_only=True)
class OptimizerConfig:
    """AdamW with linear warm-up and cosine decay to `final_share` of the peak.

    `learning_rate` is the paper's; models trained from scratch multiply it by `lr_scale`, which every report prints.
    `weight_decay` is of all that is trained, scales of norms, biases and both factors of adapters among them.
    """

    learning_rate: float
    lr_scale: float = 100.0
    warmup_steps: int = 20
    final_share: float = 0.05
    weight_decay: float = 0.0
    b2: float = 0.95
    max_grad_norm: float = 1.0

    def __post_init__(self) -> None:
        at_least(self, 0, "learning_rate", "lr_scale", "warmup_steps", "weight_decay")
        within(self, 0, 1, "final_share")
        above(self, 0, "max_grad_norm")
        if not 0 <= self.b2 < 1:
            raise ValueError(f"b2 is {self.b2}: must lie in 0 ≤ b2 < 1, a share of what was; lower it")

    @property
    def peak(self) -> float:
        """The learning rate that is used, learning_rate · lr_scale."""
        return self.learning_rate * self.lr_scale


def falling_adamw(
    learning_rate: float, final_share: float, steps: int, max_grad_norm: float
) -> optax.GradientTransformation:
    """Clip the global gradient norm, then AdamW without decay of weights: the optimizer of GRPO.

    The learning rate falls linearly to `final_share` of its start over `steps` updates; 1 keeps it constant.
    """
    schedule = optax.linear_schedule(learning_rate, final_share * learning_rate, steps)
    adamw = optax.adamw(schedule, weight_decay=0.0)
    return skip_nonfinite(optax.chain(optax.clip_by_global_norm(max_grad_norm), adamw))


def make_optimizer(config: OptimizerConfig, steps: int) -> optax.GradientTransformation:
    """Clip the global gradient norm, then AdamW on the schedule of `steps` steps."""
    warmup = min(config.warmup_steps, steps // 2)
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, config.peak, warmup, max(steps, warmup + 1), end_value=config.peak * config.final_share
    )
    begun = lambda count: schedule(count + (warmup > 0))  # the first step of a warm-up is not spent at rate 0
    adamw = optax.adamw(begun, b2=config.b2, weight_decay=config.weight_decay)
    return skip_nonfinite(optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adamw))
