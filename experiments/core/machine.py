"""The machine of a run: the accelerators that a scale needs, and quick compilation for scales that run briefly."""

import contextlib
import dataclasses
import os
from collections.abc import Iterator

import jax

GIB = 2**30

OLDER_LOOPS = "--xla_cpu_use_fusion_emitters=false" if jax.__version_info__ < (0, 11) else ""
"""Flag of XLA: the older of its two ways to write a fused loop, as long as it exists, compiles twice as fast."""

FLAGS = "XLA_FLAGS"
"""Environment variable that XLA reads when it compiles its first program, and never again."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Accelerators:
    """Accelerators over all processes, and the memory of each."""

    number: int
    memory_gib: float

    def __str__(self) -> str:
        return f"{self.number} accelerator{'s' if self.number > 1 else ''} of {self.memory_gib:g} GiB"


class MachineError(Exception):
    """A machine that has less than a scale needs; the message names both and the fix."""


def require_accelerators(scale: str, needed: Accelerators | None, present: Accelerators | None = None) -> None:
    """Refuse a scale that this machine cannot run, before any work is done for it.

    Args:
      scale: its name.
      needed: `None` where any machine does.
      present: by default those of this machine.

    Raises:
      MachineError: too few accelerators, or too little memory on each.
    """
    if needed is None:
        return
    present = present or accelerators()
    if present.number < needed.number or present.memory_gib < needed.memory_gib:
        here = str(present) if present.number else f"none, only {jax.default_backend()}"
        raise MachineError(
            f"scale is {scale!r}: needs {needed}, and this machine has {here}; run it on such a machine (several "
            "processes: --distributed and a mesh), or start from --scale default and raise single values"
        )


def accelerators() -> Accelerators:
    """The accelerators of all processes, and the least memory that one of this process has."""
    devices = [d for d in jax.devices() if d.platform != "cpu"]
    if not devices:
        return Accelerators(number=0, memory_gib=0.0)
    limits = [(d.memory_stats() or {}).get("bytes_limit", 0) for d in jax.local_devices()]
    return Accelerators(number=len(devices), memory_gib=min(limits) / GIB)


@contextlib.contextmanager
def compiled_quickly() -> Iterator[None]:
    """Leave out most of XLA's optimisations inside the block: a training step compiles in a quarter of the time.

    This pays for programs that run a few times only.  They compute the same up to rounding; their speed says nothing
    about that of others.  The older loops stay chosen for the whole process where its first program is compiled inside
    the block.
    """
    flags, before = os.environ.get(FLAGS), jax.config.values["jax_disable_most_optimizations"]
    if OLDER_LOOPS not in (flags or ""):
        os.environ[FLAGS] = f"{flags or ''} {OLDER_LOOPS}".strip()
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)
        if flags is None:
            os.environ.pop(FLAGS, None)
        else:
            os.environ[FLAGS] = flags
