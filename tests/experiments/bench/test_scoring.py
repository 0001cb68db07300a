"""Models behind a function are asked and scored."""

import pytest

from experiments.bench.scoring import ask_all, average_line, metric_rows, parsed_share, read_answers
from touchr1_jax.bench.json_lines import LinesError


def constant(item) -> str:
    return "<perceive> - </perceive> <compare> - </compare> <conclude> soft smooth flat plastic first </conclude>"


def test_who_knows_all_has_all(items):
    said = ask_all(items, lambda item: item.rationale)
    assert average_line(items, said) == "average 100.0"
    assert parsed_share(said) == 1.0


def test_a_constant_has_chance(items):
    said = ask_all(items, constant)
    rows = {row.name: row.interval for row in metric_rows(items, said, by_sight=said)}
    assert rows["conflict_acc"].mean == rows["revision_rate"].mean == 0.0  # who follows sight revises nothing
    assert rows["h_acc"].mean == pytest.approx(100 / 3, abs=0.1)
    assert rows["sfd"].mean == 50.0
    assert rows["sfd_swap"].mean == 0.0
    assert rows["soi_rho"].mean == 0.0  # no order can be read
    assert rows["csc_agree"].mean == 100.0
    assert rows["h_acc"].low < 100 / 3 < rows["h_acc"].high


def test_silence_is_unparsable(items):
    said = read_answers([], items)
    assert parsed_share(said) == 0.0
    assert average_line(items, said) == "average 0.0"
    assert average_line(items[:1], said).startswith("no average without r_acc, p_acc, mat_acc, l2_em")


@pytest.mark.parametrize(
    ("row", "message"), [({"id": "x"}, "must have id and text"), ({"id": "identify-0000", "text": 3}, "text, strings")]
)
def test_what_is_no_answer_is_named(items, row, message):
    with pytest.raises(LinesError, match=message):
        read_answers([(1, row)], items)


def test_each_question_is_answered_once(items):
    row = {"id": items[0].ask.id, "text": ""}
    with pytest.raises(LinesError, match=r"line 2: .* answer each once"):
        read_answers([(1, row), (2, row)], items)
