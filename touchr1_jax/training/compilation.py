"""A disk cache of compiled programs, and quick compilation of programs that run only a few times."""

import contextlib
import ctypes
import gc
import hashlib
import os
import platform
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.compilation_cache import compilation_cache

WORTH_KEEPING_S = 0.1
"""Compilations that take less are done again: reading them back would cost about as much."""

MOST_BYTES = 4 * 2**30
"""Size of the cache; what was not used for longest goes.  Only with a bound does JAX lock the entries it writes."""

OLDER_LOOPS = "--xla_cpu_use_fusion_emitters=false" if jax.__version_info__ < (0, 11) else ""
"""Flag of XLA: the older of its two code generators for a fused loop, as long as it exists, compiles twice as fast."""

FLAGS = "XLA_FLAGS"
"""Environment variable that XLA reads when it compiles its first program, and never again."""


MAPPINGS, MAPPINGS_LIMIT = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
MAPPINGS_SHARE = 0.5
"""Share of the mappings from which on programs are dropped before a stage: what is left is enough for any stage."""


@contextlib.contextmanager
def compilations_kept(directory: Path, least_s: float = WORTH_KEEPING_S) -> Iterator[None]:
    """Inside the block, let XLA cache programs that took `least_s` or longer to compile in a directory.

    The key of a program is its code, its shapes and the versions of the compiler.  Each kind of processor has its own
    folder, because its instructions may differ, so all machines can share the directory.  A cache that is already set,
    for example by `JAX_COMPILATION_CACHE_DIR`, stays in use.

    A half-written entry of a killed process is removed first, because JAX would refuse to write other entries.  Entries
    are compressed by zlib, whose checksum names a flipped bit: where zstandard is installed JAX takes it without one.
    The folder's name says so, for JAX may give an entry of either the same key.
    """
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        yield
        return
    folder = directory / f"{processor()}-zlib"
    folder.mkdir(parents=True, exist_ok=True)
    remove_half_written(folder)
    settings = {
        "jax_compilation_cache_dir": str(folder),
        "jax_compilation_cache_max_size": MOST_BYTES,
        "jax_persistent_cache_min_compile_time_secs": least_s,
    }
    before = {name: jax.config.values[name] for name in settings}
    own = compilation_cache.reset_cache.__globals__  # of the module that compresses, which has no public name
    without_sums: dict[str, Any] = {name: own[name] for name in ("zstd", "zstandard") if name in own}
    own.update(dict.fromkeys(without_sums))
    _set(settings)
    try:
        yield
    finally:
        own.update(without_sums)
        _set(before)


@contextlib.contextmanager
def compiled_quickly() -> Iterator[None]:
    """Leave out most of XLA's optimisations inside the block: a training step compiles in a quarter of the time.

    This pays only for programs that run a few times.  They compute the same up to rounding; their speed says nothing
    about that of other programs.  If the first program of a process is compiled inside the block, the process keeps
    the older loops.
    """
    flags, before = os.environ.get(FLAGS), jax.config.values["jax_disable_most_optimizations"]
    if OLDER_LOOPS not in (given := xla_flags()):
        os.environ[FLAGS] = f"{given} {OLDER_LOOPS}".strip()
    jax.config.update("jax_disable_most_optimizations", True)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)
        if flags is None:
            os.environ.pop(FLAGS, None)
        else:
            os.environ[FLAGS] = flags


def xla_flags() -> str:
    """Flags given to XLA: those of the environment variable, or of the file that it names."""
    given = os.environ.get(FLAGS, "").strip()
    named = given and not given.startswith("-") and Path(given).is_file()
    return Path(given).read_text(encoding="utf-8").strip() if named else given


def committed(tree: Any) -> Any:
    """The arrays of a tree, committed to the default device unless they are already committed.

    A compiled function has a program for each pattern of committed arguments.  Arrays of a checkpoint are committed,
    new ones are not, and one committed argument commits all results: a step whose state mixes both would compile again
    when it receives its first results.
    """
    (device,) = jnp.zeros(()).devices()
    place = lambda x: x if isinstance(x, jax.Array) and x.committed else jax.device_put(x, device)
    return jax.tree.map(place, tree)


def remove_half_written(folder: Path) -> int:
    """Remove entries of a cache that lack the time of their last use, which JAX writes last; their number."""
    before, removed = time.time() - 60.0, 0  # younger ones may be in the making
    for entry in folder.glob("*-cache"):
        used = entry.with_name(f"{entry.name.removesuffix('-cache')}-atime")
        with contextlib.suppress(FileNotFoundError):  # another process removed it meanwhile
            if not used.exists() and entry.stat().st_mtime < before:
                entry.unlink()
                removed += 1
    return removed


def return_memory() -> None:
    """Return freed memory to the system: after compilation, the allocator (glibc) keeps half a gigabyte."""
    library = ctypes.CDLL(None)
    if hasattr(library, "malloc_trim"):
        library.malloc_trim(0)


def drop_programs(share: float = MAPPINGS_SHARE) -> bool:
    """Drop all compiled programs, and return True, if the process uses this share of its memory mappings.

    XLA maps each kernel of a program for CPUs, some 2,000 mappings a training step, and beyond the limit of Linux
    (`vm.max_map_count`, by default 65,530) its compiler ends the process.  A dropped program is compiled again
    when it is called, or read from the cache of `compilations_kept`.
    """
    if not MAPPINGS_LIMIT.exists():
        return False
    with MAPPINGS.open("rb") as lines:
        used = sum(1 for _ in lines)
    if used < share * int(MAPPINGS_LIMIT.read_text(encoding="ascii")):
        return False
    jax.clear_caches()
    gc.collect()
    return True


def processor() -> str:
    """Name of this kind of processor: its architecture and a digest of its instruction set."""
    path = Path("/proc/cpuinfo")  # Linux; elsewhere the name that the system gives must do
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    flags = [line for line in lines if line.startswith(("flags", "Features"))]
    kind = flags[0] if flags else platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(kind.encode()).hexdigest()[:8]}"


def _set(settings: Mapping[str, Any]) -> None:
    for name, value in settings.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()  # JAX looks at its settings once
