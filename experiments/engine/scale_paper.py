"""Does GRPO of the 7B fit the paper's sixteen H200, and how long would a step take?

    python -m experiments scale_paper [--scale smoke] [--compiler h200]

Touch-R1 trained Qwen2.5-VL 7B on sixteen H200 with 8 frames of 448² from four sensors and groups of eight.  Here the
same step, with the reference and the counterfactual policy, is compiled for sixteen devices, without weights or
devices, and the memory that the compiler reserves is compared with an analytic count.  `--compiler cpu` uses the
compiler of this machine; `--compiler h200` uses the GPU compiler, which needs JAX's CUDA plugin but no GPU.  For other
meshes, and for adapters on a frozen base, memory is only counted; `--compiled N` compiles more of these setups.  To
train in this layout, run a study with `--distributed --mesh.fsdp 8 --mesh.tensor 2`, in one process per GPU under
Slurm, with `grpo.remat`, `grpo.bfloat16` and one prompt a micro-batch.

Cost: a minute and a half of one core for each setup that `h200` compiles; `--scale smoke` two and a half minutes.

Expected: 43 of 141 GB on each device, 32 with adapters (`--compiled 2`); some 5 s per step at the assumed shares of
peak, two thirds of it for the update, because sampling gathers the sharded weights once, not at every token.  The 32B
on 64 devices (`--size 32B --meshes 1 8 8`) needs 56 GB on each, 43 with adapters.
"""

import dataclasses
import functools
from collections.abc import Mapping

from experiments.core.charts import Panel, Rule, Series, draw
from experiments.core.context import Context
from experiments.core.results import Cell, Picture, Requirement, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.engine.load_checkpoints import TINY
from experiments.engine.scale_compiling import (
    PAPER_PROMPT,
    TINY_PROMPT,
    Compiler,
    Setup,
    Training,
    compile_in_process,
)
from touchr1_jax.distributed.memory import ARGUMENTS, LEARNING, SAMPLING, Compiled, counted_peak
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.work import Machine, model_flops, seconds
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.qwen.config import released

GB = 1e9

Lines = Mapping[Setup, Mapping[str, int]]  # setup → line → counted bytes on each device

Reserved = Mapping[Setup, Compiled]
"""Bytes that the compiler reserves for each setup that was compiled."""

COUNTERS_BYTES = 12  # bytes of the step's arguments that no line counts: its key, 8, and its number, 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScaleConfig:
    """The training, its layouts over devices, and how many of these are compiled.

    Raises:
      ValueError: a size that is not released, no mesh, more compiled than there are.
    """

    size: str = "7B"
    """Of the released model, or `tiny`."""
    meshes: tuple[tuple[int, int, int], ...] = ((1, 8, 2), (1, 16, 1), (1, 4, 4), (2, 8, 1))
    """Devices along data, fsdp and tensor; the first also with adapters."""
    compiled: int = 1
    """Setups that are compiled, from the first on."""
    compiler: Compiler = "cpu"
    prompts: int = 16
    group: int = 8
    length: int = 512
    machine: Machine = Machine()

    def __post_init__(self) -> None:
        if self.size != "tiny":
            released(self.size)
        if not self.meshes or not 0 <= self.compiled <= len(self.meshes) + 1:
            raise ValueError(
                f"compiled is {self.compiled}: must be 0 … {len(self.meshes) + 1}, the meshes and the adapters; correct"
            )

    @property
    def setups(self) -> tuple[Setup, ...]:
        """The first mesh, the same with adapters, the other meshes."""
        meshes = [MeshConfig(data=d, fsdp=f, tensor=t) for d, f, t in self.meshes]
        first, *others = (Setup(mesh=mesh) for mesh in meshes)
        return first, Setup(mesh=meshes[0], lora=LoraConfig(rank=16)), *others

    @property
    def training(self) -> Training:
        """The training to count and compile."""
        model, prompt = (TINY, TINY_PROMPT) if self.size == "tiny" else (released(self.size), PAPER_PROMPT)
        return Training(model=model, prompt=prompt, group=self.group, length=self.length, prompts=self.prompts)


