"""Memory of each way to lay the training out, as bars."""

import matplotlib as mpl
from matplotlib.figure import Figure

from experiments.core.charts import LOOK, PALETTE, svg
from experiments.engine.scale_tables import GB, Lines, Reserved
from touchr1_jax.distributed.memory import ARGUMENTS, LEARNING, SAMPLING

ALWAYS, PASSING = "arguments", "weights in use"


def memory_bars(lines: Lines, reserved: Reserved, bound: float) -> bytes:
    """Counted bytes in four parts, a diamond where the compiler has its say, and the device's memory.

    Args:
      lines: counted.
      reserved: compiled.
      bound: bytes of the device, drawn as a dotted line.
    """
    names = [setup.name for setup in lines]
    with mpl.rc_context(LOOK):
        figure = Figure(figsize=(7.2, 1.5 + 0.5 * len(names)), layout="constrained")
        axes = figure.subplots()
        left = [0.0] * len(names)
        for colour, (label, sizes) in zip(PALETTE, parts(lines).items(), strict=False):
            axes.barh(names, sizes, left=left, color=colour, height=0.55, label=label)
            left = [a + b for a, b in zip(left, sizes, strict=True)]
        peaks = {setup.name: by[max(by)].peak / GB for setup, by in reserved.items()}
        if peaks:
            axes.plot(
                list(peaks.values()), list(peaks), "D", color="black", ms=6, label="compiled, extrapolated", ls=""
            )
        axes.axvline(bound / GB, color="black", ls=":", lw=1, label="memory of the device")
        axes.set(xlabel="GB on each device")
        axes.invert_yaxis()
        figure.legend(loc="outside upper center", ncols=3, frameon=False)
        return svg(figure)


def parts(lines: Lines) -> dict[str, list[float]]:
    """Counted gigabytes of each setup: arguments, weights in use, and the larger of sampling and learning."""
    found: dict[str, list[float]] = {ALWAYS: [], PASSING: [], "sampling": [], "learning": []}
    for by in lines.values():
        phases = {"sampling": sum(by[n] for n in SAMPLING), "learning": sum(by[n] for n in LEARNING)}
        larger = max(phases, key=lambda name: phases[name])
        always = sum(by[n] for n in ARGUMENTS)
        found[ALWAYS].append(always / GB)
        found[PASSING].append((sum(by.values()) - always - sum(phases.values())) / GB)
        for name, size in phases.items():
            found[name].append(size / GB if name == larger else 0.0)
    return {name: sizes for name, sizes in found.items() if any(sizes)}
