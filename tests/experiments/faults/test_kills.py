"""The state of a run is read from its files; a killed training ends in the bits of an undisturbed one."""

import json

import numpy as np
import pytest

from experiments.faults.digests import differences, digests
from experiments.faults.kills import (
    PHASES,
    UNDISTURBED,
    Campaign,
    KillableTraining,
    KillConfig,
    KillSchedule,
    log_state,
)

LINE = json.dumps({"stage": "sft/0", "step": 3, "loss": 1.0}) + "\n"


@pytest.mark.parametrize(
    ("text", "lines", "last", "torn"),
    [
        (None, 0, None, False),
        ("", 0, None, False),
        (LINE, 1, ("sft/0", 3), False),
        (LINE + LINE[:7], 1, ("sft/0", 3), True),
        (LINE[:7], 0, None, True),
    ],
)
def test_whole_lines_are_distinguished_from_a_torn_one(tmp_path, text, lines, last, torn):
    if text is not None:
        (tmp_path / "metrics.jsonl").write_text(text)
    assert log_state(tmp_path) == (lines, last, torn)


def struck_at(kills, steps, save_every, speed, *, seed=0):
    """Shares of a run at which kills strike that each lose what was done since the last checkpoint."""
    rng, step, reached, struck = np.random.default_rng(seed), 0, 0, []
    schedule = KillSchedule(work_s=10.0)
    while len(struck) < kills:
        schedule.add_loss(reached / steps, step / steps)
        life_s = rng.uniform(0, schedule.longest_life_s(step / steps, kills - len(struck)))
        reached = step + int(speed * life_s / 10 * steps)
        if reached >= steps:
            break
        schedule.add_life((reached - step) / steps, life_s)
        step = reached - reached % save_every
        struck.append(reached / steps)
    return np.asarray(struck)


@pytest.mark.parametrize("speed", [0.3, 1.0, 2.0])  # relative to the undisturbed run
@pytest.mark.parametrize("save_every", [5, 20])
def test_kills_strike_the_whole_run_though_each_loses_work(speed, save_every):
    struck = struck_at(200, 2000, save_every, speed)
    assert len(struck) == 200  # in one run
    tenths = np.histogram(struck, 10, (0, 1))[0]
    assert tenths.max() < 60
    assert (tenths >= 4).sum() >= 8


def test_a_last_life_ends_before_the_run_and_one_of_many_is_its_share():
    schedule = KillSchedule(work_s=10.0)
    assert schedule.longest_life_s(0.0, 1) == pytest.approx(9.0)
    assert schedule.longest_life_s(0.5, 49) == pytest.approx(0.2)
    schedule.add_loss(0.52, 0.5)
    assert schedule.longest_life_s(0.5, 49) == pytest.approx(0.6)
    assert schedule.longest_life_s(1.0, 3) == 0.0
    schedule.add_life(0.05, 1.5)  # a third of the speed
    assert schedule.longest_life_s(0.5, 49) == pytest.approx(1.2)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "phase", "steps"), [("counting", "count", 60), ("small_grpo", "grpo", 40)])
def test_killed_training_ends_in_the_same_bits(tmp_path, name, phase, steps):
    """The kills are counted by two callers, of which the first stops after one kill."""
    training = KillableTraining(name=name, options=("--steps", str(steps)), steps={phase: steps})
    campaign = Campaign(tmp_path / "home", tmp_path / "cache", training, KillConfig(kills=3))
    undisturbed = campaign.run_undisturbed()
    assert undisturbed.digests == digests(campaign.directory(UNDISTURBED))
    assert undisturbed.lines == steps

    class CallerStopped(Exception):
        """The first caller stops."""

    kept = []

    def keep(struck):
        kept[:] = struck
        raise CallerStopped

    with pytest.raises(CallerStopped):
        campaign.run_killed(0, 3, undisturbed, keep=keep)
    assert len(kept) == 1
    kills = campaign.run_killed(0, 3, undisturbed, before=kept)
    assert kills == campaign.run_killed(0, 3, undisturbed, before=kills)  # it has ended, and is not begun anew
    assert not differences(undisturbed.digests, digests(campaign.directory("0")))
    assert 1 < len(kills) <= 3
    assert all(kill.phase in PHASES and 0 <= kill.done <= 1 for kill in kills)
