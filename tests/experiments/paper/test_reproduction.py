"""The page of claims is that of the recorded runs, and verdicts follow from intervals."""

import pytest

from experiments.core.runs import ROOT
from experiments.paper.claims import CLAIMS, ClaimedChange
from experiments.paper.reproduction import PAGE, markdown, outcomes

ABOVE, BELOW, AROUND = [1.0, 1.1, 1.2], [-1.0, -1.1, -1.2], [-1.0, 0.1, 1.2]


def run(values):
    row = lambda seeds: {"acc": {"per_seed": seeds}}
    return {"arms": {"a": row(values), "b": row([0.0] * len(values))}}


@pytest.mark.parametrize(
    ("values", "better", "verdict"),
    [
        (ABOVE, "higher", "holds"),
        (BELOW, "higher", "does not hold"),
        (BELOW, "lower", "holds"),
        (AROUND, "higher", "undecided"),
        ([1.0], "higher", "undecided"),
    ],
)
def test_a_verdict_follows_from_the_interval(values, better, verdict):
    change = ClaimedChange(name="acc", metrics=("acc",), arm="a", against="b", better=better)
    assert change.verdict(change.measured(run(values))) == verdict


def test_an_interval_is_read_from_a_note_or_a_cell():
    table = {"title": "t", "columns": [{"name": "x"}, {"name": "gain"}], "rows": [["row", "−0.2 [−0.3, −0.1]"]]}
    requirement = {"name": "r", "measured": 4.0, "note": "95 % over seeds [3.5, 4.5]; 9 questions"}
    for path, expected in (("tables > t > row > gain", (-0.2, -0.3, -0.1)), ("requirements > r", (4.0, 3.5, 4.5))):
        found = ClaimedChange(name="x", path=path).measured({"tables": [table], "requirements": [requirement]})
        assert (found.mean, found.low, found.high) == expected


def test_the_page_is_that_of_the_recorded_runs(tmp_path):
    written = (ROOT / PAGE).read_text(encoding="utf-8")
    assert written == markdown(outcomes()), "run: python -m experiments.paper.reproduction"
    assert {o.verdict for o in outcomes(tmp_path)[: len(CLAIMS)]} == {"undecided"}  # nothing is recorded there
