"""Processes of one run: what they must have in common, and the end of one."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest
from jax._src import distributed

from touchr1_jax.distributed import companions
from touchr1_jax.distributed.companions import different, watched

HERE = {"config": {"steps": 12, "sft": {"rate": 0.1}}, "code": "a1", "versions": {"jax": "0.10.2"}}


@pytest.mark.parametrize(
    ("there", "lines"),
    [
        (HERE, []),
        (HERE | {"code": "b2"}, ["code is 'a1' here and 'b2' there"]),
        (HERE | {"versions": {}}, ["versions.jax is '0.10.2' here and None there"]),
        (
            HERE | {"config": {"steps": 20, "sft": {"rate": 0.2}}},
            ["config.sft.rate is 0.1 here and 0.2 there", "config.steps is 12 here and 20 there"],
        ),
    ],
)
def test_what_differs_is_named_by_its_path(there, lines):
    assert different(HERE, there) == lines


class Values(dict):
    """Those of a coordination service."""

    key_value_set = dict.__setitem__

    def blocking_key_value_get(self, key, milliseconds):
        if key not in self:
            raise jax.errors.JaxRuntimeError(f"DEADLINE_EXCEEDED: {key} after {milliseconds} ms")
        return self[key]


def test_a_process_that_ends_after_joining_is_named(monkeypatch):
    """Killed before it sent its settings, or before it connects; the first was a traceback of JAX."""
    monkeypatch.setattr(distributed.global_state, "client", values := Values())
    monkeypatch.setattr(companions, "COMPARE_S", 0.1)
    with pytest.raises(ConnectionError, match=r"^process 1 joined the run and did not answer for up to 0.1 s \(DEAD"):
        watched(2, 0, {"steps": 1}, str).__enter__()
    values[f"{companions.KEYS}/about/1"] = '{"steps": 1}'
    with pytest.raises(ConnectionError, match=r"^one of the processes joined .* \(timed out\)"):
        watched(2, 0, {"steps": 1}, str).__enter__()


def free_port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def start(home, *options, folders=(None, None)):
    """Two processes of the training in `spread`, over loopback; each has options and a working directory of its own."""
    address = f"127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "tests.experiments.core.spread", "--runs-dir", home / "runs", "--cache-dir"]
    command += [home / "data", "--distributed", "--mesh.fsdp", "2", "--coordinator", address, "--processes", "2"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": os.getcwd()}
    orders = ([*command, "--process", str(i), *own] for i, own in enumerate(options))
    started = zip(orders, folders, strict=True)
    return [subprocess.Popen(order, env=environment, cwd=folder, **pipes) for order, folder in started]


def errors(process):
    """What a process writes to standard error by its end."""
    return process.communicate(timeout=600)[1]


@pytest.mark.slow
def test_two_configurations_are_named_before_anything_is_compiled(tmp_path):
    for process, steps in zip(start(tmp_path, ["--steps", "12"], ["--steps", "20"]), ((12, 20), (20, 12)), strict=True):
        assert "config.steps is {} here and {} there".format(*steps) in errors(process)
        assert process.returncode == 1
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_fresh_in_one_process_alone_is_named(tmp_path):
    """Before, that of process 0 decided, without a word."""
    for process in start(tmp_path, [], ["--fresh"]):
        assert "fresh is " in errors(process)
        assert process.returncode == 1


@pytest.mark.slow
@pytest.mark.parametrize("common", ["--runs-dir", "--cache-dir"])
def test_processes_without_a_common_folder_are_named(tmp_path, common):
    for folder in (folders := (tmp_path / "a", tmp_path / "b")):
        folder.mkdir()
    options = [common, str(tmp_path / "common")]
    first, second = start(Path(), options, options, folders=folders)
    other = {"--cache-dir": Path("runs", "spread"), "--runs-dir": Path("data", "compiled", ".process-0-of-127.0.0.1:")}
    assert f"DifferentProcessesError: process 1 does not see {folders[1] / other[common]}" in errors(second)
    assert errors(first).startswith("Process 1 of this run ended early, so process 0 ends too.")


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_when_one_process_is_killed_the_other_ends_in_one_line_and_the_run_continues_to_the_same_bits(tmp_path, killed):
    slowly = ["--pause", "0.3"]
    for process in start(tmp_path / "whole", slowly, slowly):
        errors(process)
        assert process.returncode == 0
    processes = start(tmp_path / "killed", slowly, slowly)
    log = tmp_path / "killed" / "runs" / "spread" / "latest" / "metrics.jsonl"
    deadline = time.monotonic() + 300
    while not log.exists() or log.read_text().count("\n") < 6:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    processes[killed].kill()
    (line,) = errors(processes[1 - killed]).splitlines()
    assert line.startswith(f"Process {killed} of this run ended early, so process {1 - killed} ends too.")
    assert "To continue: " in line
    errors(processes[killed])
    for process in start(tmp_path / "killed", slowly, slowly):
        assert not errors(process)
        assert process.returncode == 0
    whole = tmp_path / "whole" / "runs" / "spread" / "latest" / "metrics.jsonl"
    assert log.read_bytes() == whole.read_bytes()
    assert (log.parent / "results.json").exists()
