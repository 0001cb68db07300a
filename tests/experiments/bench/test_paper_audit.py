"""The audit of the paper, whole: it takes seconds."""

import pytest

from experiments.bench import paper_audit
from experiments.core.artifacts import read_json
from tests.experiments.shrunk import run_shrunk


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return run_shrunk(paper_audit, paper_audit.DEFAULT, tmp_path_factory.mktemp("runs"))


def test_everything_is_reported(directory):
    results = read_json(directory / "results.json")
    assert all(r["met"] for r in results["requirements"])
    titles = [table["title"] for table in results["tables"]]
    assert titles[:3] == ["What does not stand", "What holds", "Avg"]
    assert len(results["tables"][0]["rows"]) == 14
    assert {p.stem for p in (directory / "plots").iterdir()} == {"distance", "average"}


def test_a_test_set_has_questions():
    with pytest.raises(ValueError, match="vtv_items is 0"):
        paper_audit.PaperAuditConfig(vtv_items=0)
