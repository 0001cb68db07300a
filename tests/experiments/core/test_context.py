"""Logging, stages, timing and progress of a run."""

import contextlib
import io

import numpy as np
import pytest
from rich.console import Console

from experiments.core.artifacts import DamagedFileError, UnwrittenError, jsonable, write_json
from experiments.core.metric_log import MetricLog, read_metrics
from experiments.core.progress import Loop, show_progress
from experiments.faults.fixtures import full_disk
from tests.sensors_io.checks import refused


def log_steps(path, stage, steps):
    log = MetricLog(path)
    for step in steps:
        log.append(stage, step, {"loss": 1 / (1 + step)})
    log.close()


def test_an_interrupted_log_equals_an_uninterrupted_one(tmp_path):
    whole, broken = tmp_path / "whole.jsonl", tmp_path / "broken.jsonl"
    log_steps(whole, "sft/0", range(10))
    log_steps(broken, "sft/0", range(8))
    with broken.open("a") as file:
        file.write('{"stage": "sft/0", "step": 8, "lo')  # torn by a crash
    log_steps(broken, "sft/0", range(5, 10))
    assert broken.read_bytes() == whole.read_bytes()


def test_rewinding_one_stage_leaves_the_others(context):
    for step in range(3):
        context.log("sft/0", step, loss=1.0)
    context.log("sft/1", 5, loss=2.0)
    context.rewind("sft/0", 1)
    assert [(row["stage"], row["step"]) for row in read_metrics(context.directory)] == [("sft/0", 0), ("sft/1", 5)]


def test_several_lines_of_one_step_are_kept_and_bad_ones_named(context):
    context.log("grpo/paid/0", 0, loss=1.0)
    context.log("grpo/paid/0", 0, accuracy=np.float32(0.5))
    assert read_metrics(context.directory)[1] == {"stage": "grpo/paid/0", "step": 0, "accuracy": 0.5}
    with pytest.raises(ValueError, match=r"grpo/paid/0 step 7\.kl is nan"):
        context.log("grpo/paid/0", 7, kl=float("nan"))
    log = MetricLog(context.directory / "other.jsonl")
    with pytest.raises(ValueError, match="step"):
        log.append("sft/0", 0, {"step": 1})
    log.close()


def test_every_flipped_bit_of_a_log_is_named_or_harmless(tmp_path):
    """The end of the last line too, without which a line that was torn by a crash is dropped."""
    path = tmp_path / "metrics.jsonl"
    log_steps(path, "sft/0", range(2))
    rows, content = read_metrics(tmp_path), path.read_bytes()
    for bit in range(8 * len(content)):
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        with contextlib.suppress(DamagedFileError):
            MetricLog(path).close()
            assert read_metrics(tmp_path) == rows, bit


@pytest.mark.parametrize(
    "line",
    [
        "7", "[]", "null", "{}", '{"stage": "sft/0"}', '{"stage": 3, "step": 1}', '{"stage": "sft/0", "step": "1"}',
        '{"stage": "sft/0", "step": true}', '{"stage": "sft/0", "step": 1, "loss": NaN}', "\ufeff{}", "",
        '{"stage": "sft/0", "step": 1, "loss": 1e999}', '{"stage": "sft/0", "step": 1, "loss": 1%s}' % ("0" * 400),
        '{"stage": "sft/0", "step": 0, "loss": 0.1}',
        '{"stage": "sft/0", "step": 9, "loss": 0.1}\n{"stage": "sft/0", "step": 9, "loss": 0.1}',
    ],
)  # fmt: skip
def test_a_foreign_line_is_named_before_anything_is_trained(tmp_path, line):
    path = tmp_path / "metrics.jsonl"
    log_steps(path, "sft/0", range(2))
    content = path.read_text() + line + "\n"
    path.write_text(content)
    for read in (MetricLog, lambda path: read_metrics(path.parent)):
        with pytest.raises(DamagedFileError, match=r"metrics\.jsonl is damaged \(.*: put a copy back"):
            read(path)
    assert path.read_text() == content


