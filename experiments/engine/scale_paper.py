"""Does GRPO of the 7B fit the paper's sixteen H200, and how long would a step take?

    python -m experiments scale_paper [--scale smoke] [--compiler h200]

Touch-R1 trained Qwen2.5-VL 7B on sixteen H200 with 8 frames of 448² from four sensors and groups of eight.  Here the
same step, with the reference and the counterfactual policy, is lowered and compiled for sixteen devices without weights
and without the devices, and what the compiler reserves is held against a count by hand.  Decoders of one and two layers
are compiled at full width; layers are alike, so that a straight line gives all of them.  `--compiler cpu` asks the
compiler of this machine, which keeps products of bfloat16 in float32; `--compiler h200` asks the GPU's, which needs
JAX's CUDA plugin but no GPU.  Other meshes, and adapters on a frozen base, are counted; `--compiled N` compiles more.

To train so: the same mesh on the command line of a study, `--distributed --mesh.fsdp 8 --mesh.tensor 2`, in one process
per GPU under Slurm, with `grpo.remat`, `grpo.bfloat16` and micro-batches of one prompt a device.

Cost: 5 to 10 minutes on one core with one mesh compiled; `--scale smoke` half a minute.

Expected: about 50 of 141 GB on each device; some 5 s a step at the assumed shares of peak, two thirds of it learning:
sampling gathers the sharded weights once, not at every token.
"""

import dataclasses

from experiments.core.context import Context
from experiments.core.results import Picture, Requirement, Results
from experiments.core.runner import Experiment
from experiments.engine.paper_shapes import PAPER_PROMPT, TINY_PROMPT, Setup, Training, model_of
from experiments.engine.scale_charts import memory_bars
from experiments.engine.scale_compiling import Compiler, compiled_alone
from experiments.engine.scale_tables import GB, Lines, Reserved, byte_table, memory_table, time_table
from touchr1_jax.distributed.memory import ARGUMENTS, Compiled, at_depths, counted_peak, grpo_bytes
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.work import Machine, seconds
from touchr1_jax.models.lora import LoraConfig

COUNTERS_BYTES = 12
"""Of a step's arguments that no line counts: its key, 8 bytes, and its number, 4."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ScaleConfig:
    """The training, the ways to lay it out, and how many of them are compiled.

    Raises:
      ValueError: no mesh, more compiled than there are, depths that do not ascend.
    """

    size: str = "7B"
    """Of the released model, or `tiny`."""
    meshes: tuple[tuple[int, int, int], ...] = ((1, 8, 2), (1, 16, 1), (1, 4, 4), (2, 8, 1))
    """Devices along data, fsdp and tensor; the first also with adapters."""
    compiled: int = 1
    """Setups that are compiled, from the first on."""
    compiler: Compiler = "cpu"
    layers: tuple[int, int] = (1, 2)
    """Depths that are compiled."""
    prompts: int = 16
    micro_rows: int = 1
    """Prompts of a micro-batch on each device."""
    group: int = 8
    length: int = 512
    lora_rank: int = 16
    machine: Machine = Machine()

    def __post_init__(self) -> None:
        if not self.meshes or not 0 <= self.compiled <= len(self.meshes) + 1:
            raise ValueError(
                f"compiled is {self.compiled}: must be 0 … {len(self.meshes) + 1}, the meshes and the adapters; correct"
            )
        if not 0 < self.layers[0] < self.layers[1]:
            raise ValueError(f"layers is {self.layers}: must be two ascending depths; give such as 1 2")

    @property
    def setups(self) -> tuple[Setup, ...]:
        """The first mesh, the same with adapters, the other meshes."""
        meshes = [MeshConfig(data=d, fsdp=f, tensor=t) for d, f, t in self.meshes]
        first, *others = (Setup(mesh=mesh) for mesh in meshes)
        return first, Setup(mesh=meshes[0], lora=LoraConfig(rank=self.lora_rank)), *others

    @property
    def training(self) -> Training:
        """What is trained."""
        return Training(
            model=model_of(self.size),
            prompt=TINY_PROMPT if self.size == "tiny" else PAPER_PROMPT,
            group=self.group,
            length=self.length,
            micro_rows=self.micro_rows,
            prompts=self.prompts,
        )


def run(config: ScaleConfig, context: Context) -> Results:
    """Count every setup, compile the first, predict."""
    training = config.training
    lines = {setup: counted(training, setup) for setup in context.each("counting", config.setups)}
    reserved = {
        setup: compiled(config, setup, context) for setup in context.each("compilers", config.setups[: config.compiled])
    }
    full = tuple(setup for setup in config.setups if setup.lora is None)
    return Results(
        verdict=verdict(config, lines, reserved),
        requirements=requirements(config, lines, reserved),
        tables=(
            byte_table(lines),
            *((memory_table(lines, reserved, config.compiler, depth(config)),) if reserved else ()),
            time_table(training, full, config.machine),
        ),
        pictures=(
            Picture(
                name="memory",
                title="Memory of a step on each device",
                caption="Bars are counted by hand; the larger of sampling and learning is drawn, for they take turns.",
                content=memory_bars(lines, reserved, config.machine.memory_bytes),
            ),
        ),
        settings={
            "model": config.size,
            "prompt": f"{training.prompt.tokens} tokens",
            "compiler": f"{config.compiler}, no device was there",
        },
    )


def depth(config: ScaleConfig) -> int:
    """Layers of the model."""
    return config.training.model.decoder.num_layers


def counted(training: Training, setup: Setup) -> dict[str, int]:
    """Bytes on each device, line by line."""
    step = training.step(setup)
    return grpo_bytes(training.shape(setup), step.state, step.batch, step.frozen, step.base)


def compiled(config: ScaleConfig, setup: Setup, context: Context) -> dict[int, Compiled]:
    """What the compiler reserves at both depths, each of which is remembered, and on their line at the model's."""
    found: dict[int, Compiled] = {}
    for layers in context.each(setup.name, config.layers):
        stage = f"compile/{config.setups.index(setup)}/{layers}"
        if not context.done(stage):
            outcome = compiled_alone(config.training.of_depth(layers), setup, config.compiler)
            context.save_stage(stage, {"bytes": outcome.compiled, "seconds": outcome.seconds})
        saved = context.load_stage(stage)
        found[layers] = Compiled(*saved["bytes"])
        context.print(
            f"{setup.name}, {layers} layers: {found[layers].peak / GB:.2f} GB, compiled in {saved['seconds']:.0f} s"
        )
    return found | {depth(config): at_depths(found, depth(config))}