def run(config: ScaleConfig, context: Context) -> Results:
    """Count every setup, compile the first, predict."""
    training = config.training
    lines = {setup: training.counted(setup) for setup in context.each("counting", config.setups)}
    reserved = {
        setup: compiled(config, setup, context) for setup in context.each("compilers", config.setups[: config.compiled])
    }
    return Results(
        verdict=verdict(config, lines, reserved),
        requirements=requirements(config, lines, reserved),
        tables=(
            byte_table(lines),
            *((memory_table(config, lines, reserved),) if reserved else ()),
            time_table(config),
        ),
        pictures=(
            Picture(
                name="memory",
                title="Memory of a step on each device",
                caption="Bars are counted by hand; the larger of sampling and learning is drawn, since one follows the "
                "other.",
                content=memory_bars(lines, reserved, config.machine.memory_bytes),
            ),
        ),
        settings={
            "model": config.size,
            "prompt": f"{training.prompt.tokens} tokens",
            "compiler": f"{config.compiler}, no device was there",
        },
    )


def compiled(config: ScaleConfig, setup: Setup, context: Context) -> Compiled:
    """Bytes that the compiler reserves, saved as a stage."""
    stage = f"compile/{config.setups.index(setup)}"
    with context.timed(stage):
        work = functools.partial(compile_in_process, config.training, setup, config.compiler)
        found = Compiled(*context.once(stage, work))
    context.print(f"{setup.name}: {found.peak / GB:.2f} GB")
    return found


def requirements(config: ScaleConfig, lines: Lines, reserved: Reserved) -> tuple[Requirement, ...]:
    """The count and the reserved memory fit the device; the compiled arguments equal the counted ones."""
    bound = config.machine.memory_bytes / GB
    found = [at_most(f"{setup.name}: counted", counted_peak(by) / GB, bound, "GB") for setup, by in lines.items()]
    for setup, full in reserved.items():
        own = sum(lines[setup][name] for name in ARGUMENTS) + COUNTERS_BYTES
        found.append(at_most(f"{setup.name}: reserved for {config.compiler}", full.peak / GB, bound, "GB"))
        off = 100 * abs(full.arguments / own - 1)
        found.append(at_most(f"{setup.name}: arguments, difference from the count", off, 0.1, "%"))
    return tuple(found)


def verdict(config: ScaleConfig, lines: Lines, reserved: Reserved) -> tuple[str, ...]:
    """Memory of a step, counted and compiled, and its predicted time."""
    first = config.setups[0]
    times = seconds(config.training.shape(first), config.machine)
    return (
        f"Counted by hand, a step of the {config.size} on {first.mesh.devices} devices ({first.name}) takes "
        f"{counted_peak(lines[first]) / GB:.1f} of {config.machine.memory_bytes / GB:.0f} GB on each.",
        *(
            f"XLA reserves {c.peak / GB:.1f} GB for {setup.name} (compiler: {config.compiler}), the "
            "reference and the counterfactual passes included."
            for setup, c in reserved.items()
        ),
        f"Predicted, not measured: {sum(times.values()):.1f} s a step, of which sampling {times['sampling']:.1f} s.",
    )


def byte_table(lines: Lines) -> Table:
    """The count, line by line."""
    rows: list[dict[str, Cell]] = [
        {"what": name, **{setup.name: by[name] / GB for setup, by in lines.items()}}
        for name in next(iter(lines.values()))
    ]
    rows.append({"what": "largest at one time", **{s.name: counted_peak(by) / GB for s, by in lines.items()}})
    return named_table(
        "Counted by hand, GB on each device",
        rows,
        formats={setup.name: ".2f" for setup in lines},
        note="fsdp: devices over which parameters are divided, tensor: devices that share each layer.  LoRA: adapters "
        "of that rank on a frozen base.  Sampling and learning take turns: the larger counts.",
    )


