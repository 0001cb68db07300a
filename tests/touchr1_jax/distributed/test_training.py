"""The same losses on any mesh: simulated devices, each mesh in a process of its own, and two real processes."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from tests.touchr1_jax.distributed.problems import PROBLEMS, STEPS, feed
from tests.touchr1_jax.distributed.worker import SAVE_AT, plain_losses
from touchr1_jax.training.checkpoint import Checkpoints
from touchr1_jax.training.compilation import OLDER_LOOPS

TOLERANCE = 1e-5
PATIENCE_S = 280
MESHES = {"data": "8,1,1", "fsdp": "1,8,1", "tensor": "1,1,4", "mixed": "2,2,2"}


def start(problem: str, mesh: str, directory: Path, devices: int, *process: str) -> subprocess.Popen:
    """A worker on simulated devices, compiling quickly as the tests do."""
    flags = f"{OLDER_LOOPS} --xla_force_host_platform_device_count={devices}"
    environment = {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    command = [sys.executable, "-m", "tests.touchr1_jax.distributed.worker", problem, mesh, str(directory)]
    return subprocess.Popen(
        [*command, *(("--process", *process) if process else ())],
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def finish(worker: subprocess.Popen) -> None:
    """Wait, and show what went wrong."""
    try:
        output, _ = worker.communicate(timeout=PATIENCE_S)
    finally:
        worker.kill()
    assert worker.returncode == 0, output[-4000:]


def same(found: dict, expected: list[dict[str, float]]) -> None:
    """Twenty losses, to 1e-5, of a training that moves."""
    losses = [metrics["loss"] for metrics in found["metrics"]]
    assert len(losses) == STEPS
    np.testing.assert_allclose(losses, [metrics["loss"] for metrics in expected], atol=TOLERANCE, rtol=0)
    assert np.ptp(losses) > 100 * TOLERANCE


@pytest.mark.long
def test_losses_on_a_mixed_mesh_and_after_resuming_on_one_device(tmp_path):
    """Eight devices train twenty steps; this process, which has one, goes on from their tenth."""
    worker = start("words", MESHES["mixed"], tmp_path, 8)
    problem = PROBLEMS["words"]()
    expected = plain_losses(problem)
    finish(worker)
    found = json.loads((tmp_path / "found-0.json").read_text())
    same(found, expected)
    assert found["held_share"] < 0.6
    batches, losses = feed(problem), []
    (tmp_path / "checkpoints" / str(STEPS)).rename(tmp_path / "last")  # as if the run had been killed before it
    with Checkpoints(tmp_path / "checkpoints") as checkpoints:
        restored = checkpoints.restore(problem.state)
    assert restored.step == SAVE_AT
    assert {len(x.sharding.device_set) for x in jax.tree.leaves(restored.state)} == {1}
    batches.set_state(restored.data)
    state = restored.state
    for _ in range(SAVE_AT, STEPS):
        state, metrics = problem.step(state, next(batches))
        losses.append(float(metrics["loss"]))
    np.testing.assert_allclose(losses, [m["loss"] for m in expected[SAVE_AT:]], atol=TOLERANCE, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("problem", ["sft", "packed", "grpo", "dynamics"])
def test_losses_on_every_mesh(problem, tmp_path):
    """One after the other: two cores would not be faster with four times eight devices."""
    expected = plain_losses(PROBLEMS[problem]())
    for name, mesh in MESHES.items():
        finish(start(problem, mesh, tmp_path / name, int(np.prod([int(n) for n in mesh.split(",")]))))
        same(json.loads((tmp_path / name / "found-0.json").read_text()), expected)


@pytest.mark.slow
@pytest.mark.parametrize("problem", ["adapters", "adapters_grpo"])
def test_adapters_learn_on_a_mesh_what_they_learn_on_one_device(problem, tmp_path):
    expected = plain_losses(PROBLEMS[problem]())
    finish(start(problem, MESHES["mixed"], tmp_path, 8))
    same(json.loads((tmp_path / "found-0.json").read_text()), expected)


@pytest.mark.slow
@pytest.mark.parametrize("problem", ["sft", "grpo"])
def test_two_processes_over_loopback(problem, tmp_path):
    """Parameters split between the processes, heads inside each; each reads its half of every batch."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    workers = [start(problem, "1,2,2", tmp_path, 2, address, "2", str(i)) for i in range(2)]
    expected = plain_losses(PROBLEMS[problem]())
    for worker in workers:
        finish(worker)
    for i in range(2):
        found = json.loads((tmp_path / f"found-{i}.json").read_text())
        same(found, expected)
        assert found["rows_read"] == 4
    with Checkpoints(tmp_path / "checkpoints") as checkpoints:
        assert checkpoints.restore(PROBLEMS[problem]().state).step == STEPS


@pytest.mark.slow
def test_sampling_exchanges_nothing_token_by_token():
    """Weights are gathered before the loop; all prompts are one micro-batch, so that no other loop exchanges any."""
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-m", "tests.touchr1_jax.distributed.exchanges"]
    environment = os.environ | flags
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["loops"]
    assert not any(found["loops"].values())
    assert found["all"] > 20
