"""What came of a scenario: which seeds failed on either side of it, and which alarms each of them raised."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from experiments.engine.failures import FailureScenario
from experiments.engine.stability_runs import FirstAlarm

Raised = Mapping[str, FirstAlarm]
"""Codes of the alarms that a run raised, each with its first."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariantOutcome:
    """One variant in one scenario: which seeds failed, bool [value, seed], and what each raised, alike."""

    failed: np.ndarray
    raised: Sequence[Sequence[Raised]]

    def fired(self, codes: Sequence[str]) -> np.ndarray:
        """Which seeds raised any of these alarms, bool [value, seed]."""
        return np.array([[any(c in run for c in codes) for run in runs] for runs in self.raised])

    def breaks_at(self, values: Sequence[float], most: float = 0.0) -> float | None:
        """First value at which more than this share of the seeds fail; `None` where there is none."""
        return next((v for v, share in zip(values, self.failed.mean(1), strict=True) if share > most), None)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScenarioOutcome:
    """Both sides of a scenario at the values that were driven."""

    scenario: FailureScenario
    values: tuple[float, ...]
    failing: VariantOutcome
    cure: VariantOutcome

    @property
    def name(self) -> str:
        """The failure's code and title."""
        return f"{self.scenario.code} {self.scenario.title}"

    @property
    def sentence(self) -> str:
        """Where either side breaks."""
        word = lambda v: "nowhere" if v is None else f"at {v:g}"
        failing, cure = (word(side.breaks_at(self.values)) for side in (self.failing, self.cure))
        return f"{self.name}: {self.scenario.knob}: {self.scenario.failing.name} breaks {failing}, stable {cure}"

    @property
    def provoked(self) -> np.ndarray:
        """Values at which the other side fails, bool [value]."""
        return np.any(self.failing.failed, axis=1)

    @property
    def harmed(self) -> int:
        """Runs of `stable` that fail at values where the other side does."""
        return int(self.cure.failed[self.provoked].sum())

    @property
    def compared(self) -> int:
        """Runs of `stable` at those values."""
        return int(self.cure.failed[self.provoked].size)

    @property
    def power(self) -> float | None:
        """Share of failed runs, of either side, whose alarm fired; `None` where none failed."""
        return share(self.heard(failed=True))

    @property
    def false_alarms(self) -> float | None:
        """Share of runs that did not fail, of either side, whose alarm fired all the same."""
        return share(self.heard(failed=False))

    def heard(self, *, failed: bool) -> np.ndarray:
        """Of the runs of both sides that failed, or of those that did not: whether the scenario's alarm fired."""
        codes = self.scenario.alarms
        return np.concatenate([s.fired(codes)[s.failed == failed] for s in (self.failing, self.cure)])

    def firsts(self) -> list[FirstAlarm]:
        """The scenario's first alarm of every failed run that raised one."""
        found = []
        for side in (self.failing, self.cure):
            for v, seed in np.argwhere(side.failed):
                run = side.raised[v][seed]
                found += sorted(run[c] for c in self.scenario.alarms if c in run)[:1]
        return found


def share(fired: np.ndarray) -> float | None:
    """Mean of flags; `None` of none."""
    return float(fired.mean()) if len(fired) else None
