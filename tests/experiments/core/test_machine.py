"""Processes of a run: who writes, what each reads, the figures of one process; accelerators that a scale needs."""

import dataclasses
import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.experimental import multihost_utils
from rich.console import Console

from experiments.core.context import Context
from experiments.core.metric_log import read_metrics
from experiments.core.runner import Experiment, main, run_experiment
from experiments.faults.trainings import PACKAGE
from tests.experiments.fakes import coin
from touchr1_jax.distributed import processes
from touchr1_jax.distributed.companions import DifferentProcessesError
from touchr1_jax.distributed.processes import (
    SINGLE_PROCESS,
    Accelerators,
    Launch,
    MachineError,
    ProcessGroup,
    join_processes,
    require_accelerators,
    require_common_folders,
    select_devices,
)
from touchr1_jax.training.compilation import OLDER_LOOPS
from touchr1_jax.training.loop import SingleDevice

ADDRESS = {"distributed": True, "coordinator": "h:1", "processes": 2, "process": 1}
ONE = Accelerators(number=1, memory_gib=70.0)
PATIENCE_S = 1800
"""A process takes minutes of a core of its own, and shares it with another and with whatever else runs here."""


def test_number_and_memory_must_suffice():
    present = [Accelerators(number=n, memory_gib=gib) for n, gib in ((1, 80), (16, 140), (1, 40), (0, 0))]
    for found in present[:2]:
        require_accelerators("gpu", ONE, found)
    for found in present[2:]:
        require_accelerators("default", None, found)
        with pytest.raises(MachineError, match="scale is 'gpu': needs 1 accelerator of 70 GiB"):
            require_accelerators("gpu", ONE, found)


def test_a_run_is_refused_before_it_begins(tmp_path, capsys):
    experiment = dataclasses.replace(coin.EXPERIMENT, needs={"smoke": ONE})
    assert run_experiment(experiment, ["--scale", "smoke", "--runs-dir", str(tmp_path)], "Why?") == 1
    assert "needs 1 accelerator of 70 GiB, and this machine has none, only cpu" in capsys.readouterr().err
    assert run_experiment(experiment, ["--distributed", "--runs-dir", str(tmp_path)], "Why?") == 2
    assert "runs in one process on one device" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match="must be scales"):
        Experiment(name="coin", config=coin.Config(), run=coin.run, needs={"huge": ONE})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"process": None}, r"process is not given, .*; give all three or none"),
        ({"distributed": False}, r"coordinator is h:1, but the run is not distributed; add --distributed"),
        ({"process": 2}, r"process is 2: must be 0 … 1, one of the processes"),
        ({"processes": 2**31}, "processes is 2147483648: must be at most"),
        *(
            ({"coordinator": odd}, f"coordinator is '{odd}': must be HOST:PORT")
            for odd in ("host", "host:", ":1", "host:99999", "host:0", "host:x", "host:²", "")
        ),
    ],
)
def test_an_address_is_whole(changes, message):
    with pytest.raises(ValueError, match=message):
        Launch(**ADDRESS | changes)


