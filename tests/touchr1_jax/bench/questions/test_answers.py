"""Models behind a function, and files of answers, are scored."""

import pytest

from touchr1_jax.bench.json_lines import LinesError
from touchr1_jax.bench.questions.answers import ask_all, average_line, metric_rows, parsed_share, read_answers


def test_right_answers_have_the_full_score(items):
    answers = ask_all(items, lambda item: item.rationale)
    assert average_line(items, answers) == "average 100.0"
    assert parsed_share(answers) == 1.0


def test_a_constant_answer_is_at_chance(items):
    text = "<perceive> - </perceive> <compare> - </compare> <conclude> soft smooth flat plastic first </conclude>"
    answers = ask_all(items, lambda item: text)
    rows = {row.name: row.interval for row in metric_rows(items, answers, by_sight=answers)}
    assert rows["conflict_acc"].mean == rows["revision_rate"].mean == 0.0  # answers by sight revise nothing
    assert rows["h_acc"].mean == pytest.approx(100 / 3, abs=0.1)
    assert rows["sfd"].mean == 50.0
    assert rows["sfd_swap"].mean == 0.0
    assert rows["soi_rho"].mean == 0.0  # no order can be read
    assert rows["csc_agree"].mean == 100.0
    assert rows["h_acc"].low < 100 / 3 < rows["h_acc"].high


def test_a_missing_answer_is_unparsable(items):
    answers = read_answers([], items)
    assert parsed_share(answers) == 0.0
    assert average_line(items, answers) == "average 0.0"
    assert average_line(items[:1], answers).startswith("no average without r_acc, p_acc, mat_acc, l2_em")


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([{"id": "x"}], "must have id and text"),
        ([{"id": "identify-0000", "text": 3}], "text, strings"),
        ([{"id": "identify-0000", "text": ""}] * 2, r"line 2: .* answer each once"),
    ],
)
def test_invalid_answers_are_refused(items, rows, message):
    with pytest.raises(LinesError, match=message):
        read_answers(enumerate(rows, 1), items)
