"""Ten seeds of every variant at every value of every knob: trained, examined, watched; each course computed once."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from experiments.engine.evaluation import examine_program
from experiments.engine.failures import Place, VariantRun
from experiments.engine.training import GrpoVariant, TrainingBudget, pretrain_program, reinforce_program
from experiments.engine.world import S, World
from touchr1_jax.rl.alarms import Watch
from touchr1_jax.rl.stream_check import check_streams
from touchr1_jax.types import Params


class VariantRuns:
    """Runs by what they depend on.

    Args:
      effort: how long and how broadly.
      seeds: numbers of the seeds.
    """

    def __init__(self, effort: TrainingBudget, seeds: Sequence[int]) -> None:
        self._effort = effort
        self._keys = jax.vmap(jax.random.key)(np.asarray(seeds))
        self._start: dict[World, Params] = {}
        self._before: dict[World, dict[str, Array]] = {}
        self._done: dict[tuple[GrpoVariant, Place], VariantRun] = {}

    def course(self, variant: GrpoVariant, place: Place, *, guarded: bool) -> VariantRun:
        """All seeds of one variant in one place; guarded, they are checked as every study checks before it trains."""
        if (variant, place) not in self._done:
            self._done[variant, place] = self._run(variant, place)
        course = self._done[variant, place]
        return dataclasses.replace(course, refused=guarded and refused(course))

    def _run(self, variant: GrpoVariant, place: Place) -> VariantRun:
        world, dials = place
        start = self._supervised(world)
        examine = examine_program(self._effort)
        if world not in self._before:
            self._before[world] = examine(world, start, start, self._keys)
        end, metrics = reinforce_program(self._effort, variant)(world, dials, start, self._keys)
        after = examine(world, end, start, self._keys)
        course = jax.device_get({"before": self._before[world], "after": after, "metrics": metrics})
        return VariantRun(**course)

    def _supervised(self, world: World) -> Params:
        """The policies that supervised training makes of a world, sharpened."""
        plain = world._replace(sharp=1.0)
        if plain not in self._start:
            self._start[plain] = pretrain_program(self._effort)(plain, self._keys)
        decoder = self._start[plain]["decoder"]
        norm = {"scale": decoder["norm"]["scale"] * world.sharp}
        return {"decoder": {**decoder, "norm": norm}}


def refused(course: VariantRun) -> bool:
    """Whether the check before training raises for any seed."""
    influence = np.stack([course.before[f"grounding_{s}"] for s in range(S)], 1)
    try:
        for row in influence:
            check_streams(row, np.ones(S, bool))
    except ValueError:
        return True
    return False


class FirstAlarm(NamedTuple):
    """The first time that an alarm fired: after which step, counted from 0, and with what number."""

    step: int
    value: float


def alarms_of(course: VariantRun, seed: int) -> dict[str, FirstAlarm]:
    """Codes of the alarms that a seed's training raised, each with its first."""
    watch, fired = Watch(), dict[str, FirstAlarm]()
    for t in range(len(course.metrics["reward"][seed])):
        for alarm in watch.see({name: float(value[seed, t]) for name, value in course.metrics.items()}):
            fired.setdefault(alarm.code, FirstAlarm(t, alarm.value))
    return fired