def test_one_process_asks_no_other(monkeypatch):
    for name in ("process_allgather", "broadcast_one_to_all", "sync_global_devices"):
        monkeypatch.setattr(multihost_utils, name, None)
    assert join_processes(Launch()) is SINGLE_PROCESS
    assert type(select_devices(Launch())) is SingleDevice
    assert SINGLE_PROCESS.broadcast(lambda: ["runs/x", True]) == ["runs/x", True]
    assert SINGLE_PROCESS.any(True)
    assert not SINGLE_PROCESS.any(False)
    assert SINGLE_PROCESS.split_work(np.arange(3), lambda rows: rows + 1).tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("number", "stated", "refusal"),
    [
        (1, "2", "process is 1: another process has this number in the run at 127.0.0.1:1"),
        (0, "3", "processes is 2: another process of the run at 127.0.0.1:1 was given 3"),
        (2, "3", "processes is 2: another process of the run at 127.0.0.1:1 was given 3"),
    ],
)
def test_numbers_that_do_not_fit_another_process_are_refused_before_jax_aborts_all(
    number, stated, refusal, tmp_path, capsys, monkeypatch
):
    """Before, a process that was started twice, or one too many, ended processes in a stack of C++."""
    folders = ["--runs-dir", str(tmp_path / "runs"), "--cache-dir", str(tmp_path)]
    launch = ["--distributed", "--coordinator", "127.0.0.1:1", "--processes", "2", "--process", "1"]
    (tmp_path / "compiled").mkdir()
    (tmp_path / "compiled" / ".process-7-of-127.0.0.1:1").write_text("8")  # of a run that has ended
    monkeypatch.setattr(processes, "LOOK_S", 0.0)
    with (tmp_path / "compiled" / f".process-{number}-of-127.0.0.1:1").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        other.write(stated)
        other.flush()
        assert main(["small_study", "--scale", "short", *launch, *folders], package=PACKAGE) == 1
    assert refusal in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_files_of_an_earlier_run_refuse_nobody_while_others_look_at_them(tmp_path):
    """Two that look at one file at a time find it locked; its owner states a new number only after it locked it."""
    path = tmp_path / ".process-0-of-127.0.0.1:1"
    path.write_text("8")
    with path.open("r+") as looking:
        fcntl.flock(looking, fcntl.LOCK_EX)
        ended = threading.Timer(0.2, fcntl.flock, (looking, fcntl.LOCK_UN))
        ended.start()
        processes._lock_number(Launch(distributed=True, coordinator="127.0.0.1:1", processes=2, process=1), tmp_path)
        ended.join()


def test_each_process_may_spell_the_address_of_the_first_differently(tmp_path, monkeypatch):
    """Process 0 was given localhost; the file of its number is named so."""
    launch = Launch(distributed=True, coordinator="127.0.0.1:1", processes=2, process=1)
    monkeypatch.setattr(ProcessGroup, "broadcast", lambda group, choose: ".process-0-of-localhost:1")
    monkeypatch.setattr(processes, "LOOK_S", 0.0)
    (tmp_path / "config.json").touch()
    with pytest.raises(DifferentProcessesError, match=r"does not see .*/\.process-0-of-localhost:1, which"):
        require_common_folders(launch, ProcessGroup(2, 1), tmp_path, tmp_path)
    (tmp_path / ".process-0-of-localhost:1").touch()
    require_common_folders(launch, ProcessGroup(2, 1), tmp_path, tmp_path)


def test_processes_are_numbered_as_jax_gathers(monkeypatch):
    """The devices of TPUs may have another order than the processes joined in."""
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "process_index", lambda: 0)
    assert ProcessGroup(2, 1).numbered_by_devices() == ProcessGroup(2, 0)
    assert SINGLE_PROCESS.numbered_by_devices() is SINGLE_PROCESS


@pytest.mark.long
@pytest.mark.parametrize("process", [0, 1])
def test_processes_that_nobody_joins_say_so_and_end(process):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
    launch = f"Launch(distributed=True, coordinator={address!r}, processes=2, process={process})"
    code = f"from touchr1_jax.distributed.processes import *; join_processes({launch}, say_s=0.1, wait_s=%s)"
    done = subprocess.run([sys.executable, "-c", code % 0.5], capture_output=True, text=True, check=False)
    me = f"process {process} of 2"
    waits, ends = [line for line in done.stderr.splitlines() if me in line]
    assert waits == f"{me} waits for the other processes of the run at {address}, for at most 0.5 s"
    assert ends.startswith(f"ProcessesNotFoundError: {me} did not find the other processes at {address} within 0.5 s: ")
    assert done.returncode == 1
    with subprocess.Popen([sys.executable, "-c", code % 60], stderr=subprocess.PIPE) as waiting:
        waiting.stderr.readline()
        waiting.send_signal(signal.SIGTERM)
        assert waiting.wait(20) == -signal.SIGTERM


