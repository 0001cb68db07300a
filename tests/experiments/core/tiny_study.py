"""A study with one arm at the tests' smallest sizes; with `--strike N` first, SIGTERM comes during batch N of SFT."""

import dataclasses
import importlib
import signal
import sys

from experiments.core.commands import find
from experiments.core.runner import run_experiment
from experiments.paper.presets import SMALL_QUOTA
from experiments.study.ablation import ablation_experiment
from tests.experiments import tiny
from touchr1_jax.training.feeds import AnswerFeed


def strike(batch: int) -> None:
    """Send this process a SIGTERM while it makes a batch."""
    make, made = AnswerFeed.make, []

    def struck(feed, element, rng):
        made.append(None)
        if len(made) == batch:
            signal.raise_signal(signal.SIGTERM)
        return make(feed, element, rng)

    AnswerFeed.make = struck


if __name__ == "__main__":
    name, *arguments = sys.argv[1:]
    if name == "--strike":
        strike(int(arguments[0]))
        name, *arguments = arguments[1:]
    module = importlib.import_module(find("experiments")[name].module)
    config = dataclasses.replace(tiny.STUDY, seeds=1, grpo_steps=3)
    experiment = module.EXPERIMENT
    if name == "ablation_ordinal":
        arms = {"ordinal": module.ABLATION.arms["ordinal"]}
        experiment = ablation_experiment(name, dataclasses.replace(module.ABLATION, arms=arms, pairs=()))
    if name == "main_table":
        quota = dataclasses.replace(SMALL_QUOTA, identify=8, scale=0, compose=3, compare=2, order=0, conflict=0)
        config = module.MainConfig(study=config, quota=quota)
    sys.exit(run_experiment(dataclasses.replace(experiment, config=config), arguments, module.__doc__))
