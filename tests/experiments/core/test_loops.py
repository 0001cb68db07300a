"""A training loop as a stage: its files, its end on a signal, its continuation."""

import json
import shutil
import signal

import jax.numpy as jnp
import pytest

from experiments.core.artifacts import read_json
from experiments.core.loops import ALARM, alarm_tables, left_out_tables, run_loop
from experiments.core.metric_log import MetricLog
from experiments.faults.digests import differences, digests
from experiments.faults.fixtures import run_counting, run_directory
from experiments.faults.trainings import counting
from touchr1_jax.rl.scoring import NONFINITE_IN


def lines(folder) -> list[dict]:
    return [json.loads(line) for line in (run_directory(folder) / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    assert run_counting(folder) == 0
    return folder


@pytest.mark.long
def test_a_signal_ends_the_run_after_the_step_is_saved(whole, tmp_path, capsys, monkeypatch):
    """Step 5 of 12, while the batch of step 6 is made; every fourth is saved: nothing computed is computed again."""
    made = counting.targets

    class Struck:
        def __init__(self, config):
            self._targets, self._left = made(config), 7

        def __next__(self):
            self._left -= 1
            if not self._left:
                signal.raise_signal(signal.SIGTERM)
            return next(self._targets)

        def __iter__(self):
            return self

        def __getattr__(self, name):
            return getattr(self._targets, name)

    with monkeypatch.context() as patch:
        patch.setattr(counting, "targets", Struck)
        assert run_counting(tmp_path) == 143
    output = capsys.readouterr().out
    assert "Stopped by SIGTERM" in output
    assert "To continue: python -m experiments counting" in output
    assert [line["step"] for line in lines(tmp_path)] == list(range(6))
    assert (run_directory(tmp_path) / "checkpoints" / "count" / "0" / "6").is_dir()
    assert run_counting(tmp_path) == 0
    assert not differences(digests(run_directory(whole)), digests(run_directory(tmp_path)))


@pytest.mark.long
def test_bad_updates_are_left_out_of_the_training_and_counted_in_the_log(tmp_path, capsys):
    assert run_counting(tmp_path, "--poison-from", "3", "--poison-to", "5") == 0
    assert "count/0: 2 updates were left out" in capsys.readouterr().out
    times = read_json(run_directory(tmp_path) / "timing.json")
    assert 0 <= times["waiting for data/count/0"] <= times["in steps/count/0"] <= times["count/0"]
    (table,) = read_json(run_directory(tmp_path) / "results.json")["tables"]
    assert table["rows"] == [["count/0", 12, 2, ""]]
    assert table["title"] in (run_directory(tmp_path) / "report.html").read_text()
    logged = lines(tmp_path)
    assert [line.get("skipped") for line in logged] == [None] * 3 + [1, 2] + [None] * 7
    assert "loss" not in logged[3]


def test_groups_that_a_reward_left_out_are_counted_for_each_stage():
    lines = [
        {"stage": "grpo/a/0", "step": 0, f"{NONFINITE_IN}spread": 1e-3, f"{NONFINITE_IN}format": 0.0},
        {"stage": "grpo/a/0", "step": 1, f"{NONFINITE_IN}spread": 0.0, f"{NONFINITE_IN}format": 0.0},
        {"stage": "grpo/b/0", "step": 0, f"{NONFINITE_IN}spread": 0.0},
    ]
    (table,) = left_out_tables(lines)
    assert table.rows == (("grpo/a/0", 2, 0.0, "spread 0.05 %"),)
    assert left_out_tables(lines[1:]) == ()


def test_the_report_has_the_alarms_of_each_stage():
    steps = [("grpo/a/0", 0, {}), ("grpo/a/0", 1, {"F10": 0.0}), ("grpo/a/0", 2, {"F10": 0.0}), ("sft/0", 0, {})]
    lines = [{"stage": s, "step": t, **{f"{ALARM}{code}": x for code, x in found.items()}} for s, t, found in steps]
    (table,) = alarm_tables(lines)
    assert table.rows == (("grpo/a/0", "F10", 1, 2),)
    assert alarm_tables(lines[:1]) == ()


# Orbax gives up at the first array that it cannot read; what the others call back then finds its loop closed
@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_damage_is_reported_and_costs_the_steps_since(whole, tmp_path, capsys):
    shutil.copytree(whole, tmp_path, symlinks=True, dirs_exist_ok=True)
    directory = run_directory(tmp_path)
    (directory / "results.json").unlink()
    (directory / "checkpoints" / "count" / "0" / "12" / "state" / "manifest.ocdbt").write_bytes(b"")
    assert run_counting(tmp_path) == 0
    assert "is kept as damaged-12" in capsys.readouterr().out
    assert not differences(digests(run_directory(whole)), digests(directory))


@pytest.mark.parametrize("kept", [0, 5], ids=["emptied", "cut"])
@pytest.mark.parametrize("ended", [True, False])
def test_no_run_ends_with_a_part_of_its_log(whole, tmp_path, capsys, kept, ended):
    shutil.copytree(whole, tmp_path, symlinks=True, dirs_exist_ok=True)
    directory = run_directory(tmp_path)
    (directory / "results.json").unlink()
    if not ended:
        (directory / "stages" / "logged" / "count" / "0.json").unlink()
    log = directory / "metrics.jsonl"
    log.write_text("".join(log.read_text().splitlines(keepends=True)[:kept]))
    assert run_counting(tmp_path) != 0
    error = capsys.readouterr().err
    said = f"of stage count/0 {12 - kept} of 12 steps are missing, the first is {kept}"
    assert ("of the 12 lines of stage count/0 some are missing or changed" if ended else said) in error
    assert "put a copy back, or start a new run with --fresh" in error
    assert not (directory / "results.json").exists()


@pytest.mark.long
def test_no_run_goes_on_with_the_log_of_another(tmp_path, capsys, monkeypatch):
    """Both were killed in the middle of the same stage."""
    append = MetricLog.append

    def die(log, stage, step, scalars):
        append(log, stage, step, scalars)
        if step == 9:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(MetricLog, "append", die)
        for folder, options in (("one", ()), ("other", ("--poison-from", "3", "--poison-to", "5"))):
            with pytest.raises(KeyboardInterrupt):
                run_counting(tmp_path / folder, *options)
    log, other = (run_directory(tmp_path / folder) / "metrics.jsonl" for folder in ("one", "other"))
    own = log.read_bytes()
    shutil.copy(other, log)
    assert run_counting(tmp_path / "one") == 1
    assert "of the 8 lines of stage count/0 some are missing or changed" in capsys.readouterr().err
    log.write_bytes(own)
    assert run_counting(tmp_path / "one") == 0


def test_the_best_checkpoint_is_kept_with_the_newest(context):
    """Held-out scores fall from step 4 on, so that its checkpoint outlives two newer ones."""
    config = counting.CountingConfig()
    seen = []
    run_loop(
        lambda state, target: (state | {"step": state["step"] + 1}, {"loss": jnp.mean(target)}),
        {"step": jnp.int32(0)},
        counting.targets(config),
        config.loop(),
        context,
        "count/0",
        held_out=lambda state: seen.append(int(state["step"])) or -float(state["step"]),
    )
    kept = sorted(int(path.name) for path in (context.directory / "checkpoints/count/0").iterdir())
    assert seen == kept == [4, 8, 12]
