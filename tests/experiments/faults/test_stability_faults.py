"""Requirements and tables from known parts, and, slowly, the experiment as a whole."""

import dataclasses
import shutil

import pytest

from experiments.core.artifacts import read_json
from experiments.faults import flipped_bits, stability_faults
from experiments.faults.damaged_files import OLDER, OUTCOMES, SAME, WRONG, Damage, damage_each
from experiments.faults.fixtures import unfinished_run
from experiments.faults.flipped_bits import FOUND, RAW, Flip
from experiments.faults.kills import START, STEPPING, Kill
from experiments.faults.stability_faults import (
    GRPO,
    KilledRuns,
    WaitingConfig,
    damage_table,
    kill_table,
    report,
    shared_differences,
)
from sensors_io.index import TABLES
from tests.experiments import tiny
from tests.experiments.encoder.test_pretrain import PRETRAIN
from tests.experiments.shrunk import run_shrunk

STRUCK = Kill(phase=STEPPING["sft"], after_s=2.0, done=0.5, torn=True)
AT_START = dataclasses.replace(STRUCK, phase=START, torn=False)
KILLED = KilledRuns(kills=(STRUCK,) * 150 + (AT_START,) * 50, runs=1, differs=())
DAMAGE = Damage(file="config.json", damage="removed", outcome=SAME, message="")
FLIP = Flip(file="a/config.json", path="a/config.json", bit=3, reading=FOUND)
ANSWERED = [{"input": f"{i}", "kind": "run", "exit code": 1, "answer": "Error", "faults": ""} for i in range(25)]


def unmet(killed=KILLED, damage=(DAMAGE,), inputs=ANSWERED, flips=(FLIP,)):
    """Names of the requirements that are not met, where 0.1 s of 10 s are waited."""
    found = report({GRPO: killed}, list(damage), list(flips), list(inputs), {"sft/0": (10.0, 0.1)})
    return {r.name for r in found.requirements if not r.met}


def test_all_is_met_where_nothing_differs():
    assert unmet() == set()


@pytest.mark.long
def test_every_fault_breaks_its_requirement():
    differs = dataclasses.replace(KILLED, differs=("run 0: metrics.jsonl",))
    assert unmet(killed=differs) == {"files that differ after them"}
    assert unmet(damage=[DAMAGE, dataclasses.replace(DAMAGE, outcome=WRONG)]) == {"damaged files with a wrong end"}
    assert unmet(flips=[FLIP, dataclasses.replace(FLIP, reading=flipped_bits.WRONG)]) == {
        "flipped bits that read as something else"
    }
    assert unmet(flips=[FLIP, dataclasses.replace(FLIP, reading=RAW)]) == {"flipped bits that end in a raw error"}
    silent = {**ANSWERED[0], "faults": "the exit code is 0"}
    assert unmet(inputs=[*ANSWERED, silent]) == {"kinds of bad input not answered"}


def test_kills_and_damage_are_counted():
    table = kill_table({GRPO: KILLED})
    row = dict(zip((column.name for column in table.columns), table.rows[0], strict=True))
    assert (row["kills"], row[START], row[STEPPING["sft"]], row["torn lines"]) == (200, 50, 150, 150)
    other = dataclasses.replace(DAMAGE, file="x", outcome=OLDER)
    by_kind = [dict(zip(OUTCOMES, row[1:], strict=False)) for row in damage_table([DAMAGE, DAMAGE, other]).rows]
    assert [(row[SAME], row[OLDER]) for row in by_kind] == [(2, 0), (0, 1)]


def test_runs_on_one_cache_may_lack_the_states_that_another_has():
    assert shared_differences([("state of sft/0",), ()]) == []
    assert shared_differences([("state of sft/0",), ("state of sft/0",)]) == ["state of sft/0"] * 2
    assert shared_differences([(), ("metrics.jsonl",)]) == ["metrics.jsonl"]


def test_a_save_that_was_cut_off_is_of_no_kind_that_is_read(tmp_path, context):
    half = tmp_path / "run" / "checkpoints" / "sft" / "0" / "6.orbax-checkpoint-tmp" / "state" / "x"
    half.parent.mkdir(parents=True)
    half.write_bytes(b"half")
    (flip,) = flipped_bits.flip_bits(tmp_path / "run", tmp_path, context, count=1)
    assert flip.reading == flipped_bits.SAME


def test_a_flipped_bit_of_records_is_found_or_changes_nothing(tmp_path, records, context):
    shutil.copytree(records, tmp_path / "run" / "scenes-1")
    flips = list(flipped_bits.flip_bits(tmp_path / "run", tmp_path, context, count=60))
    assert {flip.reading for flip in flips} == {flipped_bits.SAME, FOUND}
    assert {flip.file for flip in flips} > {f"scenes-…/index.{table}" for table in TABLES}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_damaged_checkpoint_ends_the_same_or_names_what_is_wrong(tmp_path, context):
    unfinished, scratch = tmp_path / "unfinished", tmp_path / "scratch"
    for folder in (unfinished, scratch):
        folder.mkdir()
    unfinished_run(unfinished)
    outcomes = [one.outcome for one in damage_each(unfinished, scratch, context, most=3)]
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
