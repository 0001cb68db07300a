"""What a kill struck is told from the disk; a killed training ends in the bits of one that was left alone."""

import json

import numpy as np
import pytest

from experiments.faults.kills import ALONE, PHASES, Campaign, KillConfig, Victim, differences, evidence, look

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
    seen = look(tmp_path)
    assert (seen.lines, seen.last, seen.torn, seen.answers) == (lines, last, torn, 0)


def test_a_run_that_has_not_begun_holds_nothing(tmp_path):
    assert look(tmp_path).lines == 0


def test_what_differs_is_named():
    assert differences({"a": "1", "b": "2"}, {"a": "1", "b": "3", "c": "4"}) == ("b", "c")
    assert differences({"a": "1"}, {"a": "1"}) == ()


@pytest.mark.parametrize("changed", [{"kills": 0}, {"startup_share": 1.0}, {"life_s": 0.0}])
def test_kills_that_cannot_be_are_refused(changed):
    with pytest.raises(ValueError, match="needs kills"):
        KillConfig(**changed)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "phase", "steps"), [("counting", "count", 16), ("reinforcing", "grpo", 24)])
def test_killed_training_ends_in_the_same_bits(tmp_path, name, phase, steps):
    victim = Victim(name=name, options=("--steps", str(steps)), steps={phase: steps})
    campaign = Campaign(tmp_path / "home", tmp_path / "cache", victim, KillConfig(kills=3, life_s=0.3))
    alone = campaign.left_alone()
    kills = campaign.killed("killed", 3, np.random.default_rng(0))
    assert not differences(evidence(alone), evidence(campaign.directory("killed")))
    assert 0 < len(kills) <= 3
    assert all(kill.phase in PHASES and 0 <= kill.done <= 1 for kill in kills)
    assert campaign.directory(ALONE) == alone
