"""What a scale needs of the machine, and the answer where the machine has less."""

import dataclasses

import jax

GIB = 2**30


@dataclasses.dataclass(frozen=True, kw_only=True)
class Machine:
    """Accelerators, over all processes, and the memory of each."""

    accelerators: int
    memory_gib: float

    def __str__(self) -> str:
        plural = "s" if self.accelerators > 1 else ""
        return f"{self.accelerators} accelerator{plural} of {self.memory_gib:g} GiB"


class MachineError(Exception):
    """A machine that has less than a scale needs; the message says what both are, and what to do."""


def require_machine(scale: str, needs: Machine | None) -> None:
    """Refuse a scale that this machine cannot run, before anything is made for it.

    Args:
      scale: its name.
      needs: what it needs; `None` where any machine does.

    Raises:
      MachineError: too few accelerators, or too little memory on each.
    """
    if needs is None:
        return
    there = found()
    if there.accelerators < needs.accelerators or there.memory_gib < needs.memory_gib:
        here = str(there) if there.accelerators else f"none, only {jax.default_backend()}"
        raise MachineError(
            f"scale is {scale!r}: needs {needs}, and there is {here}; run it on such a machine (several processes: "
            "--distributed and a mesh), or start from --scale default and raise single values"
        )


def found() -> Machine:
    """The accelerators of all processes, and the least memory that one of this process has."""
    devices = [d for d in jax.devices() if d.platform != "cpu"]
    if not devices:
        return Machine(accelerators=0, memory_gib=0.0)
    limits = [(d.memory_stats() or {}).get("bytes_limit", 0) for d in jax.local_devices()]
    return Machine(accelerators=len(devices), memory_gib=min(limits) / GIB)
