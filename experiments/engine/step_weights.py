"""Does a training step of a released model fit this machine, and how long does it compile?

    python -m experiments step_weights [--scale smoke] [--size 3B|Qwen3-VL-4B] [--run]

The experiment compiles one step of SFT, end to end through the vision tower, and one step of GRPO, at a released shape
without weights; both train adapters on frozen weights in bfloat16.  It reads the memory that the compiler reserves.  It
also compiles steps of `shallow` layers, because loops over stacked layers should compile as fast at any depth.  `--run`
also runs both steps with random weights in a separate process and measures its largest resident size.

Cost: two to five minutes of one core for the 3B; with `--run`, 1.5 times the memory of the weights.

Expected: 36 layers compile in 1.0 to 1.1 times the seconds of 8 layers; 14 GB for the 3B.
"""

import dataclasses
import time
from typing import Any

import jax

from experiments.core.context import Context
from experiments.core.results import Requirement, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.engine.load_checkpoints import SHAPES
from experiments.engine.processes import in_own_process
from experiments.engine.step_shapes import GB, StepShape, compiled_step, run_step
from touchr1_jax.models.qwen.config import QwenVisionConfig
from touchr1_jax.validation import at_least

STAGES = ("SFT", "GRPO")


@dataclasses.dataclass(frozen=True, kw_only=True)
class StepWeightsConfig:
    """The shape, the sizes of a step, and what is measured.

    Raises:
      ValueError: a size that has no shape.
    """

    size: str = "3B"
    shallow: int = 8
    """Layers of the decoder, and of the vision tower, that compiling is compared with; 0 compares with none."""
    step: StepShape = StepShape()
    run: bool = False
    """Also run both steps on drawn weights."""
    most_seconds: float = 120.0
    most_growth: float = 1.3
    most_bytes: float = 20e9

    def __post_init__(self) -> None:
        at_least(self, 0, "shallow")
        if self.size not in SHAPES:
            raise ValueError(f"size is {self.size!r}: must be one of {', '.join(SHAPES)}; correct it")


def run(config: StepWeightsConfig, context: Context) -> Results:
    """Compile each stage in a process of its own, then run it."""
    rows: list[dict[str, Any]] = []
    requirements: list[Requirement] = []
    for stage in context.each("stages", STAGES, still=True):
        found = in_own_process(measured, config, stage, 0)
        rows.append({"step": stage, **found})
        requirements += [
            at_most(f"{stage}: processor seconds to compile", found["compiling"], config.most_seconds),
            at_most(f"{stage}: GB that the compiler reserves", found["reserved"], config.most_bytes / GB),
        ]
        if config.shallow:
            less = in_own_process(measured, config, stage, config.shallow)
            rows.append({"step": f"{stage}, {config.shallow} layers", **less})
            growth = found["compiling"] / less["compiling"]
            requirements.append(at_most(f"{stage}: compiling over that of few layers", growth, config.most_growth))
        if config.run:
            ran = in_own_process(run_step, SHAPES[config.size], config.step, stage)
            rows[-2 if config.shallow else -1] |= ran
            requirements.append(at_most(f"{stage}: peak of the process, GB", ran["peak"], config.most_bytes / GB))
    first = rows[0]
    return Results(
        verdict=(
            f"A step of the {config.size} shape compiles in {first['compiling']:.0f} s of one core and reserves "
            f"{max(row['reserved'] for row in rows):.1f} GB at most.",
        ),
        requirements=tuple(requirements),
        tables=(table(rows),),
        settings={"size": config.size},
    )


def measured(config: StepWeightsConfig, stage: str, layers: int) -> dict[str, float]:
    """Processor seconds of tracing and of compiling, and the memory that the compiler reserves, GB."""
    model = SHAPES[config.size]
    if layers:
        depth = min(layers, model.vision.depth)
        of_layers = "full_layers" if isinstance(model.vision, QwenVisionConfig) else "deepstack_layers"
        named = tuple(i for i in getattr(model.vision, of_layers) if i < depth) or (0,)
        changed: dict[str, Any] = {"depth": depth, of_layers: named}
        vision = dataclasses.replace(model.vision, **changed)
        decoder = dataclasses.replace(model.decoder, num_layers=layers)
        model = dataclasses.replace(model, decoder=decoder, vision=vision)
    began = time.process_time(), time.perf_counter()
    compiled, traced = compiled_step(model, config.step, stage)
    memory: Any = compiled.memory_analysis()
    reserved = memory.argument_size_in_bytes + memory.temp_size_in_bytes + memory.output_size_in_bytes
    return {
        "tracing": traced - began[0],
        "compiling": time.process_time() - traced,
        "elapsed": time.perf_counter() - began[1],
        "arguments": memory.argument_size_in_bytes / GB,
        "temporary": memory.temp_size_in_bytes / GB,
        "reserved": (reserved - memory.alias_size_in_bytes) / GB,
    }


MEANINGS = {
    "tracing": "time of the processor until JAX has recorded the step",
    "compiling": "time of the processor until the recorded step is a program",
    "elapsed": "time on the clock of both, with waiting",
    "arguments": "parameters, state of the optimizer and batch",
    "temporary": "what the step needs in addition",
    "reserved": "all that the compiler reserves",
    "first": "time of the first step, on drawn weights",
    "second": "time of the second step",
    "weights": "memory of the frozen weights",
    "peak": "largest resident size of the process that ran both steps",
}


def table(rows: list[dict[str, Any]]) -> Table:
    """Every step."""
    named = {name: why for name, why in MEANINGS.items() if any(name in row for row in rows)}
    seconds = {"tracing", "compiling", "elapsed", "first", "second"}
    return named_table(
        "Steps of adapters on frozen weights",
        rows,
        units={name: "s" if name in seconds else "GB" for name in named},
        meanings=named,
        note=f"Compiled for {jax.default_backend()}.",
    )


SMOKE = StepWeightsConfig(size="tiny", shallow=2, run=True)

EXPERIMENT = Experiment(name="step_weights", config=StepWeightsConfig(), scales={"smoke": SMOKE}, run=run)