def memory_table(config: ScaleConfig, lines: Lines, reserved: Reserved) -> Table:
    """The compiler's figures with the count."""
    layers = config.training.model.decoder.num_layers
    return named_table(
        f"Reserved by XLA's compiler for {config.compiler}, GB on each device",
        [
            {
                "setup": f"{setup.name}, {layers} layers",
                "arguments": c.arguments / GB,
                "temporary": c.temporary / GB,
                "peak": c.peak / GB,
                "counted": counted_peak(lines[setup]) / GB,
            }
            for setup, c in reserved.items()
        ],
        formats=dict.fromkeys(("arguments", "temporary", "peak", "counted"), ".2f"),
        note="An upper bound: on a CPU the compiler multiplies bfloat16 as float32."
        if config.compiler == "cpu"
        else "",
    )


def time_table(config: ScaleConfig) -> Table:
    """Predicted seconds of a step of the full training by phase."""
    machine = config.machine
    rows: list[dict[str, Cell]] = []
    for setup in (setup for setup in config.setups if setup.lora is None):
        shape = config.training.shape(setup)
        phases = seconds(shape, machine)
        step_s = sum(phases.values())
        share = model_flops(shape) / step_s / machine.flops / setup.mesh.devices
        rows.append({"setup": setup.name, **phases, "step": step_s, "share of peak": 100 * share})
    return named_table(
        "Predicted seconds of a step",
        rows,
        units={**dict.fromkeys(("prompts", "sampling", "learning", "step"), "s"), "share of peak": "%"},
        meanings={"share of peak": "operations that no program can avoid, over the step"},
        note=(
            f"Each phase takes what is longest of computing at {machine.flops_share:.0%} of {machine.flops / 1e12:.0f} "
            f"TFLOP/s, reading at {machine.read_share:.0%} of {machine.read_bytes / 1e12:.1f} TB/s and gathering at "
            f"{machine.link_share:.0%} of {machine.near_bytes / GB:.0f} GB/s inside a machine, "
            f"{machine.far_bytes / GB:.0f} GB/s between machines.  A prediction: no step was timed on such a machine."
        ),
    )


def memory_bars(lines: Lines, reserved: Reserved, bound: float) -> bytes:
    """Draw counted bytes in four parts, the compiler's figures as points, and the device's memory as a line."""
    rows = [setup.name for setup in lines]
    bars = [Series(name, x=sizes, bar=True) for name, sizes in parts(lines).items()]
    if reserved:
        peaks, y = [c.peak / GB for c in reserved.values()], [rows.index(s.name) for s in reserved]
        bars.append(Series("compiled", x=peaks, y=y, marker="D", colour="black"))
    rules = [Rule(x=bound / GB, name="memory of the device")]
    return draw([Panel(bars, rows=rows, stacked=True, x_label="GB on each device", rules=rules)])


def parts(lines: Lines) -> dict[str, list[float]]:
    """Counted gigabytes of each setup: arguments, weights in use, and the larger of sampling and learning."""
    found: dict[str, list[float]] = {name: [] for name in ("arguments", "weights in use", "sampling", "learning")}
    for by in lines.values():
        arguments, *phases = (sum(by[n] for n in names) for names in (ARGUMENTS, SAMPLING, LEARNING))
        weights = sum(by.values()) - arguments - sum(phases)
        larger = (size if size == max(phases) else 0 for size in phases)
        for sizes, size in zip(found.values(), (arguments, weights, *larger), strict=True):
            sizes.append(size / GB)
    return {name: sizes for name, sizes in found.items() if any(sizes)}


DEFAULT = ScaleConfig()
SMOKE = ScaleConfig(size="tiny", meshes=((1, 2, 2), (1, 4, 1)), compiled=2, prompts=4, group=2, length=6)

EXPERIMENT = Experiment(name="scale_paper", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
