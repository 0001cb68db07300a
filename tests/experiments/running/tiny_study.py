"""`ablation_ordinal` with one arm at the tests' smallest sizes, for processes of their own: `python -m` this module."""

import dataclasses
import sys

from experiments import ablation_ordinal
from experiments.running.runner import main
from tests.experiments import tiny

if __name__ == "__main__":
    config = dataclasses.replace(tiny.STUDY, seeds=1, grpo_steps=3)
    ablation_ordinal.ARMS = {"ordinal": ablation_ordinal.ARMS["ordinal"]}
    ablation_ordinal.EXPERIMENT = dataclasses.replace(ablation_ordinal.EXPERIMENT, config=config)
    sys.exit(main(["ablation_ordinal", *sys.argv[1:]]))
