"""Settings of the GRPO algorithm and the presets that reports name."""

import dataclasses

from touchr1_jax.rl.kl import KLEstimator


@dataclasses.dataclass(frozen=True, kw_only=True)
class GRPOConfig:
    """The algorithm; `paper()` is the published objective with our values for what it leaves open.

    `gamma`, the clip range, population σ, `epsilon` and `final_share`, to which the learning rate falls linearly, are
    ours: the paper gives none.  `lr_scale` multiplies the paper's learning rate for models trained from scratch, which
    stand still at 1e-6.
    """

    prompts: int = 8
    group: int = 8
    length: int = 20
    micro_prompts: int = 4
    learning_rate: float = 1e-6
    lr_scale: float = 200.0
    final_share: float = 0.05
    max_grad_norm: float = 1.0
    clip_low: float = 0.2
    clip_high: float = 0.2
    epsilon: float = 1e-4
    normalise: bool = True
    drop_degenerate: bool = False
    beta: float = 1e-3
    kl: KLEstimator = "k3"
    gamma: float = 0.01
    grounding_stop_masked: bool = False
    grounding_cap_nat: float | None = None

    def __post_init__(self) -> None:
        if self.prompts % self.micro_prompts:
            raise ValueError(
                f"micro_prompts {self.micro_prompts} must divide prompts {self.prompts}; choose a divisor of it"
            )

    @staticmethod
    def paper() -> "GRPOConfig":
        """The published objective, literally; gradient through both branches of G_tg, k3 for the reference KL."""
        return GRPOConfig()

    @staticmethod
    def stable() -> "GRPOConfig":
        """Departures that keep the objective bounded: masked branch held fixed, G_tg capped at 1 nat a token, exact KL,
        zero-variance groups left out of the policy-gradient mean."""
        return GRPOConfig(kl="exact", grounding_stop_masked=True, grounding_cap_nat=1.0, drop_degenerate=True)


def preset_name(config: GRPOConfig) -> str:
    """Name of the preset and the settings that differ from it, as reports print it."""
    presets = {"paper": GRPOConfig.paper(), "stable": GRPOConfig.stable()}
    fields = [f.name for f in dataclasses.fields(GRPOConfig)]
    changes = {
        name: [f"{f}={getattr(config, f)}" for f in fields if getattr(config, f) != getattr(preset, f)]
        for name, preset in presets.items()
    }
    nearest = min(changes, key=lambda name: len(changes[name]))
    return " ".join([nearest, *([f"with {', '.join(changes[nearest])}"] if changes[nearest] else [])])