def test_the_parts_of_all_processes_are_what_one_makes(monkeypatch):
    """Five rows of three processes: two each, the last row once more."""
    made = {}

    def gathered(part, tiled):
        assert tiled
        made[len(made)] = part
        return np.concatenate([make(np.array(rows)) for rows in ([0, 1], [2, 3], [4, 4])])

    make = lambda rows: 10 * rows
    monkeypatch.setattr(multihost_utils, "process_allgather", gathered)
    for process, own in enumerate(([0, 10], [20, 30], [40, 40])):
        found = ProcessGroup(3, process).split_work(np.arange(5), make)
        assert found.tolist() == [0, 10, 20, 30, 40]
        assert made[process].tolist() == own


def test_only_the_first_process_writes(tmp_path, monkeypatch):
    monkeypatch.setattr(multihost_utils, "sync_global_devices", lambda name: None)
    follower = Context(tmp_path, tmp_path, Console(quiet=True), processes=ProcessGroup(2, 1))
    follower.log("sft/0", 0, loss=1.0)
    follower.rewind("sft/0", 0)
    follower.save_stage("sft/0", {})
    with follower.timed("sft/0"):
        pass
    follower.close()
    assert not list(tmp_path.iterdir())


def start(folder: Path, *arguments: str) -> subprocess.Popen:
    """A tiny study in a process that compiles quickly, as the tests do; all share the generated data."""
    environment = {"XLA_FLAGS": OLDER_LOOPS, "JAX_PLATFORMS": "cpu", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    where = ["--runs-dir", str(folder), "--cache-dir", str(folder.parent / "data")]
    command = [sys.executable, "-m", "tests.experiments.core.tiny_study", *arguments, *where]
    return subprocess.Popen(
        command, env=os.environ | environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def finish(process: subprocess.Popen, code: int = 0) -> str:
    with process:
        try:
            output, _ = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
    assert process.returncode == code, output[-4000:]
    return output


def two(folder: Path, name: str, *, code: int = 0, struck: tuple[str, ...] = ()) -> list[str]:
    """The outputs of two processes over loopback; the second may be sent a signal."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    launch = ["--distributed", "--mesh.fsdp", "2", "--coordinator", address, "--processes", "2", "--process"]
    workers = [start(folder, *(struck if i else ()), name, *launch, str(i)) for i in range(2)]
    try:
        return [finish(worker, code) for worker in workers]
    finally:
        workers[1].kill()  # the first may have been given up


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ablation_ordinal", "main_table", "ablation_leave_one_out"])
def test_an_experiment_in_two_processes_gives_the_figures_of_one(tmp_path, name):
    """Every logged figure to 1e-5, every answer; a SIGTERM to the second process ends both after a saved step."""
    finish(start(tmp_path / "one", name))
    stopped = two(tmp_path / "two", name, code=143, struck=("--strike", "4"))
    assert all("Stopped by SIGTERM" in output for output in stopped)
    latest = [tmp_path / run / name / "latest" for run in ("one", "two")]
    assert [line["step"] for line in read_metrics(latest[1]) if line["stage"] == "sft/0"] == [0, 1]
    leader, follower = two(tmp_path / "two", name)
    assert ("report: " in leader, "report: " in follower) == (True, False)
    for a, b in zip(*map(read_metrics, latest), strict=True):
        assert (a.pop("stage"), a["step"], *a) == (b.pop("stage"), b["step"], *b)
        assert b == pytest.approx(a, rel=1e-5, abs=1e-5)
    one, both = (json.loads((folder / "results.json").read_text()) for folder in latest)
    assert (one["arms"], one["baselines"]) == (both["arms"], both["baselines"])
    assert len(list((tmp_path / "two" / name).iterdir())) == 2  # one run, and `latest`


def test_a_mesh_of_more_devices_than_there_are_is_one_line(tmp_path, capsys):
    """Before, it ended in a traceback, as did `--distributed` without a mesh."""
    folders = ["--runs-dir", str(tmp_path / "runs"), "--cache-dir", str(tmp_path / "cache")]
    many = jax.device_count() + 1
    code = main(["small_study", "--scale", "short", "--mesh.data", str(many), *folders], package=PACKAGE)
    captured = capsys.readouterr()
    assert code == 1
    assert f"MachineError: mesh data · fsdp · tensor is {many} · 1 · 1" in captured.out + captured.err
