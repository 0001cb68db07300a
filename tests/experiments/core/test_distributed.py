"""One run in several processes: who writes, what each reads, and the same figures as in one process."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from rich.console import Console

from experiments.core import distributed
from experiments.core.context import Context
from experiments.core.distributed import (
    SINGLE_PROCESS,
    DeviceMesh,
    Launch,
    ProcessesNotFoundError,
    ProcessGroup,
    SingleDevice,
    join_processes,
    select_devices,
)
from experiments.core.machine import OLDER_LOOPS
from tests.touchr1_jax.distributed.problems import ROWS, feed, words
from touchr1_jax.distributed.mesh import MeshConfig

ADDRESS = {"distributed": True, "coordinator": "h:1", "processes": 2, "process": 1}
PATIENCE_S = 1800
"""A process takes minutes of a core of its own, and shares it with another and with whatever else runs here."""


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"process": None}, r"process is not given, .*; give all three or none"),
        ({"distributed": False}, r"coordinator is h:1, but the run is not distributed; add --distributed"),
        ({"process": 2}, r"process is 2: must be 0 … 1, one of the processes"),
    ],
)
def test_an_address_is_whole(changes, message):
    with pytest.raises(ValueError, match=message):
        Launch(**ADDRESS | changes)


def test_without_a_cluster_the_address_is_asked_for(monkeypatch):
    def nobody(*address):
        assert address == (None, None, None)
        raise ValueError("coordinator_address should be defined.")

    monkeypatch.setattr(jax.distributed, "initialize", nobody)
    with pytest.raises(
        ProcessesNotFoundError, match=r"--distributed finds no other processes .* give --coordinator HOST:PORT"
    ):
        join_processes(Launch(distributed=True))


def test_one_process_asks_nobody(monkeypatch):
    monkeypatch.setattr(distributed, "multihost_utils", None)
    assert join_processes(Launch()) is SINGLE_PROCESS
    assert type(select_devices(Launch())) is SingleDevice
    assert SINGLE_PROCESS.broadcast(lambda: ["runs/x", True]) == ["runs/x", True]
    assert SINGLE_PROCESS.any(True)
    assert not SINGLE_PROCESS.any(False)
    assert SINGLE_PROCESS.split_work(np.arange(3), lambda rows: rows + 1).tolist() == [1, 2, 3]


def test_a_mesh_of_other_devices_is_refused():
    with pytest.raises(ValueError, match="must be the number of devices"):
        select_devices(Launch(mesh=MeshConfig(fsdp=64)))


def test_the_parts_of_all_processes_are_what_one_makes(monkeypatch):
    """Five rows of three processes: two each, the last row once more."""
    made = {}

    def gathered(part, tiled):
        assert tiled
        made[len(made)] = part
        return np.concatenate([make(np.array(rows)) for rows in ([0, 1], [2, 3], [4, 4])])

    make = lambda rows: 10 * rows
    monkeypatch.setattr(distributed.multihost_utils, "process_allgather", gathered)
    for process, own in enumerate(([0, 10], [20, 30], [40, 40])):
        found = ProcessGroup(3, process).split_work(np.arange(5), make)
        assert found.tolist() == [0, 10, 20, 30, 40]
        assert made[process].tolist() == own


def test_only_the_first_process_writes(tmp_path, monkeypatch):
    monkeypatch.setattr(distributed.multihost_utils, "sync_global_devices", lambda name: None)
    follower = Context(tmp_path, tmp_path, Console(quiet=True), processes=ProcessGroup(2, 1))
    follower.log("sft/0", 0, loss=1.0)
    follower.rewind("sft/0", 0)
    follower.save_stage("sft/0", {})
    with follower.timed("sft/0"):
        pass
    follower.close()
    assert not list(tmp_path.iterdir())


def test_a_step_on_a_mesh_is_the_step(monkeypatch):
    """Of one device here; `tests/touchr1_jax/distributed` has more of them."""
    problem = words()
    devices = DeviceMesh(MeshConfig().build(jax.devices()[:1]))
    assert devices.local_rows(ROWS).tolist() == list(range(ROWS))
    losses, compiled = [], []
    shard_step = distributed.shard_step
    monkeypatch.setattr(distributed, "shard_step", lambda *args: compiled.append(args) or shard_step(*args))
    for where in (SingleDevice(), devices, devices):
        state = jax.tree.map(jax.numpy.copy, problem.state)
        step, state, batches = where.shard(problem.step, state, feed(problem), ROWS)
        found = []
        for _ in range(3):
            state, metrics = step(state, next(batches))
            found.append(float(metrics["loss"]))
        losses.append(found)
        assert jax.tree.structure(where.gather(state.params)) == jax.tree.structure(problem.state.params)
    np.testing.assert_allclose(losses[1], losses[0], atol=1e-6)
    assert losses[1] == losses[2]
    assert len(compiled) == 1


def start(folder: Path, *arguments: str) -> subprocess.Popen:
    """A tiny study in a process that compiles quickly, as the tests do; all share the generated data."""
    environment = {
        "XLA_FLAGS": OLDER_LOOPS,
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }
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
    """What two processes over loopback print; the second may be sent a signal."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    launch = ["--distributed", "--mesh.fsdp", "2", "--coordinator", address, "--processes", "2", "--process"]
    workers = [start(folder, *(struck if i else ()), name, *launch, str(i)) for i in range(2)]
    try:
        return [finish(worker, code) for worker in workers]
    finally:
        workers[1].kill()  # the first may have been given up


def lines_of(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "latest/metrics.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_an_experiment_in_two_processes_gives_the_figures_of_one(tmp_path):
    """Parameters and batches split between two processes over loopback; every logged figure to 1e-5, every answer.

    A SIGTERM to the second of them in its third batch, the first of which told shapes alone, ends both after
    that step, saved; they then go on.
    """
    name = "ablation_ordinal"
    finish(start(tmp_path / "one", name))
    stopped = two(tmp_path / "two", name, code=143, struck=("--strike", "4"))
    assert all("Stopped by SIGTERM" in said for said in stopped)
    folders = [tmp_path / run / name for run in ("one", "two")]
    assert [(line["stage"], line["step"]) for line in lines_of(folders[1])] == [("sft/0", 0), ("sft/0", 1)]
    leader, follower = two(tmp_path / "two", name)
    assert "report: " in leader
    assert "report: " not in follower
    one, both = (lines_of(folder) for folder in folders)
    assert [(a["stage"], a["step"], *a) for a in both] == [(a["stage"], a["step"], *a) for a in one]
    for a, b in zip(one, both, strict=True):
        for field in a.keys() - {"stage"}:
            assert b[field] == pytest.approx(a[field], rel=1e-5, abs=1e-5), (a["stage"], a["step"], field)
    arms = [json.loads((folder / "latest/results.json").read_text())["arms"] for folder in folders]
    assert arms[0] == arms[1]
    assert len(list(folders[1].iterdir())) == 2  # one run, and `latest`


@pytest.mark.slow
@pytest.mark.parametrize("name", ["main_table", "ablation_leave_one_out"])
def test_further_ways_to_ask_and_to_train_in_two_processes(tmp_path, name):
    """Probes on the encoder, and GRPO inside the asking: the same results as in one process."""
    finish(start(tmp_path / "one", name))
    two(tmp_path / "two", name)
    found = [json.loads((tmp_path / run / name / "latest/results.json").read_text()) for run in ("one", "two")]
    assert found[0]["arms"] == found[1]["arms"]
    assert found[0]["baselines"] == found[1]["baselines"]
