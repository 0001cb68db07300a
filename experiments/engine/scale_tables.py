"""What was counted, compiled and predicted, as tables."""

from collections.abc import Mapping

from experiments.core.results import Cell, Column, Table
from experiments.engine.paper_shapes import Setup, Training
from touchr1_jax.distributed.memory import Compiled, counted_peak
from touchr1_jax.distributed.work import Machine, model_flops, seconds

GB = 1e9

Lines = Mapping[Setup, Mapping[str, int]]
"""Setup → line → counted bytes on each device."""

Reserved = Mapping[Setup, Mapping[int, Compiled]]
"""Setup → layers → what the compiler reserves; the largest number of layers is extrapolated."""


def byte_table(lines: Lines) -> Table:
    """The count, line by line."""
    names = list(next(iter(lines.values())))
    rows: list[tuple[Cell, ...]] = [(name, *(by[name] / GB for by in lines.values())) for name in names]
    return Table(
        title="Counted by hand, GB on each device",
        columns=(Column(name="what"), *(Column(name=setup.name, format=".2f") for setup in lines)),
        rows=(*rows, ("largest at one time", *(counted_peak(by) / GB for by in lines.values()))),
        note="LoRA: adapters of that rank on a frozen base.  Sampling and learning take turns: the larger counts.",
    )


def memory_table(lines: Lines, reserved: Reserved, compiler: str, layers: int) -> Table:
    """The compiler's figures beside the count."""
    rows: list[tuple[Cell, ...]] = []
    for setup, by in reserved.items():
        for depth, c in by.items():
            what = f"{setup.name}, {depth} layers{' (extrapolated)' if depth == layers else ''}"
            counted: Cell = counted_peak(lines[setup]) / GB if depth == layers else None
            rows.append((what, c.arguments / GB, c.temporary / GB, c.peak / GB, counted))
    return Table(
        title=f"Reserved by XLA's compiler for {compiler}, GB on each device",
        columns=(
            Column(name="setup"),
            Column(name="arguments", format=".2f"),
            Column(name="temporary", format=".2f"),
            Column(name="peak", format=".2f"),
            Column(name="counted", format=".2f"),
        ),
        rows=tuple(rows),
        note="Equal layers need equal memory: a straight line through the compiled depths gives the model's.",
    )


def time_table(training: Training, setups: tuple[Setup, ...], machine: Machine) -> Table:
    """Predicted seconds of a step by phase."""
    rows: list[tuple[Cell, ...]] = []
    for setup in setups:
        shape = training.shape(setup)
        phases = seconds(shape, machine)
        share = model_flops(shape) / sum(phases.values()) / machine.flops / setup.mesh.devices
        rows.append((setup.name, *phases.values(), sum(phases.values()), 100 * share))
    return Table(
        title="Predicted seconds of a step",
        columns=(
            Column(name="setup"),
            Column(name="prompts", unit="s"),
            Column(name="sampling", unit="s"),
            Column(name="learning", unit="s"),
            Column(name="step", unit="s"),
            Column(name="share of peak", unit="%", meaning="operations that no program can avoid, over the step"),
        ),
        rows=tuple(rows),
        note=(
            f"Each phase takes what is longest of computing at {machine.flops_share:.0%} of {machine.flops / 1e12:.0f} "
            f"TFLOP/s, reading at {machine.read_share:.0%} of {machine.read_bytes / 1e12:.1f} TB/s and gathering at "
            f"{machine.link_share:.0%} of {machine.near_bytes / GB:.0f} GB/s inside a machine, "
            f"{machine.far_bytes / GB:.0f} between machines.  A prediction: no step was timed on such a machine."
        ),
    )
