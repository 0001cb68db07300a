"""How fast are the encoders, decoding and a GRPO step on one GPU, and what share of its peak is that?

    make experiment EXP=speed_gpu [ARGS="--scale smoke"]

On the first device, in bfloat16 except for the tactile encoder (float32): a plain matrix product as the
reference; causal attention of prompts at the 7B's shapes, by the engine and by flash attention through
`jax.nn.dot_product_attention`, both compared with float32; the tactile encoder and Qwen2.5-VL's vision tower, forward
and backward; decoding, and one GRPO step of a policy of Qwen2.5's 1.5B shape with the reference and the counterfactual
pass.  The memory that the compiler reserves for a step is compared with the analytic count of `scale_paper`.
The experiment needs a GPU; `--scale smoke` is tiny, runs anywhere, and tests the code.

Cost: not measured, because no GPU was available; `--scale smoke` under a minute.

Expected: the product reaches 60 to 80 % of the data sheet's peak; flash attention is several times as fast as the
engine's; memory bandwidth limits decoding, so a GRPO step reaches less than a third of the peak.
"""

import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from experiments.core.charts import bars
from experiments.core.context import Context
from experiments.core.results import Picture, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.engine import gpu_workloads as gpu
from experiments.engine.peers import JobSize
from experiments.engine.speed import TimedWorkload, Workload, matrix_product, measure
from touchr1_jax.models.qwen.config import QwenVisionConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig

PRODUCT, STEP = "matrix product", "GRPO step"

OFF_FLOAT32 = 0.02  # largest error of attention in bfloat16, which rounds by .004, over the largest number

GB = 1e9


class NoAccelerator(OSError):
    """JAX sees no GPU."""


class DataSheet(NamedTuple):
    """Promised rates: dense bfloat16 operations and bytes of memory read, a second."""

    flops: float
    read_bytes: float


SHEETS = {
    "H200": DataSheet(989e12, 4.8e12),
    "H100 PCIe": DataSheet(756e12, 2.0e12),
    "H100": DataSheet(989e12, 3.35e12),
    "A100": DataSheet(312e12, 2.0e12),
    "L40S": DataSheet(362e12, 0.864e12),
}
"""Part of the driver's name of a device → NVIDIA's data sheet; the first that fits counts."""


def sheet_of(kind: str) -> DataSheet | None:
    """The data sheet of a device by its name; `None` where it is not known."""
    return next((sheet for name, sheet in SHEETS.items() if name in kind), None)


def accelerator(*, anywhere: bool) -> jax.Device:
    """The first device; `anywhere` accepts a CPU too.

    Raises:
      NoAccelerator: it is no GPU.
    """
    device = jax.devices()[0]
    if device.platform != "gpu" and not anywhere:
        raise NoAccelerator(
            f"the first device is {device.device_kind} on {device.platform}: must be a GPU; install JAX with CUDA "
            '(pip install "jax[cuda12]") on a machine that has one, or try the code with --scale smoke'
        )
    return device


def run(config: gpu.GpuConfig, context: Context) -> Results:
    """Time every workload, then compare attention with float32 and memory with the count."""
    device = accelerator(anywhere=config.anywhere)
    heads = gpu.draw_heads(config)
    timed = measure("pieces", without_policy(config, heads), config.rounds, context)
    off = gpu.attention_errors(heads, gpu.attention_variants(config))
    del heads
    with context.progress("making the policy", 2) as advance:
        policy = gpu.PolicyWorkloads(config)
        advance()
        reserved, counted = policy.memory()
        advance()
    timed |= measure("the policy", {"decoding": policy.decoding, STEP: policy.step}, config.rounds, context)
    sheet = sheet_of(device.device_kind)
    first = timed[PRODUCT]
    peak = first.workload.flops / min(first.seconds) if sheet is None else sheet.flops
    return Results(
        verdict=verdict(device, timed, peak, sheet),
        requirements=tuple(
            at_most(f"attention, {name}: off float32", error, OFF_FLOAT32) for name, error in off.items()
        ),
        tables=(time_table(timed, sheet, peak), memory_table(reserved.peak, counted, device)),
        pictures=(
            Picture(
                name="share",
                title="Share of the peak",
                caption="Operations that no program can avoid, over the time that they took and the device's peak.",
                content=bars(
                    {n: 100 * t.flops / peak for n, t in timed.items()}, "share of the peak, %", written=".1f"
                ),
            ),
        ),
        settings={"device": device.device_kind, "platform": device.platform, "jax": jax.__version__},
    )


