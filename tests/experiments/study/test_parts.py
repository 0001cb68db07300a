"""Policies that workers train are those that a study trains itself; each is trained once."""

import functools
import json
import sys
from pathlib import Path

import pytest

from experiments.core import runs
from experiments.core.artifacts import read_json
from experiments.core.context import Context
from experiments.core.errors import DataError
from experiments.core.metric_log import read_metrics
from experiments.core.runner import main
from experiments.study.study import StudyPart, train_parts
from sensors_io.units import UnitsError

PARTS = [StudyPart(name=name, seed=seed, first=name == "sft") for name in ("sft", "arm") for seed in (0, 1)]


def note(log: Path, part: StudyPart, context: Context) -> None:
    """Stands for training; an arm needs what it starts from."""
    assert part.first or (log / f"sft-{part.seed}").exists()
    with (log / f"{part.name}-{part.seed}").open("a") as file:
        file.write("trained\n")
    assert context.checkpoint_dir("stage").is_relative_to(context.cache_dir)


def test_each_policy_is_trained_once_those_to_start_from_first(context, tmp_path, console):
    train = functools.partial(note, tmp_path)
    for _ in range(2):
        train_parts(train, PARTS[::-1], {"seeds": 2}, True, context)
    assert {p.name: p.read_text() for p in tmp_path.glob("*-?")} == {f"{p.name}-{p.seed}": "trained\n" for p in PARTS}
    assert "2 of 2 policies to start from trained" in console.file.getvalue()
    train_parts(train, PARTS, {"seeds": 3}, True, context)  # of another configuration
    assert (tmp_path / "arm-1").read_text() == "trained\ntrained\n"
    with pytest.raises(DataError, match=r"share is False: .*leave --launcher out, or set --share"):
        train_parts(train, PARTS, {}, False, context)


def test_a_worker_that_computes_other_bits_is_refused(context, tmp_path, monkeypatch):
    calls = iter(range(100))
    monkeypatch.setattr("experiments.study.study.numerics.machine", lambda: {"processor": str(next(calls))})
    with pytest.raises((DataError, UnitsError), match=r"computes other bits than the driver .*of the driver's kind"):
        train_parts(functools.partial(note, tmp_path), PARTS, {}, True, context)
    assert not list(tmp_path.glob("*-?"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:os.fork", "ignore:Exception ignored in:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("launcher", [("--launcher.workers", "2"), ("--launcher", "ray", "--launcher.workers", "2")])
def test_a_study_by_workers_is_equal_to_the_bit(tmp_path, monkeypatch, capfd, launcher):
    if "ray" in launcher:
        pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[3]))
    found = {}
    for name, options in {"here": (), "there": launcher}.items():
        folders = ("--runs-dir", str(tmp_path / name), "--cache-dir", str(tmp_path / name / "cache"))
        command = ["small_study", "--scale", "short", "--seeds", "2", *folders, *options]
        assert main(command, package="experiments.faults.trainings") == 0
        (run,) = runs.started(tmp_path / name / "small_study")
        results = read_json(run / "results.json")
        lines = sorted(json.dumps(line, sort_keys=True) for line in read_metrics(run))
        policies = {p.relative_to(run): p.read_bytes() for p in run.glob("answers/*") if p.is_file()}
        found[name] = {k: v for k, v in results.items() if k != "timing"}, lines, policies
    assert found["there"] == found["here"]
    said = capfd.readouterr().out
    assert "4 of 4 policies to start from trained" in said
    assert said.count("made before") >= 8
    sys.stdout.write(said)
