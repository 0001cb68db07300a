"""The GPU's experiment without a GPU: it refuses, or tries its code and marks the figures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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


HEADS = GpuConfig(prompts=2, tokens=12, heads=4, kv_heads=2, head_dim=8)


@pytest.mark.long
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
