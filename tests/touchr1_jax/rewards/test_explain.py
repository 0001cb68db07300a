"""`python -m touchr1_jax.rewards`: an answer's slots, terms and total, and errors of arguments."""

from unittest.mock import Mock

import jax.numpy as jnp
import pytest

from experiments.study.scores import PUBLISHED as REPORTED
from tests.touchr1_jax.rewards.examples import make_parsed, make_target
from touchr1_jax.rewards import Reward, RewardError, make_rewards, uniform_prior
from touchr1_jax.rewards.__main__ import PUBLISHED, ListRewards, main, terms_table

ANSWER = "<perceive> gelsight_mini soft xense firm </perceive> <compare> soft </compare> <conclude> firm </conclude>"


def cells(line: str) -> list[str]:
    """Cells of a table row; a line outside a table is a single cell."""
    inside = line.strip()[1:-1] if line.strip().startswith("│") else line
    return [cell.strip() for cell in inside.split("│")]


def explain(capsys, *arguments: str) -> list[list[str]]:
    """The rows that are printed for `ANSWER`."""
    assert main(["explain", "--text", ANSWER, *arguments]) == 0
    return [cells(line) for line in capsys.readouterr().out.splitlines()]


def test_every_reward_is_listed_with_what_its_file_says(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(make_rewards(uniform_prior((3, 9))))
    assert all(line.endswith(".") for line in lines)


def test_slots_terms_and_total_by_hand(capsys):
    """Accuracy .4 for the neighbour; agreement 1 − (0 + ½)/2 = ¾; R = .6 · .4 + .3 · .75 + .1."""
    rows = explain(capsys, "--label", "hardness", "soft")
    assert ["perceive xense", "firm"] in rows
    assert ["perceive tac3d", "⊥"] in rows
    assert ["compare", "soft"] in rows
    assert ["conclude", "firm"] in rows
    assert ["formatted: yes"] in rows
    assert ["length: 12, truncated: no"] in rows
    assert ["sensors that touched: gelsight_mini, xense"] in rows
    assert ["soft", "accuracy", "0.400", "0.6", "+0.240"] in rows
    assert ["", "consistency", "0.750", "0.3", "+0.225"] in rows
    assert ["", "total", "", "", "+0.565"] in rows


def test_without_a_label_every_level_is_scored(capsys):
    rows = explain(capsys, "--weights", "exact", "1")
    assert [row[0] for row in rows if row[1:2] == ["exact"]] == ["soft", "firm", "hard"]
    assert [row[-1] for row in rows if row[1:2] == ["total"]] == ["+0.000", "+1.000", "+0.000"]


def test_a_term_that_does_not_apply_leaves_its_weight_to_the_others(capsys):
    rows = explain(capsys, "--label", "hardness", "firm", "--sensors", "xense")
    assert ["", "consistency", "does not apply", "0.3", "+0.000"] in rows
    assert ["", "total", "", "", "+1.000"] in rows


def test_length_and_truncation_are_set(capsys):
    assert ["length: 7, truncated: yes"] in explain(capsys, "--length", "7", "--truncated")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("<perceive> soft </perceive> <conclude> soft </conclude>", "<compare> occurs 0 times"),
        ("<perceive> </perceive> <compare> soft </compare> <conclude> soft </conclude>", "a body is empty"),
        ("<conclude> soft </conclude> <conclude> soft </conclude>", "<conclude> occurs 2 times"),
    ],
)
def test_a_fault_of_the_format_is_named(capsys, text, fault):
    assert main(["explain", "--text", text, "--asked", "hardness"]) == 0
    assert fault in capsys.readouterr().out


