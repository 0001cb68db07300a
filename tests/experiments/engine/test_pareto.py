"""The page of all charts: who is dominated, by hand values, and what it gathers from the runs of others."""

import pytest

from experiments.core.artifacts import read_json, write_json, write_text
from experiments.core.errors import ResultsError
from experiments.engine import pareto
from experiments.engine.fronts import Axis, Point, dominators, front, points_of
from experiments.engine.pareto import DEFAULTS, GatherConfig, judge, newest
from tests.experiments.shrunk import run_shrunk

A, B, C, D = (Point(name=n, at=at) for n, at in zip("abcd", [(1, 4), (2, 2), (3, 3), (2, 2)], strict=True))
TABLE = {
    "title": "Tiers at 128²",
    "columns": [{"name": "method"}, {"name": "time"}, {"name": "slope median"}],
    "rows": [["Winkler", 0.1, 0.5], ["nested 1e-3", 2.0, 0.01], ["plain", 3.0, 0.01], ["unmeasured", None, 0.1]],
}


def test_a_point_is_beaten_where_another_is_nowhere_worse():
    assert B.beats(C)
    assert not B.beats(D)  # equals beat neither
    assert not A.beats(B)
    assert front([A, B, C, D]) == (A, B, D)
    assert dominators("c", [A, B, C, D]) == (B, D)
    assert dominators("a", [A, B, C, D]) == ()
    assert dominators("e", [A, B]) is None


def test_points_are_rows_with_a_number_on_every_axis():
    axes = (Axis(column="time", better="lower"), Axis(column="slope", better="higher"))
    assert points_of(TABLE, axes)[0] == Point(name="Winkler", at=(0.1, -0.5))
    assert [p.name for p in points_of(TABLE, axes)] == ["Winkler", "nested 1e-3", "plain"]
    with pytest.raises(ResultsError, match="'speed'"):
        points_of(TABLE, (Axis(column="speed", better="lower"),))


def finished(home, stamp: str, rows, scale: str = "default"):
    """A finished run of `pareto_contact` with one chart."""
    directory = home / "pareto_contact" / stamp
    description = {
        "experiment": "pareto_contact",
        "scale": scale,
        "config": {},
        "git": {"commit": "a" * 40, "dirty": 0},
    }
    directory.mkdir(parents=True)
    write_json(directory / "config.json", {**description, "command": "python -m experiments pareto_contact"})
    (directory / "plots").mkdir()
    write_text(directory / "plots" / "pareto_contact.svg", "<svg xmlns='http://www.w3.org/2000/svg'></svg>")
    write_json(directory / "results.json", {"tables": [{**TABLE, "rows": rows}], "verdict": ["."]})


def test_the_page_says_which_default_is_dominated(tmp_path):
    finished(tmp_path, "20260101-000000", TABLE["rows"])
    directory = run_shrunk(pareto, GatherConfig(others=tmp_path), tmp_path / "first")
    results = read_json(directory / "results.json")
    defaults, ran = results["tables"]
    assert defaults["rows"] == [
        ["contact solver", "nested 1e-3", "Tiers at 128²", defaults["rows"][0][3], 3, 2, "nothing"]
    ]
    assert [row[0] for row in ran["rows"]] == ["pareto_contact"]
    assert results["verdict"][0] == "None of 1 judgements finds a default dominated."
    assert "pareto_storage" in results["verdict"][1]
    assert "pareto_contact: pareto contact" in (directory / "report.html").read_text(encoding="utf-8")
    finished(tmp_path, "20260102-000000", [*TABLE["rows"], ["new", 1.0, 0.01]])
    directory = run_shrunk(pareto, GatherConfig(others=tmp_path), tmp_path / "second")
    results = read_json(directory / "results.json")
    assert results["verdict"][0].endswith("is dominated in 'Tiers at 128²' by new.")
    assert not results["requirements"][0]["met"]


def test_a_full_run_goes_before_a_newer_smoke_run(tmp_path):
    assert newest(tmp_path / "pareto_contact") is None
    finished(tmp_path, "20260101-000000", TABLE["rows"])
    finished(tmp_path, "20260102-000000", TABLE["rows"], scale="smoke")
    assert newest(tmp_path / "pareto_contact").directory.name == "20260101-000000"
    assert judge(DEFAULTS[1], newest(tmp_path / "pareto_contact")) == []


def test_nothing_ran_is_said(tmp_path):
    results = read_json(run_shrunk(pareto, GatherConfig(), tmp_path) / "results.json")
    assert results["verdict"][0].startswith("Not run yet")
    assert results["requirements"] == []
