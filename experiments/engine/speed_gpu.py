"""How fast are the encoders, decoding and a GRPO step on one GPU, and what share of its peak is that?

    make experiment EXP=speed_gpu [ARGS="--scale smoke"]

On the first device, in bfloat16 but for the tactile encoder, which computes in float32: a plain matrix product as the
yardstick; causal attention of prompts at the 7B's shapes, by the engine and by flash attention through
`jax.nn.dot_product_attention`, both held to float32; the tactile encoder and Qwen2.5-VL's vision tower, forward and
backward; decoding, and one GRPO step of a policy of Qwen2.5's 1.5B shape with the reference and the counterfactual
pass.  What a step reserves is held against the count by hand that `scale_paper` rests on.  Without a GPU it refuses;
`--scale smoke` is tiny and runs anywhere, to try the code.

Cost: not measured, for no GPU was at hand yet; `--scale smoke` under a minute.

Expected: the product reaches 60 to 80 % of the data sheet, flash attention several times the engine's speed; decoding
is bound by the memory, so that a GRPO step stays below a third of the peak.
"""

import functools
import re
from collections.abc import Callable, Mapping

import jax

from experiments.core.charts import bars
from experiments.core.context import Context
from experiments.core.results import Column, Picture, Requirement, Results, Table
from experiments.core.runner import Experiment
from experiments.core.timing import interleaved
from experiments.engine.attention import AttentionInputs, draw_heads, errors
from experiments.engine.gpu_config import GpuConfig
from experiments.engine.gpu_device import DataSheet, accelerator, sheet_of
from experiments.engine.gpu_pieces import (
    PolicyWorkloads,
    Workload,
    attention,
    product,
    tactile_encoder,
    vision_tower,
    ways,
)
from experiments.engine.gpu_tables import TimedWorkload, time_table
from experiments.engine.peers import JobSize
from touchr1_jax.distributed.memory import Compiled
from touchr1_jax.models.qwen.config import QwenVisionConfig
from touchr1_jax.models.tactile_vit import TactileViTConfig

PRODUCT, STEP = "matrix product", "GRPO step"

TACTILE = "tactile encoder, float32"

OFF_FLOAT32 = 0.02
"""Most that attention in bfloat16, which rounds by .004, may be off, over the largest number."""

GB = 1e9


def run(config: GpuConfig, context: Context) -> Results:
    """Time every piece, then compare attention and memory with what they must be."""
    device = accelerator(anywhere=config.anywhere)
    with context.progress("drawing what attends", 1) as advance:
        heads = draw_heads(config.prompts, config.tokens, config.heads, config.kv_heads, config.head_dim)
        advance()
    timed = measured("pieces", without_policy(config, heads), config.rounds, context)
    off = errors(heads, ways(config), context)
    del heads
    with context.progress("making the policy", 2) as advance:
        learning = PolicyWorkloads(config)
        advance()
        reserved, counted = learning.memory()
        advance()
    timed |= measured("the policy", {"decoding": learning.decoding, STEP: learning.step}, config.rounds, context)
    sheet = sheet_of(device.device_kind)
    first = timed[PRODUCT]
    peak = first.flops / min(first.seconds) if sheet is None else sheet.flops
    return Results(
        verdict=verdict(device, timed, peak, sheet),
        requirements=tuple(
            Requirement(name=f"attention, {name}: off float32", measured=e, bound=OFF_FLOAT32, better="lower")
            for name, e in off.items()
        ),
        tables=(time_table(timed, sheet, peak), memory_table(reserved, counted, device)),
        pictures=(
            Picture(
                name="share",
                title="Share of the peak",
                caption="Operations that no program can avoid, over the time that they took and the device's peak.",
                content=bars({n: 100 * t.share(peak) for n, t in timed.items()}, "share of the peak, %", written=".1f"),
            ),
        ),
        settings={"device": device.device_kind, "platform": device.platform, "jax": jax.__version__},
    )


