"""The race, shrunk, and how its courses are read."""

import dataclasses

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.core.runner import main
from experiments.engine import pareto_grpo
from experiments.engine.pareto_charts import LearningCurves
from experiments.engine.pareto_grpo import ALGORITHMS, ParetoGrpoConfig, table, verdict


def course(*rewards: list[float], step_s: float = 1.0) -> LearningCurves:
    return LearningCurves(rewards=np.array(rewards), step_s=step_s)


def test_a_seed_arrives_where_it_first_passes_the_target():
    np.testing.assert_array_equal(course([0.5, 0.9, 0.6], [0.9, 0.1, 0.1], [0, 0, 0]).reached(0.9), [2, 1, np.inf])


def test_the_score_is_that_of_the_last_tenth_but_of_one_step_at_least():
    assert course([0.0, 0.5], [0.0, 1.0]).score == 0.75
    assert course([0.0] * 18 + [1.0, 0.5]).score == 0.75


def test_the_verdict_names_the_fastest_the_default_and_the_late():
    courses = {
        ("paper", 8): course([0.5, 0.95], [0.5, 0.95], step_s=2.0),
        ("b", 8): course([0.95, 0.95], [0.1, 0.9], step_s=1.0),
        ("c", 8): course([0.5, 0.8], [0.95, 0.95], step_s=0.1),
    }
    assert verdict(ParetoGrpoConfig(steps=2), courses) == (
        "b in groups of 8 is first at 0.9, in 1.5 s.",
        "The default, paper in groups of 8, takes 4.0 s.",
        "Not every seed passed 0.9 within 2 steps with c in groups of 8.",
    )
    rows = {row[0]: row[1:] for row in table(ParetoGrpoConfig(), courses).rows}
    assert rows["paper (default)"] == (8, 2000.0, 0.95, 2.0, 4.0, "2 of 2")
    assert rows["c"][3:] == (None, None, "1 of 2")


def test_groups_must_divide_the_rollouts():
    with pytest.raises(ValueError, match=r"groups holds \[5\]: must divide rollouts = 32"):
        ParetoGrpoConfig(groups=(4, 5))


@pytest.mark.slow
def test_every_algorithm_stands_in_the_table(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        small = dataclasses.replace(pareto_grpo.EXPERIMENT, config=pareto_grpo.SMOKE)
        patch.setattr(pareto_grpo, "EXPERIMENT", small)
        assert main(["pareto_grpo", "--runs-dir", str(tmp_path)]) == 0
    (directory,) = (p for p in (tmp_path / "pareto_grpo").iterdir() if not p.is_symlink())
    results = read_json(directory / "results.json")
    assert [row[0] for row in results["tables"][0]["rows"]] == list(ALGORITHMS)
    assert {p.name for p in (directory / "plots").iterdir()} == {"pareto_grpo.svg", "courses.svg"}