@pytest.mark.parametrize("kept", [[], [0, 2, 3], [0, 1], [0, 1, 1, 2, 3], [0, 2, 1, 3]])
def test_lines_of_a_stage_that_has_ended_are_missed(context, kept):
    for step in range(3):
        context.log("sft/0", step, loss=1 / (1 + step))
    assert not context.has_sealed("sft/0")
    context.seal_log("sft/0")
    assert context.has_sealed("sft/0")
    context.log("sft/0", 3, probe=0.5)
    context.require_log()
    path = context.directory / "metrics.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[n] for n in kept))
    with pytest.raises(DamagedFileError, match="of the 3 lines of stage sft/0 some are missing or changed"):
        context.require_log()
    context.rewind("sft/0", 2)
    context.require_log()


@pytest.mark.parametrize("name", ["._0.json", "0 (conflicted copy).json", ".~0.json"])
def test_files_of_other_programs_among_the_seals_are_passed_over(context, name):
    context.log("sft/0", 0, loss=1.0)
    context.seal_log("sft/0")
    sealed = context.directory / "stages" / "logged" / "sft" / "0.json"
    sealed.with_name(name).write_bytes(b"\x00\x05\x16\x07" if name.startswith(".") else sealed.read_bytes())
    context.require_log()


@pytest.mark.parametrize(
    ("file", "text"),
    [
        *(("stages/logged/sft/0.json", text) for text in ("[]", "{}", '{"lines": 3}', '{"lines": ["a", 0]}')),
        *(("timing.json", text) for text in ("[]", "3", '{"total": null}', '{"total": []}')),
    ],
)
def test_a_foreign_file_of_a_run_is_named(context, file, text):
    context.log("sft/0", 0, loss=1.0)
    context.seal_log("sft/0")
    (context.directory / file).write_text(text)
    read = context.timing if file == "timing.json" else context.require_log
    with pytest.raises(DamagedFileError, match="is not that of a run"):
        read()


def test_a_log_on_a_full_disk_is_named_and_goes_on(tmp_path):
    log_steps(tmp_path / "whole.jsonl", "sft/0", range(9))
    path = tmp_path / "metrics.jsonl"
    said = r"metrics\.jsonl cannot be written \(.*\): free some space, then continue"
    with full_disk(tmp_path, 200):
        log = MetricLog(path)
        write = lambda: [log.append("sft/0", step, {"loss": 1 / (1 + step)}) for step in range(9)]
        refused(UnwrittenError, said, write)
        refused(UnwrittenError, said, log.close)
    log.close()
    log_steps(path, "sft/0", range(len(read_metrics(tmp_path)), 9))
    assert path.read_bytes() == (tmp_path / "whole.jsonl").read_bytes()


def test_other_ends_of_lines_are_read(tmp_path):
    log_steps(tmp_path / "metrics.jsonl", "sft/0", range(2))
    rows = read_metrics(tmp_path)
    (tmp_path / "metrics.jsonl").write_bytes((tmp_path / "metrics.jsonl").read_bytes().replace(b"\n", b"\r\n"))
    assert read_metrics(tmp_path) == rows


@pytest.mark.parametrize("stage", ["", "/sft", "sft/", "../sft", "sft/..", "a b", "sft//0"])
def test_a_stage_name_is_a_safe_path(context, stage):
    with pytest.raises(ValueError, match="stage is"):
        context.checkpoint_dir(stage)


@pytest.mark.parametrize("result", [[1, 2], {"answers": np.arange(3)}, None])
def test_a_stage_is_done_once_it_is_saved_and_again_where_its_result_is_damaged(context, result):
    assert not context.done("sft/0")
    with pytest.raises(FileNotFoundError, match="sft/0"):
        context.load_stage("sft/0")
    path = context.directory / "stages" / "sft" / "0.json"
    for _ in range(2):
        context.save_stage("sft/0", result)
        assert context.done("sft/0")
        assert context.load_stage("sft/0") == jsonable(result)
        path.write_text(path.read_text().replace("result", "resulu"))
        assert not context.done("sft/0")
        with pytest.raises(DamagedFileError, match="checksum"):
            context.load_stage("sft/0")
    assert "stage sft/0 is done again" in context.console.file.getvalue()