def without_policy(config: GpuConfig, heads: AttentionInputs) -> dict[str, Callable[[], Workload]]:
    """How to make the product, attention and the encoders."""
    pieces: dict[str, Callable[[], Workload]] = {PRODUCT: functools.partial(product, config)}
    for name, way in ways(config).items():
        for gradient in (False, True):
            title = f"attention, {name}{', with gradient' if gradient else ''}"
            pieces[title] = functools.partial(attention, config, heads, way, gradient=gradient)
    return pieces | {
        TACTILE: functools.partial(tactile_encoder, config),
        "vision tower": functools.partial(vision_tower, config),
    }


def measured(
    title: str, pieces: Mapping[str, Callable[[], Workload]], rounds: int, context: Context
) -> dict[str, TimedWorkload]:
    """The times of some pieces."""
    shown = context.each(title, pieces.items(), still=True)
    return {name: measure(name, make, rounds, context) for name, make in shown}


def measure(name: str, make: Callable[[], Workload], rounds: int, context: Context) -> TimedWorkload:
    """Make a piece, run it twice, time it."""
    with context.timed(re.sub(r"\W+", "_", name)):
        piece = make()
        for _ in range(2):
            jax.block_until_ready(piece.call())
        seconds = interleaved({name: piece.call}, context.rounds(f"timing {name}", rounds))[name]
    timed = TimedWorkload(tuple(seconds.tolist()), piece.flops, piece.read_bytes, piece.made, piece.unit)
    context.print(f"{name}: {1e3 * timed.median_s:.4g} ms, {timed.flops / timed.median_s / 1e12:.3g} TFLOP/s")
    return timed


def memory_table(reserved: Compiled, counted: int, device: jax.Device) -> Table:
    """What the compiler reserves for a GRPO step, what the count says, and what the allocator saw so far."""
    seen = device.memory_stats() or {}
    most = seen.get("peak_bytes_in_use")
    return Table(
        title="Memory of a GRPO step",
        columns=(
            Column(name="who says so"),
            Column(name="memory", unit="GB", format=".3g"),
        ),
        rows=(
            ("counted by hand", counted / GB),
            ("XLA's compiler: arguments and what passes", reserved.peak / GB),
            ("the allocator's peak in this process", None if most is None else most / GB),
        ),
        note="The allocator has seen all pieces; the step is the largest of them.",
    )


def verdict(
    device: jax.Device, timed: Mapping[str, TimedWorkload], peak: float, sheet: DataSheet | None
) -> tuple[str, ...]:
    """What the device is, what a step takes of it, what flash attention would gain."""
    step, decoding = timed[STEP], timed["decoding"]
    read = decoding.read_share(sheet)
    engine, flash = (t for name, t in timed.items() if name.startswith("attention") and name.endswith("gradient"))
    said = [
        f"On {device.device_kind} a GRPO step takes {step.median_s:.3g} s, {step.share(peak):.1%} of the peak; "
        f"decoding makes {decoding.made / decoding.median_s:,.0f} tokens a second"
        + ("." if read is None else f", {read:.1%} of what the memory can deliver."),
        f"Flash attention with its gradient takes {flash.median_s / engine.median_s:.2f} of the time of the engine's.",
    ]
    if device.platform != "gpu":
        said.insert(0, "This device is no GPU: the code was tried, and no figure here says anything about one.")
    return tuple(said)


DEFAULT = GpuConfig()
SMOKE = GpuConfig(
    anywhere=True,
    rounds=2,
    side=64,
    prompts=1,
    tokens=24,
    heads=4,
    kv_heads=2,
    head_dim=8,
    flash="xla",
    streams=2,
    frames=4,
    contacts=1,
    tactile=TactileViTConfig(sensors=0, width=16, num_layers=1, num_heads=2, stem_width=4),
    tactile_px=28,
    vision=QwenVisionConfig(
        out_size=16, depth=1, hidden_size=16, num_heads=2, intermediate_size=32, patch_px=2, window_px=8,
        full_layers=(0,),
    ),
    vision_px=16,
    size=JobSize(
        prompts=2, group=2, length=6, vocab_size=64, hidden_size=32, num_layers=1, head_dim=8, intermediate_size=64
    ),
    prefix=16,
)  # fmt: skip

EXPERIMENT = Experiment(name="speed_gpu", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
