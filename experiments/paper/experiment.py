"""What the studies of the bench have in common as experiments."""

from collections.abc import Callable, Mapping
from typing import TypeVar

from experiments.core.context import Context
from experiments.core.results import Results
from experiments.core.runner import Experiment
from experiments.paper.outcome import CURVES
from experiments.paper.presets import NEEDS

C = TypeVar("C")


def bench_experiment(
    name: str, config: C, scales: Mapping[str, C], run: Callable[[C, Context], Results], *, spreads: bool = True
) -> Experiment[C]:
    """The experiment with the curves of the bench's studies, what its scales ask of a machine, and a quick `smoke`.

    Args:
      name, config, scales, run, spreads: as in `Experiment`; `smoke` must be among the scales.
    """
    return Experiment(
        name=name,
        config=config,
        scales=scales,
        run=run,
        curves=CURVES,
        needs={scale: NEEDS[scale] for scale in scales if scale in NEEDS},
        quick=("smoke",),
        spreads=spreads,
    )