def without_policy(config: gpu.GpuConfig, heads: gpu.AttentionInputs) -> dict[str, Callable[[], Workload]]:
    """Makers of the product, attention and the encoders by name."""
    pieces: dict[str, Callable[[], Workload]] = {PRODUCT: functools.partial(matrix_product, config.side, jnp.bfloat16)}
    for name, attend in gpu.attention_variants(config).items():
        for gradient in (False, True):
            title = f"attention, {name}{', with gradient' if gradient else ''}"
            pieces[title] = functools.partial(gpu.attention_workload, config, heads, attend, gradient=gradient)
    return pieces | {
        "tactile encoder, float32": functools.partial(gpu.tactile_encoder, config),
        "vision tower": functools.partial(gpu.vision_tower, config),
    }


def verdict(
    device: jax.Device, timed: Mapping[str, TimedWorkload], peak: float, sheet: DataSheet | None
) -> tuple[str, ...]:
    """Time and share of the peak of a step, decoding speed, and the gain of flash attention."""
    step, decoding = timed[STEP], timed["decoding"]
    engine, flash = (t for name, t in timed.items() if name.startswith("attention") and name.endswith("gradient"))
    read = memory_share(decoding, sheet)
    memory = "" if read is None else f", {read:.1%} of what the memory can deliver"
    return (
        *(() if device.platform == "gpu" else ("This device is no GPU: no figure here holds for one.",)),
        f"On {device.device_kind} a GRPO step takes {step.median_s:.3g} s, {step.flops / peak:.1%} of the peak; "
        f"decoding makes {decoding.made}{memory}.",
        f"Flash attention with its gradient takes {flash.median_s / engine.median_s:.2f} of the time of the engine's.",
    )


def memory_share(timed: TimedWorkload, sheet: DataSheet | None) -> float | None:
    """Bytes read a second over the data sheet's, where both are known."""
    return None if sheet is None or timed.read_bytes is None else timed.read_bytes / sheet.read_bytes


def time_table(timed: Mapping[str, TimedWorkload], sheet: DataSheet | None, peak_flops: float) -> Table:
    """Every workload against the peak."""
    rows = [
        {
            "piece": name,
            "median": 1e3 * t.median_s,
            "spread": 1e3 * (max(t.seconds) - min(t.seconds)),
            "makes": t.made,
            "work": t.flops / 1e12,
            "of peak": 100 * t.flops / peak_flops,
            "of memory": None if (read := memory_share(t, sheet)) is None else 100 * read,
        }
        for name, t in timed.items()
    ]
    peak = "the data sheet" if sheet is not None else "the plain product, for the device's data sheet is not known here"
    return named_table(
        "Time and share of the peak",
        rows,
        units={"median": "ms", "spread": "ms", "work": "TFLOP/s", "of peak": "%", "of memory": "%"},
        meanings={
            "spread": "slowest less fastest round",
            "work": "operations that no program can avoid, over time",
            "of memory": "bytes that must be read, over what the memory delivers",
        },
        note=f"The peak is that of {peak}: {peak_flops / 1e12:.4g} TFLOP/s.",
    )


def memory_table(reserved: int, counted: int, device: jax.Device) -> Table:
    """Bytes of a GRPO step: counted, reserved by the compiler, and the allocator's peak so far."""
    figures = {
        "counted by hand": counted,
        "XLA's compiler: arguments and temporaries": reserved,
        "the allocator's peak in this process": (device.memory_stats() or {}).get("peak_bytes_in_use"),
    }
    return named_table(
        "Memory of a GRPO step",
        [{"source": name, "memory": None if size is None else size / GB} for name, size in figures.items()],
        units={"memory": "GB"},
        note="The allocator has seen all pieces; the step is the largest of them.",
    )


SMOKE = gpu.GpuConfig(
    anywhere=True, rounds=2, side=64, prompts=1, tokens=24, heads=4, kv_heads=2, head_dim=8, flash="xla", streams=2,
    frames=4, contacts=1, tactile=TactileViTConfig(sensors=0, width=16, num_layers=1, num_heads=2, stem_width=4),
    tactile_px=28,
    vision=QwenVisionConfig(
        out_size=16, depth=1, hidden_size=16, num_heads=2, intermediate_size=32, patch_px=2, window_px=8,
        full_layers=(0,),
    ),
    vision_px=16, prefix=16,
    size=JobSize(
        prompts=2, group=2, length=6, vocab_size=64, hidden_size=32, num_layers=1, head_dim=8, intermediate_size=64
    ),
)  # fmt: skip

EXPERIMENT = Experiment(name="speed_gpu", config=gpu.GpuConfig(), scales={"smoke": SMOKE}, run=run)
