"""The command line end to end: finding, overriding, running, continuing, stopping."""

import dataclasses
import errno
import json
import signal
from pathlib import Path
from unittest import mock

import pytest

from experiments.core import runs, watchers
from experiments.core.artifacts import read_json
from experiments.core.runner import Experiment, main, parse, run_experiment
from tests.experiments.fakes import coin
from touchr1_jax.rl.config import AnyAlgorithm, Dapo, Paper

FAKES = "tests.experiments.fakes"


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments: str) -> int:
    return main(arguments, package=FAKES)


def directories() -> list[Path]:
    return sorted(p for p in Path("runs/coin").iterdir() if not p.is_symlink())


@pytest.mark.parametrize(
    ("arguments", "code", "printed"),
    [
        (["list"], 0, "coin  Does a coin that is paid for heads"),
        ([], 2, "usage"),
        (["--help"], 0, "usage"),
        (["coyn"], 2, "Did you mean coin?"),
        (["coin", "--stepz", "3"], 2, "--steps"),
        (["coin", "--toss.bia", "3"], 2, "--toss.bias"),
        (["coin", "--scael", "3"], 2, "--scale"),
        (["coin", "--scale", "huge"], 2, "smoke"),
        (["coin", "--help"], 0, "Steps of every run"),
        (["coin", "--help"], 0, "--toss.…  1"),
        (["coin", "--help-all"], 0, "Chance of heads"),
    ],
)
def test_names_are_listed_and_typos_answered_with_the_right_one(capsys, arguments, code, printed):
    try:
        status = run(*arguments)
    except SystemExit as stop:
        status = stop.code
    assert status == code
    assert printed in "".join(capsys.readouterr())


@pytest.mark.parametrize("scales", [{"default": coin.Config()}, {"smoke": coin.Toss()}])
def test_the_scales_of_an_experiment_are_of_one_kind(scales):
    with pytest.raises(ValueError, match="coin"):
        Experiment(name="coin", config=coin.Config(), scales=scales, run=coin.run)


def test_an_experiment_is_named_after_its_module(monkeypatch):
    monkeypatch.setattr(coin, "EXPERIMENT", Experiment(name="dice", config=coin.Config(), run=coin.run))
    with pytest.raises(ValueError, match="must be 'coin'"):
        run("coin")


def test_a_run_leaves_the_agreed_files(capsys):
    assert run("coin", "--scale=smoke", "--toss.bias", "0.25", "--coin", "silver") == 0
    (directory,) = directories()
    assert Path("runs/coin/latest").resolve() == directory.resolve()
    description = read_json(directory / "config.json")
    assert description["config"]["toss"] == {"bias": 0.25}
    assert (description["config"]["steps"], description["config"]["coin"]) == (3, "silver")
    assert description["command"] == "python -m experiments coin --scale=smoke --toss.bias 0.25 --coin silver"
    assert {"jax", "numpy", "python"} <= set(description["versions"])
    results = read_json(directory / "results.json")
    assert list(results["arms"]) == ["paid", "unpaid"]
    assert len(results["arms"]["paid"]["acc"]["per_seed"]) == 2
    assert results["timing"]["total"] >= results["timing"]["train/paid/0"] > 0
    assert {p.name for p in (directory / "plots").iterdir()} == {"curves_train.svg", "accuracy_against_middle.svg"}
    assert "report.html" in capsys.readouterr().out
    (directory / "results.json").write_text("{}")  # of which the next run needs nothing
    (directory / "timing.json").write_text("{")  # of which it needs the usual time alone
    assert run("coin", "--scale=smoke", "--toss.bias", "0.25", "--coin", "silver") == 0


@pytest.mark.long
def test_a_crashed_run_is_continued_to_the_same_files(monkeypatch, capsys):
    arguments = ("coin", "--seeds", "2", "--crash-at", "7")
    monkeypatch.setenv("COIN_CRASHES", "1")
    with pytest.raises(RuntimeError, match="rolled away"):
        run(*arguments)
    monkeypatch.delenv("COIN_CRASHES")
    monkeypatch.setattr(runs, "code_digest", lambda: "of other files")
    assert run(*arguments) == 0
    said = capsys.readouterr().out
    assert "continuing runs/coin" in said
    assert "note: source files changed since this run began; the commit is still" in said
    assert run(*arguments) == 0  # the first is finished, so this one is new
    assert "new run" in capsys.readouterr().out
    continued, straight = directories()
    assert (continued / "metrics.jsonl").read_bytes() == (straight / "metrics.jsonl").read_bytes()
    a, b = (read_json(d / "results.json") for d in (continued, straight))
    assert a["arms"] == b["arms"]


@pytest.mark.long
def test_another_configuration_or_fresh_starts_anew(monkeypatch):
    monkeypatch.setenv("COIN_CRASHES", "1")
    for extra in ((), ("--steps", "9"), ("--fresh",)):
        with pytest.raises(RuntimeError):
            run("coin", "--crash-at", "1", *extra)
    assert len(directories()) == 3
    with pytest.raises(RuntimeError):
        run("coin", "--crash-at", "1")
    assert len(directories()) == 3


