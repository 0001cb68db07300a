"""Dominance by hand values, and the runs and charts that the page gathers."""

import pytest

from experiments.core.artifacts import read_json, write_json, write_text
from experiments.core.errors import ResultsError
from experiments.core.recorded import RECORDED, recorded_names
from experiments.engine import pareto
from experiments.engine.pareto import (
    DEFAULTS,
    GatherConfig,
    ParetoPoint,
    dominators,
    front,
    judge,
    newest_run,
    points_of,
)
from tests.experiments.shrunk import run_shrunk

A, B, C, D = (ParetoPoint(n, at) for n, at in zip("abcd", [(1, 4), (2, 2), (3, 3), (2, 2)], strict=True))
TABLE = {
    "title": "Tiers at 128²",
    "columns": [{"name": "method"}, {"name": "time"}, {"name": "slope median"}],
    "rows": [["Winkler", 0.1, 0.5], ["nested 1e-3", 2.0, 0.01], ["plain", 3.0, 0.01], ["unmeasured", None, 0.1]],
}


def test_a_point_is_dominated_where_another_is_nowhere_worse_and_somewhere_better():
    assert front([A, B, C, D]) == (A, B, D)  # of equal points neither dominates
    assert dominators("c", [A, B, C, D]) == (B, D)
    assert dominators("e", [C, B, ParetoPoint("e", (4, 4))]) == (B, C)  # those of the front first
    assert dominators("a", [A, B, C, D]) == ()
    assert dominators("e", [A, B]) is None


def test_points_are_rows_with_a_number_on_every_axis():
    points = points_of(TABLE, {"time": "lower", "slope": "higher"})
    assert points[0] == ParetoPoint("Winkler", (0.1, -0.5))
    assert [p.name for p in points] == ["Winkler", "nested 1e-3", "plain"]
    again = TABLE | {"rows": [["DAPO", 4, 0.5], ["DAPO", 8, 0.4], ["RLOO", 4, 0.3]]}
    assert [p.name for p in points_of(again, {"slope": "higher"})] == ["DAPO 4", "DAPO 8", "RLOO"]
    with pytest.raises(ResultsError, match="'speed'"):
        points_of(TABLE, {"speed": "lower"})


def finished(home, stamp: str, rows, scale: str = "default"):
    """A finished run of `pareto_contact` with one chart."""
    directory = home / "pareto_contact" / stamp
    description = {"experiment": "pareto_contact", "scale": scale, "config": {}}
    directory.mkdir(parents=True)
    git = {"commit": "a" * 40, "dirty": 0}
    write_json(
        directory / "config.json", {**description, "git": git, "command": "python -m experiments pareto_contact"}
    )
    (directory / "plots").mkdir()
    write_text(directory / "plots" / "pareto_contact.svg", "<svg xmlns='http://www.w3.org/2000/svg'></svg>")
    write_json(directory / "results.json", {"tables": [{**TABLE, "rows": rows}], "verdict": ["."]})


def test_the_page_names_dominated_defaults_and_shows_the_charts(tmp_path):
    finished(tmp_path, "20260101-000000", TABLE["rows"])
    directory = run_shrunk(pareto, GatherConfig(others=tmp_path), tmp_path / "first")
    results = read_json(directory / "results.json")
    defaults, choices, _ = results["tables"]
    of_run = [row for row in choices["rows"] if row[-1] == "20260101-000000"]
    assert {row[0]: row[2] for row in of_run} == {"Winkler": "–", "nested 1e-3": "–", "plain": "nested 1e-3"}
    assert defaults["rows"][0][4:] == [3, 2, "nothing", "20260101-000000"]
    assert "pareto_storage" in results["settings"]["neither run nor recorded"]
    assert (directory / "plots" / "pareto_contact-pareto_contact.svg").exists()
    finished(tmp_path, "20260102-000000", [*TABLE["rows"], ["new", 1.0, 0.01]])
    results = read_json(run_shrunk(pareto, GatherConfig(others=tmp_path), tmp_path / "second") / "results.json")
    assert results["tables"][0]["rows"][0][6:] == ["new", "20260102-000000"]
    assert not results["requirements"][0]["met"]


def test_recorded_results_stand_for_what_did_not_run_here(tmp_path):
    results = read_json(run_shrunk(pareto, GatherConfig(others=tmp_path / "none"), tmp_path) / "results.json")
    defaults, choices, runs = results["tables"]
    kept = [row[0] for row in runs["rows"]]
    assert kept
    assert set(kept) <= set(recorded_names())
    assert all(row[1].startswith("recorded  default, code ") for row in runs["rows"])
    assert {row[-1] for row in (*choices["rows"], *defaults["rows"])} == {"recorded"}
    assert results["settings"]["recorded"] == ", ".join(kept)
    assert f"Not run here, so by the recorded result: {', '.join(kept)}." in results["verdict"]


def test_a_full_run_is_preferred_to_the_recorded_one_and_that_to_a_newer_smoke_run(tmp_path):
    home, root = tmp_path / "pareto_contact", tmp_path / "checkout"
    assert newest_run(home, root) is None
    finished(tmp_path, "20260103-000000", TABLE["rows"], scale="smoke")
    assert newest_run(home, root).directory.name == "20260103-000000"
    results = {"git": "b" * 40, "scale": "default", "config": {}, "tables": [{**TABLE, "rows": []}]}
    write_json(root / RECORDED / "pareto_contact.json", results)
    assert newest_run(home, root).summary == "recorded  default, code bbbbbbb: finished"
    finished(tmp_path, "20260101-000000", TABLE["rows"])
    assert newest_run(home, root).directory.name == "20260101-000000"
    assert judge(DEFAULTS[1], newest_run(home, root)) == []
