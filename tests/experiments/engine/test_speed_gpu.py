"""The GPU's experiment without a GPU: it refuses, or tries its code and marks the figures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.core.runner import main
from experiments.engine import speed_gpu
from experiments.engine.gpu_workloads import (
    GpuConfig,
    attention_errors,
    attention_workload,
    draw_heads,
    engine_attention,
    flash_attention,
    with_gradient,
)
from experiments.engine.speed import TimedWorkload, Workload
from experiments.engine.speed_gpu import NoAccelerator, accelerator, sheet_of
from tests.experiments.shrunk import run_shrunk


def test_without_a_gpu_it_says_so(tmp_path, capsys):
    with pytest.raises(NoAccelerator, match="must be a GPU; install JAX with CUDA"):
        accelerator(anywhere=False)
    where = ["--runs-dir", str(tmp_path), "--cache-dir", str(tmp_path)]
    assert main(["speed_gpu", *where]) == 1
    assert "NoAccelerator: the first device is cpu on cpu" in capsys.readouterr().err


def test_devices_are_known_by_their_names():
    assert sheet_of("NVIDIA H100 80GB HBM3").flops == 989e12
    assert sheet_of("NVIDIA H100 PCIe").flops == 756e12
    assert sheet_of("cpu") is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"vision_px": 450}, "must be a multiple of 28"), ({"frames": 7}, "frames of a patch"), ({"rounds": 0}, "rounds")],
)
def test_sizes_that_do_not_fit_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        GpuConfig(**changes)


HEADS = GpuConfig(prompts=2, tokens=12, heads=4, kv_heads=2, head_dim=8)


def test_both_kinds_of_attention_agree_in_float32_and_nearly_in_bfloat16():
    heads = draw_heads(HEADS)
    variants = {"engine": engine_attention, "flash": flash_attention("xla")}
    wide = jax.tree.map(lambda x: x.astype(jnp.float32), heads)
    a, b = (jax.jit(with_gradient(attend))(wide) for attend in variants.values())
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-5), a, b)
    assert all(0 < e < speed_gpu.OFF_FLOAT32 for e in attention_errors(heads, variants).values())


def test_work_and_shares_by_hand():
    """Three tokens attend to 1 + 2 + 3 keys; 8 operations in a median of 2 seconds are 4 a second."""
    small = dataclasses.replace(HEADS, tokens=3)
    work = lambda gradient: attention_workload(small, draw_heads(small), engine_attention, gradient=gradient).flops
    assert (work(False), work(True)) == (4 * 8 * 2 * 4 * 6, 3 * 4 * 8 * 2 * 4 * 6)
    timed = TimedWorkload((1.0, 2.0, 5.0), Workload(lambda: None, 8.0, 6.0, 4.0, "tokens"))
    assert (timed.flops, timed.read_bytes, timed.made) == (4.0, 3.0, "2 tokens/s")


@pytest.mark.slow
def test_the_code_runs_on_a_cpu_and_says_that_it_is_none(tmp_path):
    directory = run_shrunk(speed_gpu, speed_gpu.SMOKE, tmp_path)
    results = read_json(directory / "results.json")
    times, memory = results["tables"]
    assert [row[0] for row in times["rows"]] == [
        "matrix product",
        *(f"attention, {way}{end}" for way in ("the engine's", "flash (xla)") for end in ("", ", with gradient")),
        "tactile encoder, float32",
        "vision tower",
        "decoding",
        "GRPO step",
    ]
    assert all(row[1] > 0 for row in times["rows"])
    assert all(row[1] > 0 for row in memory["rows"][:2])
    assert "no GPU" in results["verdict"][0]
    assert all(r["met"] for r in results["requirements"])
