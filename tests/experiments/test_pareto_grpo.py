"""The race, shrunk, and how its courses are read."""

import dataclasses

import pytest

from experiments import pareto_grpo
from experiments.pareto_grpo import ALGORITHMS, Course, ParetoConfig, climb, verdict
from experiments.running.artifacts import read_json
from experiments.running.runner import main


class Scripted:
    """A job whose rewards are known."""

    def __init__(self, rewards: list[float]) -> None:
        self._rewards = iter(rewards)

    def step(self) -> dict[str, float]:
        return {"reward": next(self._rewards)}


def test_a_run_ends_at_the_target_or_when_its_steps_are_spent():
    config = ParetoConfig(target=0.9, most_steps=3)
    assert climb(Scripted([0.5, 0.95, 1.0]), config) == (0.5, 0.95)
    assert climb(Scripted([0.5, 0.6, 0.7, 0.8]), config) == (0.5, 0.6, 0.7)


def test_the_verdict_names_the_fastest_and_the_late():
    course = lambda last, step_s: Course(rewards=((0.5, last), (0.6, 0.7, last)), step_s=step_s, target=0.9)
    said = verdict(
        ParetoConfig(), {("a", 4): course(0.95, 2.0), ("b", 8): course(0.9, 1.0), ("c", 8): course(0.8, 0.1)}
    )
    assert said[0] == "b in groups of 8 is first at 0.9, in 2.5 s."
    assert said[1] == "Not every seed passed 0.9 within 150 steps with c in groups of 8."


def test_groups_must_divide_the_rollouts():
    with pytest.raises(ValueError, match=r"groups holds \[5\]: must divide rollouts = 64"):
        ParetoConfig(groups=(4, 5))


@pytest.mark.slow
def test_every_algorithm_stands_in_the_table(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        small = dataclasses.replace(pareto_grpo.EXPERIMENT, config=pareto_grpo.SMOKE)
        patch.setattr(pareto_grpo, "EXPERIMENT", small)
        assert main(["pareto_grpo", "--runs-dir", str(tmp_path)]) == 0
    (directory,) = (p for p in (tmp_path / "pareto_grpo").iterdir() if not p.is_symlink())
    results = read_json(directory / "results.json")
    assert [row[0] for row in results["tables"][0]["rows"]] == list(ALGORITHMS)
    assert (directory / "plots" / "pareto_grpo.svg").exists()
