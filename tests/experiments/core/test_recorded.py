"""Figures of the documents are those of recorded runs."""

import re

import pytest

from experiments.core.artifacts import read_json, write_json
from experiments.core.recorded import DOCUMENTS, FigureError, filled, main, record, shown
from experiments.core.runs import ROOT

RESULTS = {
    "experiment": "coin",
    "arms": {"paid": {"acc": {"mean": 62.96, "ci95": [60.0, 65.0]}}},
    "requirements": [{"name": "least gain", "measured": -0.25}],
    "tables": [{"title": "Tosses", "columns": [{"name": "coin"}, {"name": "heads"}], "rows": [["gold", 7]]}],
}


@pytest.fixture
def root(tmp_path):
    """A checkout with one recorded run."""
    run = tmp_path / "runs" / "coin"
    run.mkdir(parents=True)
    write_json(run / "results.json", RESULTS)
    record(run, tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("coin :: arms :: paid :: acc :: mean :: .0f", "63"),
        ("coin :: requirements :: least gain :: measured :: +.2f", "−0.25"),
        ("coin :: tables :: Tosses :: gold :: heads :: d", "7"),
    ],
)
def test_a_mark_names_a_figure(root, path, text):
    assert shown(path, root) == text
    before = f"A <!--= {path} -->?<!--/--> b, <!--= {path} --><!--/-->."
    assert filled(before, root) == f"A <!--= {path} -->{text}<!--/--> b, <!--= {path} -->{text}<!--/-->."
    assert filled(filled(before, root), root) == filled(before, root)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("dice :: arms :: .0f", "no run of 'dice'"),
        ("coin :: arms :: unpaid :: .0f", "'unpaid' must be one of paid"),
        ("coin :: arms :: paid :: .0f", "has no format '.0f'"),
        ("coin :: tables :: Tosses :: silver :: heads :: d", "'silver' must be one of gold"),
        ("coin :: arms :: paid :: acc :: mean :: x :: d", "'x' must be one of 62.96"),
        ("coin :: .0f", "must have a key and a format"),
    ],
)
def test_a_mark_that_names_nothing_is_refused(root, path, message):
    with pytest.raises(FigureError, match=message):
        filled(f"<!--= {path} -->1<!--/-->", root)


def test_a_run_is_recorded_whole_and_only_when_finished(root, tmp_path, capsys):
    assert read_json(root / "experiments" / "recorded" / "coin.json") == RESULTS
    assert main(["record", str(tmp_path)]) == 1
    assert "finish it first" in capsys.readouterr().err


def test_paths_of_the_machine_are_not_recorded(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    config = {
        "data_dir": "/home/someone/touch data/x",
        "folder": "/home/someone/touch",
        "paths": ["/a/b.npz", "1/2", "/"],
    }
    write_json(run / "results.json", {"experiment": "coin", "config": config})
    told = read_json(record(run, tmp_path))["config"]
    assert told == {"data_dir": "x", "folder": "touch", "paths": ["b.npz", "1/2", "/"]}


NUMBER = re.compile(r"\d+(?:\.\d+)? ?(?:%|ms\b|s\b|µm|GB|MB|points\b|min\b)|\b\d+(?:\.\d+)? of \d+")
"""What looks like a measured figure."""


@pytest.mark.parametrize("document", DOCUMENTS, ids=str)
def test_every_figure_of_the_documents_comes_from_a_recorded_run(document):
    text = (ROOT / document).read_text(encoding="utf-8")
    for left_out in (r"```.*?```", r"^    .*?$", r"`[^`]*`", r"<!--= .*?<!--/-->"):
        text = re.sub(left_out, "", text, flags=re.DOTALL | re.MULTILINE)
    assert NUMBER.findall(text) == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=str)
def test_the_documents_say_what_was_recorded(document):
    text = (ROOT / document).read_text(encoding="utf-8")
    assert filled(text) == text, "run: python -m experiments.core.recorded fill"
