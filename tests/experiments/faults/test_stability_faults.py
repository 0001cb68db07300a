"""The experiment from parts that are known, and, slowly, as a whole."""

import dataclasses

import pytest

from experiments.core.artifacts import read_json
from experiments.faults import stability_faults
from experiments.faults.damaged_files import OLDER, SAME, WRONG, strike
from experiments.faults.data_waits import WaitingConfig
from experiments.faults.fixtures import unfinished_run
from experiments.faults.kill_charts import where_kills_struck
from experiments.faults.killable_session import START, STEPPING, Kill
from tests.experiments import tiny
from tests.experiments.encoder.test_pretrain_encoder import PRETRAIN
from tests.experiments.shrunk import run_shrunk

STRUCK = Kill(phase=STEPPING["sft"], after_s=2.0, done=0.5, torn=True)
AT_START = dataclasses.replace(STRUCK, phase=START, torn=False)


def findings(differs=(), damage=(), inputs=()):
    """Figures of the report from 150 kills in steps and 50 at start-up."""
    struck = (STRUCK,) * 150 + (AT_START,) * 50
    killed = {stability_faults.GRPO: stability_faults.KilledRuns(kills=struck, runs=1, differs=differs)}
    waited = {"sft/0": (10.0, 0.1)}
    parts = (killed, damage, inputs, waited)
    met = {r.name: r.met for r in stability_faults._requirements(*parts)}
    return met, stability_faults._verdict(*parts), stability_faults._kill_table(killed)


GOOD = [("run", f"input {i}", 1, "Error: as it must be", "") for i in range(25)]


def test_all_is_met_where_nothing_differs():
    met, verdict, table = findings(damage=[("config.json", "removed", SAME, "")], inputs=GOOD)
    assert all(met.values())
    assert "the GRPO run was killed 200 times in 1 run and ended in the same bits" in verdict[0]
    assert "1.00% of a training step waits" in verdict[3]
    assert dict(zip((c.name for c in table.columns), table.rows[0], strict=True))["torn lines"] == 150


def test_tables_hold_a_row_for_each_thing():
    damage = [("config.json", "removed", SAME, ""), ("x", "emptied", OLDER, "it is kept as damaged-12")]
    struck, tried = stability_faults._damage_table(damage), stability_faults._input_table(GOOD)
    assert [row[0] for row in struck.rows] == ["config.json, removed", "x, emptied"]
    assert [sum(row[1:-1]) for row in struck.rows] == [1, 1]
    assert len(tried.rows) == len(GOOD)
    assert stability_faults._waiting_table({"sft/0": (10.0, 0.1)}).rows == (("sft/0", 10.0, 0.1, 1.0),)
    assert where_kills_struck({"study": [STRUCK, AT_START]}).startswith(b"<?xml")


def test_a_difference_a_wrong_end_and_an_answer_that_lacks_something_are_not_met():
    damage = [("config.json", "removed", WRONG, ""), ("x", "emptied", OLDER, "")]
    bad = [*GOOD, ("run", "one more", 0, "", "the exit code is 0")]
    met, verdict, _ = findings(differs=("run 0: metrics.jsonl",), damage=damage, inputs=bad)
    assert {name for name, ok in met.items() if not ok} == {
        "files that differ after them",
        "damaged files with a wrong end",
        "kinds of bad input not answered",
    }
    assert "differs in run 0: metrics.jsonl" in verdict[0]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_damaged_checkpoint_ends_the_same_or_names_what_is_wrong(tmp_path, context):
    unfinished, scratch = tmp_path / "unfinished", tmp_path / "scratch"
    for folder in (unfinished, scratch):
        folder.mkdir()
    unfinished_run(unfinished)
    outcomes = [one.outcome for one in strike(unfinished, scratch, context, most=3)]
    assert outcomes
    assert WRONG not in outcomes


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_the_whole_experiment(tmp_path, cache_dir):
    waiting = WaitingConfig(steps=2, study=tiny.STUDY, dynamics=PRETRAIN)
    config = dataclasses.replace(stability_faults.SMOKE, damaged_files=1, bad_inputs=6, waiting=waiting)
    directory = run_shrunk(stability_faults, config, tmp_path, "--cache-dir", str(cache_dir))
    results = read_json(directory / "results.json")
    met = {r["name"]: r["met"] for r in results["requirements"]}
    assert met["files that differ after them"]
    assert met["damaged files with a wrong end"]
    assert met["kinds of bad input not answered"]
    assert (directory / "plots" / "stability_faults.svg").stat().st_size > 0