def test_words_of_another_language_are_answered_with_those_that_count(capsys):
    text = "<perceive> xense weich </perceive> <compare> weich </compare> <conclude> weich </conclude>"
    assert main(["explain", "--text", text, "--label", "hardness", "soft"]) == 0
    said = capsys.readouterr().out
    assert "no slot names a level; the words that do: hardness soft, firm, hard; roughness " in said
    assert "formatted: yes" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--text", "soft"], "asked is empty and `conclude` names no level"),
        (["--text", ANSWER, "--asked", "hardnes"], "attribute 'hardnes' is not in the language; choose from hardness"),
        (["--text", ANSWER, "--label", "hardness", "squishy"], "must be one of soft, firm, hard; correct the word"),
        (["--text", ANSWER, "--sensors", "finger"], "sensors holds ['finger']: must be among gelsight_mini"),
        (["--text", ANSWER, "--weights", "brevty", "1"], "no reward is called 'brevty'; choose from accuracy"),
        (["--text", ANSWER, "--asked", "hardness", "roughness", "protrusion", "material"], "leaves 243 combinations"),
    ],
)
def test_wrong_arguments_are_named(capsys, arguments, message):
    assert main(["explain", *arguments]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["explain", "--text", ANSWER, "--length", "-1"], "length is -1: must lie in 0 … "),
        (["explain", "--text", ANSWER, "--length", "2147483648"], "length is 2147483648: must lie in 0 … "),
        (["explain", "--text", ANSWER, "--longest", "0"], "longest is 0: must lie in 1 … "),
        (["explain", "--text", ANSWER, "--weights", "accuracy", "1e300"], "weights[accuracy] is 1e+300: must be"),
        (["adversary", "--prior", "1", "1", "1"], "must be ≥ 0 and sum to 1"),
        (["adversary", "--accuracy", "nan"], "accuracy is nan: must lie in 0 … 1"),
        (["adversary", "--most", "-1"], "most is -1: must be at least 0"),
        (["adversary", "--weights", "[brevty]", "1"], "no reward is called '[brevty]'"),
    ],
)
def test_values_out_of_range_are_refused(capsys, arguments, message):
    assert main(arguments) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("twice", ["--label hardness soft hardness firm", "--weights exact 1 format 1 exact 2"])
def test_a_name_that_is_given_twice_is_refused(capsys, twice):
    with pytest.raises(SystemExit):
        main(["explain", "--text", ANSWER, *twice.split()])
    assert f"{twice.split()[1]} is given twice" in capsys.readouterr().err


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt, 130), (OSError("full"), 1)])
def test_ctrl_c_and_a_full_disk_leave_no_traceback(monkeypatch, error, status):
    monkeypatch.setattr(ListRewards, "run", Mock(side_effect=error))
    assert main(["list"]) == status


def test_what_cannot_be_trained_is_not_explained():
    branching = {"mine": Reward(lambda parsed, target: jnp.float32(1 if parsed.length > 3 else 0))}
    with pytest.raises(RewardError, match="reward 'mine': value cannot be traced"):
        terms_table(branching, {"mine": 1.0}, make_parsed(), iter([("soft", make_target())]))


@pytest.mark.long
def test_what_can_be_nan_is_not_explained():
    """The variance of one sensor's report; training would refuse it with the same words."""
    spread = Reward(lambda p, t: jnp.var(p.perceive[:, 0]) * jnp.sum(t.streams) / (jnp.sum(t.streams) - 1))
    with pytest.raises(RewardError, match=r"reward 'mine' is nan for .*: must be finite everywhere"):
        terms_table({"mine": spread}, {"mine": 1.0}, make_parsed(), iter([("soft", make_target())]))


def test_the_truth_about_what_is_not_asked_is_seen():
    """A reward that pays for metal, whatever the question: the same label reaches it in training."""
    metal = {"mine": Reward(lambda p, t: 1.0 * (t.label[-1] == 1))}
    rows = list(
        terms_table(metal, {"mine": 1.0}, make_parsed(), iter([("soft", make_target(label=(0, 0, 1)))])).columns
    )
    assert next(iter(rows[2].cells)) == "1.000"


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "status"), [([], 0), (["--weights", "accuracy", "0.6", "consistency", "0.3", "format", "0.1"], 1)]
)
def test_the_search_fails_where_an_answer_outwits_the_last_rewards(capsys, arguments, status):
    assert main(["adversary", "--prior", "0.5", "0.3", "0.2", *arguments]) == status
    assert "of 3274 answers earn more than the honest" in " ".join(capsys.readouterr().out.split())


def test_the_published_weights_are_those_that_reports_use():
    assert dict(PUBLISHED) == dict(REPORTED)
