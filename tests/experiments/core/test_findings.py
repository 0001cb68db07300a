"""Results refuse what must not be published, say whether bounds are kept, and fill a self-contained report."""

import dataclasses
import json

import pytest

from experiments.core.errors import ResultsError
from experiments.core.report import write_report
from experiments.core.results import Column, Picture, Requirement, Results, Table
from tests.experiments.core.test_report import DESCRIPTION, HOSTILE, VOID, read

FAST = Requirement(name="frame", measured=2.0, bound=2.5, better="lower", unit="ms")
SLOW = Requirement(name="rate", measured=399.0, bound=400.0, better="higher", unit="records/s", note="one core")
SVG = b'<svg xmlns="http://www.w3.org/2000/svg"/>'


def findings(**changes) -> Results:
    table = Table(
        title="Tiers",
        columns=(
            Column(name="tier"),
            Column(name="time", unit="ms", format=".2f", meaning="median"),
            Column(name="ok"),
        ),
        rows=(("spg", -2.0, True), ("winkler", None, False)),
    )
    chart = Picture(name="pareto", title="Speed", caption="left is faster", content=SVG)
    made = {"verdict": ("It is fast.",), "requirements": (FAST, SLOW), "tables": (table,), "pictures": (chart,)}
    return Results(**(made | changes))


def test_a_bound_is_kept_on_its_own_side():
    assert FAST.met
    assert not SLOW.met
    assert dataclasses.replace(SLOW, measured=400.0).met
    assert not dataclasses.replace(FAST, measured=2.51).met


def test_the_json_holds_the_figures_and_whether_bounds_are_kept():
    written = findings().to_json(DESCRIPTION)
    assert [r["met"] for r in written["requirements"]] == [True, False]
    assert written["tables"][0]["rows"] == [["spg", -2.0, True], ["winkler", None, False]]
    assert written["git"] == "a" * 40 + "-dirty"
    assert "pictures" not in written
    json.dumps(written, allow_nan=False)


def test_the_report_shows_everything_and_loads_nothing(tmp_path):
    path = write_report(tmp_path, findings(), about="How fast?\n\nmake it", description=DESCRIPTION)
    page = read(path.read_text())
    for text in ("How fast?", "It is fast.", "NOT MET", "≥ 400 records/s", "−2.00", "winkler", "–", "left is faster"):
        assert text in page.text
    assert all(source.startswith("data:") for source in page.loads)
    assert page.seen.isdisjoint({"script", *(VOID - {"img", "meta"})})
    assert (tmp_path / "plots" / "pareto.svg").read_bytes() == SVG


def test_hostile_text_stays_text(tmp_path):
    bad = findings(verdict=(HOSTILE,), requirements=(dataclasses.replace(SLOW, note=HOSTILE),))
    page = read(write_report(tmp_path, bad, about=HOSTILE, description=DESCRIPTION).read_text())
    assert "script" not in page.seen
    assert page.text.count(HOSTILE) >= 3


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"verdict": ()}, "verdict is .*: must hold a sentence"),
        ({"requirements": (dataclasses.replace(FAST, measured=float("nan")),)}, "requirement 'frame'"),
        ({"pictures": 2 * (Picture(name="a", title="", caption="", content=SVG),)}, "names of their own"),
    ],
)
def test_what_must_not_be_published_is_refused(changes, said):
    with pytest.raises(ResultsError, match=said):
        findings(**changes)


def test_a_row_with_a_missing_cell_is_refused():
    with pytest.raises(ResultsError, match="must have 2 cells"):
        Table(title="t", columns=(Column(name="a"), Column(name="b")), rows=(("x",),))
