"""Memory that a run needs, named before anything is compiled: XLA aborts the process where it gets none."""

import os
import resource
from collections.abc import Mapping
from pathlib import Path

from touchr1_jax.distributed.processes import GIB, MachineError

BASE = "libraries and compiler"
BASE_BYTES = round(1.3 * GIB)
"""Peak of the default study without its clips, measured while it compiles (1.07 to 1.35 GB)."""

RESERVED_BYTES, CORE_BYTES = round(0.8 * GIB), GIB // 16
"""Address space beyond that: what allocators reserve, and the stacks of threads for each core."""


def require_memory(parts: Mapping[str, int]) -> str:
    """One line about the memory that a run needs on the host and what is free.

    `parts` are bytes by purpose, besides libraries and compiler; `MachineError` if the process may not have so much.
    """
    parts = {BASE: BASE_BYTES, **parts}
    need = sum(parts.values())
    listed = ", ".join(f"{name} {size / GIB:.2g}" for name, size in parts.items())
    limit, space = resource.getrlimit(resource.RLIMIT_AS)[0], need + RESERVED_BYTES + CORE_BYTES * (os.cpu_count() or 1)
    if limit != resource.RLIM_INFINITY and limit < space:
        raise MachineError(
            f"the address space is limited to {limit / GIB:.2g} GiB: must be at least {space / GIB:.2g} GiB (memory: "
            f"{listed}; the rest for threads); raise the limit with ulimit -v"
        )
    free = free_bytes()
    warning = "" if need <= free else "; the system may end this run: close other programs, or lower what it keeps"
    return f"memory: about {need / GIB:.2g} GiB ({listed}), {free / GIB:.2g} GiB are free{warning}"


def free_bytes() -> int:
    """Memory that this process can still get: of the machine, or of its control group where that is less."""
    pages = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    known = {line.split(":")[0]: int(line.split()[1]) * 1024 for line in _lines("/proc/meminfo")}
    free = known.get("MemAvailable", pages)
    group = Path("/sys/fs/cgroup")
    limits = [*_lines(group / "memory.max"), *_lines(group / "memory.current")]
    if len(limits) == 2 and limits[0].isdigit():
        free = min(free, int(limits[0]) - int(limits[1]))
    return free


def _lines(path: str | Path) -> list[str]:
    path = Path(path)
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []
