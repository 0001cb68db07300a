"""Figures of the documents are those of recorded runs."""

import re
from pathlib import Path

import pytest

from experiments.core.artifacts import DamagedFileError, read_json, write_json
from experiments.core.commands import run_command
from experiments.core.recorded import (
    BEGIN,
    END,
    RECORDED,
    TABLE,
    FigureError,
    figure,
    filled,
    main,
    record,
    recorded_run,
)
from experiments.core.runs import ROOT
from experiments.core.text import SMOKE

RESULTS = {
    "experiment": "coin",
    "verdict": [],
    "config": {"data_dir": "/home/someone/touch data/x", "paths": ["/a/b.npz", "1/2", "/"]},
    "arms": {"paid": {"acc": {"mean": 62.96, "ci95": [60.0, 65.0]}}},
    "requirements": [{"name": "least gain", "measured": -0.25}],
    "tables": [{"title": "Tosses", "columns": [{"name": "coin"}, {"name": "heads"}], "rows": [["gold", 7]]}],
}


DESCRIPTION = {
    "experiment": "coin",
    "scale": "default",
    "config": RESULTS["config"],
    "git": {"commit": "0123456789", "dirty": False},
    "command": "python -m experiments coin",
}


@pytest.fixture
def root(tmp_path):
    """A checkout with one recorded run."""
    run = tmp_path / "runs" / "coin"
    write_json(run / "config.json", DESCRIPTION)
    write_json(run / "results.json", RESULTS)
    record(run, tmp_path)
    return tmp_path


def test_rows_are_filled_with_their_figures(root):
    figures = (
        "{arms > paid > acc > mean | .0f} % of {tables > Tosses > gold > heads | d}, "
        "{requirements > least gain > measured | +.2f}"
    )
    (root / RECORDED / TABLE).write_text(f"| tosses | {figures} | `coin` |\n")
    text = filled(f"before {BEGIN} old {END} after", root)
    assert "| tosses | 63 % of 7, −0.25 | `coin` |" in text
    assert text.startswith("before ")
    assert text.endswith(" after")
    assert filled(text, root) == text


@pytest.mark.parametrize(
    ("name", "path", "spec", "message"),
    [
        ("dice", "arms", "d", "'dice': no run of it is recorded"),
        ("coin", "arms > unpaid", ".0f", "'unpaid' must be one of paid"),
        ("coin", "arms > paid", ".0f", "has no format '.0f'"),
        ("coin", "tables > Tosses > silver > heads", "d", "'silver' must be one of gold"),
        ("coin", "arms > paid > acc > mean > x", "d", "'x' must be one of 62.96"),
    ],
)
def test_a_figure_that_no_run_gives_is_refused(root, name, path, spec, message):
    with pytest.raises(FigureError, match=message):
        figure(name, path, spec, root)


def test_a_finished_run_is_recorded_whole_but_for_paths_of_the_machine(root, tmp_path, capsys):
    recorded = read_json(root / RECORDED / "coin.json")
    assert recorded == RESULTS | {"config": {"data_dir": "x", "paths": ["b.npz", "1/2", "/"]}}
    assert main(["record", str(tmp_path)]) == 1
    assert "finish it first" in capsys.readouterr().err
    with pytest.raises(DamagedFileError, match=r"coin\.json is not that of a run .*'git'"):
        recorded_run("coin", tmp_path, root)
    write_json(tmp_path / "config.json", DESCRIPTION)
    for damaged in ("{", "[]"):
        (tmp_path / "results.json").write_text(damaged)
        assert main(["record", str(tmp_path)]) == 1
        assert "results.json is" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "said"),
    [({"config": {}}, "is of another run, with another config"), ({"scale": SMOKE}, "the figures mean nothing")],
)
def test_results_of_another_run_and_of_smoke_are_not_recorded(root, change, said):
    write_json(root / "runs" / "coin" / "config.json", DESCRIPTION | change)
    with pytest.raises((DamagedFileError, FigureError), match=said):
        record(root / "runs" / "coin", root)
    assert "paid" in read_json(root / RECORDED / "coin.json")["arms"]


@pytest.mark.long
def test_a_recorded_run_is_shown_as_its_report(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_command(["show", "conflict", "--runs-dir", str(tmp_path)], "experiments") == 0
    page = (tmp_path / "conflict" / "recorded" / "report.html").read_text(encoding="utf-8")
    assert "When picture and touch of an object disagree" in page
    assert "Scores on unseen objects" in page
    (tmp_path / "file").touch()
    for place in ("file", "s3://bucket/runs"):  # no folder of the URL's name is made
        assert run_command(["show", "conflict", "--runs-dir", place], "experiments") == 1
        assert f"runs-dir is {Path(place)}: must be a folder that can be written" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"file", "conflict"}
    assert run_command(["show", "conflcit", "--runs-dir", str(tmp_path)], "experiments") == 2
    assert "Did you mean conflict?" in capsys.readouterr().err
    assert run_command(["show", "touch_r1", "--runs-dir", str(tmp_path)], "experiments") == 1
    assert "choose from ablation_cumulative" in capsys.readouterr().err


def test_the_readme_shows_what_was_recorded():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert filled(text) == text, "run: python -m experiments.core.recorded fill"


NUMBER = re.compile(r"\d+(?:\.\d+)? ?(?:%|ms\b|s\b|µm|GB|MB|points\b|min\b)|\b\d+(?:\.\d+)? of \d+")
"""Text that looks like a measured figure."""


@pytest.mark.parametrize(
    "document", ["README.md", *(f"{p}/README.md" for p in ("touchr1_jax", "sensors_io", "experiments"))]
)
def test_no_other_figure_stands_in_the_documents(document):
    text = (ROOT / document).read_text(encoding="utf-8")
    for left_out in (r"```.*?```", r"^    .*?$", r"`[^`]*`", re.escape(BEGIN[:13]) + ".*?" + re.escape(END)):
        text = re.sub(left_out, "", text, flags=re.DOTALL | re.MULTILINE)
    assert NUMBER.findall(text) == []
