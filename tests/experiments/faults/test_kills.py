"""What a kill struck is told from the disk; a killed training ends in the bits of one that was left alone."""

import json

import pytest

from experiments.faults.evidence import differences, evidence
from experiments.faults.kills import ALONE, Campaign, KillConfig
from experiments.faults.watched import PHASES, Victim, look

LINE = json.dumps({"stage": "sft/0", "step": 3, "loss": 1.0}) + "\n"


@pytest.mark.parametrize(
    ("text", "lines", "last", "torn"),
    [
        ("", 0, None, False),
        (LINE, 1, ("sft/0", 3), False),
        (LINE + LINE[:7], 1, ("sft/0", 3), True),
        (LINE[:7], 0, None, True),
    ],
)
def test_whole_lines_and_a_torn_one_are_told_apart(tmp_path, text, lines, last, torn):
    (tmp_path / "metrics.jsonl").write_text(text)
    assert look(tmp_path) == (lines, last, torn)


def test_a_run_that_has_not_begun_holds_nothing(tmp_path):
    assert look(tmp_path).lines == 0


def test_what_differs_is_named():
    assert differences({"a": "1", "b": "2"}, {"a": "1", "b": "3", "c": "4"}) == ("b", "c")
    assert differences({"a": "1"}, {"a": "1"}) == ()


@pytest.mark.parametrize("changed", [{"kills": 0}, {"startup_share": 1.0}])
def test_kills_that_cannot_be_are_refused(changed):
    with pytest.raises(ValueError, match="needs kills"):
        KillConfig(**changed)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "phase", "steps"), [("counting", "count", 60), ("reinforcing", "grpo", 40)])
def test_killed_training_ends_in_the_same_bits(tmp_path, name, phase, steps):
    """Though the kills are counted by two callers, of which the first is gone after one."""
    victim = Victim(name=name, options=("--steps", str(steps)), steps={phase: steps})
    campaign = Campaign(tmp_path / "home", tmp_path / "cache", victim, KillConfig(kills=3))
    alone = campaign.left_alone()
    assert alone.evidence == evidence(campaign.directory(ALONE))
    assert alone.lines == steps

    class Gone(Exception):
        """The first caller is no more."""

    kept = []

    def keep(struck):
        kept[:] = struck
        raise Gone

    with pytest.raises(Gone):
        campaign.killed(0, 3, alone, keep=keep)
    assert len(kept) == 1
    kills = campaign.killed(0, 3, alone, before=kept)
    assert kills == campaign.killed(0, 3, alone, before=kills)  # it has ended, and is not begun anew
    assert not differences(alone.evidence, evidence(campaign.directory("0")))
    assert 1 < len(kills) <= 3
    assert all(kill.phase in PHASES and 0 <= kill.done <= 1 for kill in kills)