def test_only_a_run_that_computes_becomes_the_latest(capsys):
    def refuse(config, context):
        raise FileNotFoundError("data_dir is 'tyop': must be a folder; correct it")

    assert run("coin", "--steps", "1") == 0
    latest = Path("runs/coin/latest").resolve()
    assert run_experiment(dataclasses.replace(coin.EXPERIMENT, run=refuse), [], "about") == 1
    assert "correct it" in capsys.readouterr().err
    assert len(directories()) == 2
    assert Path("runs/coin/latest").resolve() == latest
    Path("runs/coin/latest").unlink()
    latest.rename("runs/coin/latest")  # a copy of a folder of runs that follows links
    assert run("coin", "--steps", "2") == 1
    assert "runs/coin/latest is no symbolic link, so it is not replaced; move it away" in capsys.readouterr().err
    assert len(directories()) == 2


def test_a_run_directory_serves_one_process_at_a_time(monkeypatch, capsys):
    monkeypatch.setenv("COIN_CRASHES", "1")
    with pytest.raises(RuntimeError):
        run("coin", "--crash-at", "1")
    with runs.locked(directories()[0]):
        assert run("coin", "--crash-at", "1") == 1
    assert "another process" in capsys.readouterr().err


@dataclasses.dataclass(frozen=True, kw_only=True)
class Learning:
    algorithm: AnyAlgorithm = Paper()
    rate: float = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class LearningConfig:
    seeds: int = 3
    grpo: Learning = Learning()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("--grpo.algorithm.beta 0.1", Paper(beta=0.1)),
        ("--grpo.algorithm.beta 0.1 --seeds 2 --grpo.rate 3", Paper(beta=0.1)),
        ("--grpo.algorithm.beta 0.1 grpo.algorithm:dapo --seeds 2", Dapo(beta=0.1)),
        ("--runs-dir host:1 --grpo.algorithm.beta 0.1 --grpo.rate 2 grpo.algorithm:dapo", Dapo(beta=0.1)),
    ],
)
def test_options_of_a_choice_stand_anywhere(arguments, expected):
    learning = Experiment(name="learning", config=LearningConfig(), run=coin.run)
    command = parse(learning, arguments.split(), "about")
    assert command.config.grpo.algorithm == expected


@pytest.mark.parametrize(
    ("arguments", "scale", "steps"),
    [([], "default", 20), (["--scale", "smoke"], "smoke", 3), (["--steps", "4", "--scale=smoke"], "smoke", 4)],
)
def test_the_scale_chooses_the_defaults_that_overrides_change(arguments, scale, steps):
    command = parse(coin.EXPERIMENT, arguments, "about")
    assert (command.scale, command.config.steps) == (scale, steps)


@pytest.mark.long
def test_a_run_that_is_moved_while_it_goes_on_ends_and_is_whole_once_it_is_back(monkeypatch, capsys):
    train, aside = coin.train, Path("runs/coin/mine")

    def moving(config, context, arm, seed):
        if (arm, seed) == ("unpaid", 1):
            context.directory.rename(aside)
        return train(config, context, arm, seed)

    arguments = ("coin", "--steps", "2", "--seeds", "2")
    monkeypatch.setattr(coin, "train", moving)
    assert run(*arguments) == 1
    said = capsys.readouterr().err
    assert "was moved or removed while its run goes on: put it back, then continue" in said
    assert directories() == [aside]  # nothing was made in its place
    monkeypatch.setattr(coin, "train", train)
    assert run(*arguments) == 0
    assert run(*arguments) == 0
    assert (aside / "metrics.jsonl").read_bytes() == (directories()[0] / "metrics.jsonl").read_bytes()


def test_a_full_disk_is_named_with_the_folders_that_may_be_on_it(monkeypatch, capsys):
    full = mock.Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))
    monkeypatch.setattr(coin, "train", full)
    assert run("coin", "--cache-dir", "kept") == 1
    assert "No space left on device: free some space on the disks of runs and kept, then" in capsys.readouterr().err


def test_a_page_that_cannot_be_written_does_not_hide_what_ended_the_run(monkeypatch):
    def full(page, error):
        raise OSError("No space left on device")

    monkeypatch.setattr(watchers.LivePage, "end", full)
    monkeypatch.setattr(coin, "train", lambda *options: signal.raise_signal(signal.SIGTERM))
    assert run("coin") == 143


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_stops_cleanly_and_prints_how_to_continue(workplace, monkeypatch, capsys, number, code):
    """It comes as soon as the first checkpoint is written."""
    write = coin.write_json
    monkeypatch.setattr(coin, "write_json", lambda *file: (write(*file), signal.raise_signal(number)))
    assert run("coin", "--fresh") == code
    out = capsys.readouterr().out
    assert "To continue: python -m experiments coin" in out
    assert "--fresh" not in out.splitlines()[-1]
    (directory,) = (workplace / path for path in directories())
    lines = (directory / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == list(range(5))
    assert not (directory / "results.json").exists()
    assert not list(directory.rglob(".*.json.*")), "half-written files were left behind"


def test_a_signal_after_the_results_leaves_the_report(workplace, monkeypatch, capsys):
    """The page of a finished run is its report, and there is nothing to continue."""
    point = runs.point_latest
    strike = lambda directory: (directory / "results.json").exists() and signal.raise_signal(signal.SIGTERM)
    monkeypatch.setattr(runs, "point_latest", lambda directory: (point(directory), strike(directory)))
    assert run("coin", "--scale", "smoke") == 143
    (directory,) = directories()
    assert "Data and time" in (directory / "report.html").read_text()
    out = capsys.readouterr().out
    assert f"is finished: {directory}" in out
    assert "To continue" not in out