def requirements(config: ScaleConfig, lines: Lines, reserved: Reserved) -> tuple[Requirement, ...]:
    """The device's memory holds the count and what is reserved; the arguments are those counted."""
    bound, found = config.machine.memory_bytes / GB, []
    for setup, by in lines.items():
        found.append(fits(f"{setup.name}: counted", counted_peak(by), bound))
    for setup, depths in reserved.items():
        found.append(fits(f"{setup.name}: reserved for {config.compiler}", depths[depth(config)].peak, bound))
        own = sum(lines[setup][name] for name in ARGUMENTS) + COUNTERS_BYTES
        off = abs(depths[depth(config)].arguments / own - 1)
        found.append(
            Requirement(name=f"{setup.name}: arguments off the count", measured=off, bound=1e-3, better="lower")
        )
    return tuple(found)


def fits(name: str, size: float, bound: float) -> Requirement:
    """Bytes against gigabytes of a device."""
    return Requirement(name=name, measured=size / GB, bound=bound, better="lower", unit="GB")


def verdict(config: ScaleConfig, lines: Lines, reserved: Reserved) -> tuple[str, ...]:
    """Whether it fits, and how long it would take."""
    first = config.setups[0]
    said = [
        f"Counted by hand, a step of the {config.size} on {first.mesh.devices} devices ({first.name}) takes "
        f"{counted_peak(lines[first]) / GB:.1f} of {config.machine.memory_bytes / GB:.0f} GB on each."
    ]
    for setup, by in reserved.items():
        said.append(
            f"XLA reserves {by[depth(config)].peak / GB:.1f} GB for {setup.name} (compiler: {config.compiler}), the "
            "reference and the counterfactual passes included."
        )
    times = seconds(config.training.shape(first), config.machine)
    said.append(
        f"Predicted, not measured: {sum(times.values()):.1f} s a step, of which sampling {times['sampling']:.1f} s."
    )
    return tuple(said)


DEFAULT = ScaleConfig()
SMOKE = ScaleConfig(size="tiny", meshes=((1, 2, 2), (1, 4, 1)), compiled=2, prompts=4, group=2, length=6)

EXPERIMENT = Experiment(name="scale_paper", config=DEFAULT, scales={"smoke": SMOKE}, run=run)
