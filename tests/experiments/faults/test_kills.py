"""What a kill struck is told from the disk; a killed training ends in the bits of one that was left alone."""

import json

import numpy as np
import pytest

from experiments.faults.digests import differences, digests
from experiments.faults.killable_session import PHASES, KillableTraining, look
from experiments.faults.kills import ALONE, Campaign, KillConfig, KillSchedule

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


def struck_at(kills, steps, save_every, speed, *, seed=0):
    """Shares of a run at which kills strike that each lose what was done since the last checkpoint."""
    rng, step, reached, struck = np.random.default_rng(seed), 0, 0, []
    pace = KillSchedule(work_s=10.0)
    while len(struck) < kills:
        pace.went_on(reached / steps, step / steps)
        life_s = rng.uniform(0, pace.most_life_s(step / steps, kills - len(struck)))
        reached = step + int(speed * life_s / 10 * steps)
        if reached >= steps:
            break
        pace.lived((reached - step) / steps, life_s)
        step = reached - reached % save_every
        struck.append(reached / steps)
    return np.asarray(struck)


@pytest.mark.parametrize("speed", [0.3, 1.0, 2.0])  # against the run that was left alone
@pytest.mark.parametrize("save_every", [5, 20])
def test_kills_strike_the_whole_run_though_each_loses_work(speed, save_every):
    struck = struck_at(200, 2000, save_every, speed)
    assert len(struck) == 200  # in one run
    tenths = np.histogram(struck, 10, (0, 1))[0]
    assert tenths.max() < 60
    assert (tenths >= 4).sum() >= 8


def test_a_last_life_ends_before_the_run_and_one_of_many_is_its_share():
    pace = KillSchedule(work_s=10.0)
    assert pace.most_life_s(0.0, 1) == pytest.approx(9.0)
    assert pace.most_life_s(0.5, 49) == pytest.approx(0.2)
    pace.went_on(0.52, 0.5)
    assert pace.most_life_s(0.5, 49) == pytest.approx(0.6)
    assert pace.most_life_s(1.0, 3) == 0.0
    pace.lived(0.05, 1.5)  # a third of the speed
    assert pace.most_life_s(0.5, 49) == pytest.approx(1.2)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "phase", "steps"), [("counting", "count", 60), ("small_grpo", "grpo", 40)])
def test_killed_training_ends_in_the_same_bits(tmp_path, name, phase, steps):
    """Though the kills are counted by two callers, of which the first is gone after one."""
    victim = KillableTraining(name=name, options=("--steps", str(steps)), steps={phase: steps})
    campaign = Campaign(tmp_path / "home", tmp_path / "cache", victim, KillConfig(kills=3))
    alone = campaign.left_alone()
    assert alone.digests == digests(campaign.directory(ALONE))
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
    assert not differences(alone.digests, digests(campaign.directory("0")))
    assert 1 < len(kills) <= 3
    assert all(kill.phase in PHASES and 0 <= kill.done <= 1 for kill in kills)