def test_a_stage_and_arrays_of_another_name_or_run_are_made_again(context):
    for name in ("sft/0", "sft/1"):
        context.save_stage(name, name)
        context.cached_arrays(name, lambda name=name: {"a": np.array(name)})
    for folder, end in ((context.directory / "stages", "json"), (context.cache_dir, "npz")):
        (folder / f"sft/1.{end}").rename(folder / f"sft/0.{end}")
    assert context.cached_arrays("sft/0", lambda: {"a": np.array(7)}) == {"a": 7}
    np.savez(context.cache_dir / "sft" / "0.npz", b=np.zeros(2))  # of another program
    assert context.cached_arrays("sft/0", lambda: {"a": np.array(6)}) == {"a": 6}
    printed = context.console.file.getvalue().replace("\n", " ")
    for reason in ("it is of sft/1: must be of sft/0", "it does not say what it is: must be of sft/0"):
        assert f"sft/0.npz is made again ({reason})" in printed
    assert "copy back" not in printed
    assert context.once("sft/0", lambda: 7) == 7
    assert "stage sft/0 is done again" in context.console.file.getvalue()
    about = {"experiment": "", "scale": "", "command": "", "git": {"commit": "", "dirty": False}}
    write_json(context.directory / "config.json", about | {"config": {"steps": 9}})  # of another run
    assert context.once("sft/0", lambda: 8) == 8


def test_stages_and_lines_of_earlier_versions_have_no_checksum_and_are_read(context):
    context.save_stage("sft/0", {"answers": [2]})
    (context.directory / "stages" / "sft" / "0.json").write_text('{"answers": [3]}')
    assert context.load_stage("sft/0") == {"answers": [3]}
    context.log("sft/0", 0, loss=1.0)
    with (context.directory / "metrics.jsonl").open("a") as file:
        file.write('{"stage": "sft/0", "step": 1, "loss": 0.5}\n')
    assert [row["loss"] for row in read_metrics(context.directory)] == [1.0, 0.5]


def test_a_result_is_computed_once(context):
    assert [context.once("sft/0", iter([(1, 2), (3, 4)]).__next__) for _ in range(2)] == [[1, 2], [1, 2]]


def test_times_add_up_over_errors_and_interruptions(context):
    for _ in range(2):
        before = context.timing().get("sft/0", 0.0)
        with pytest.raises(KeyError), context.timed("sft/0"):
            raise KeyError
        assert context.timing()["sft/0"] > before
    assert 0 < context.elapsed_s < 60
    context.add_time("total", 1000.0)
    assert 1000 < context.elapsed_s < 1060


def test_progress_is_plain_lines_where_there_is_no_terminal_and_else_a_bar(console):
    with show_progress(console, Loop("sft [0]", 4, completed=2), every_s=0.0) as advance:
        advance(1, "loss 0.5")
        advance()
    first, last = console.file.getvalue().splitlines()
    assert first.startswith("sft [0]: 3/4")
    assert " left" in first
    assert first.endswith("loss 0.5")
    assert last.startswith("sft [0]: 4/4")
    assert " left" not in last
    terminal = Console(file=io.StringIO(), force_terminal=True, width=120)
    with show_progress(terminal, Loop("grpo", 2)) as advance:
        advance(2, "reward 0.5")
    assert "2/2" in terminal.file.getvalue()
    assert "reward 0.5" in terminal.file.getvalue()


def test_the_first_step_bounds_the_time_left_and_later_ones_give_it():
    """The first compiled for 60 s; those after it take 2 s each."""
    now = 0.0
    loop = Loop("sft", 11, clock=lambda: now)
    assert loop.left == ""
    now = 60.0
    loop.advance(1)
    assert loop.left == "at most 10 min 0 s"
    now = 62.0
    loop.advance(1)
    assert loop.left == "18 s"
    assert loop.rate == 0.5
    loop.advance(9)
    assert loop.left == ""
