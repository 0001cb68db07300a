"""What merging kept of the adapters of a study: weights of a coarse type swallow small changes."""

from collections.abc import Mapping

from experiments.core.context import Context
from experiments.core.results import Column, Requirement, Table
from experiments.study.stages import KEPT
from experiments.study.study import BLIND, SFT

LEAST_KEPT = 0.9
"""Share of the adapters' change that must be in the weights that are scored and written."""


def kept_shares(arm: str, seeds: int, context: Context) -> dict[str, float]:
    """Policy → what its weights kept of the adapters of its last stage, the least of all seeds."""
    stages = {"sft": SFT, f"grpo/{arm}": arm, "blind": BLIND}
    return {
        name: min(context.load_stage(f"{KEPT}/{stage}/{seed}") for seed in range(seeds))
        for stage, name in stages.items()
    }


def least_kept(kept: Mapping[str, float]) -> Requirement:
    """A type that is too coarse for the changes of training would swallow them where adapters are merged."""
    name, note = "least share of the adapters that merging keeps", "below, train faster or in --model.dtype float32"
    return Requirement(name=name, measured=min(kept.values()), bound=LEAST_KEPT, better="higher", note=note)


def kept_table(kept: Mapping[str, float]) -> Table:
    """That of each policy."""
    return Table(
        title="What merging keeps of the adapters",
        columns=(Column(name="policy"), Column(name="kept", unit="%", format=".1f")),
        rows=tuple((name, 100 * share) for name, share in kept.items()),
        note="Projection of what became of the weights, rounded to their type, on the adapters' change; the least of "
        "all seeds.",
    )
