"""What all tests share: shape checking, patience with a busy machine, quick compilation and its programs."""

import contextlib
import gc
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jax
import pytest

from tests.typecheck import install

install("touchr1_jax")

# both judge by the clock, which a shared machine falsifies
hypothesis.settings.register_profile("shared", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow])
hypothesis.settings.load_profile("shared")

PROGRAMS = "TOUCHR1_TEST_PROGRAMS"
"""Environment variable that tells the workers of a session where the session keeps its compiled programs."""

WORTH_KEEPING_S = 0.2
"""Compilations that take less are done again: under the lock of a folder of many, reading costs as much."""

MOST_BYTES = 16 * 2**30
"""Never reached; without a limit JAX takes no lock, and a worker could read what another has half written."""

LEAN = (
    "--xla_cpu_parallel_codegen_split_count=1 "
    "--xla_disable_hlo_passes=while-loop-invariant-code-motion,simplify-while-loops,while-loop-constant-sinking"
)
"""Flags of XLA: one piece of code for the one core of a worker, and no search for what its few rounds might share."""

MOST_RESIDENT_BYTES = 2 * 2**30
"""Above this a worker drops its programs; kept to the end they would fill 5 GB."""

MOST_MAPPED = 30_000
"""So are they above so many mapped sections, of which Linux allows a process 65,530; a program has some hundred."""

MADE_BETWEEN_WALKS = 20_000
"""Objects; at Python's 700 the collector walks the traces of a file a dozen times and finds little."""


def pytest_configure(config: pytest.Config) -> None:
    """Keep compiled programs for the length of the session, for its files and workers to share, and compile quickly.

    Most of XLA's optimisations are left out: they take longer here than all the arithmetic.  A worker's products of
    matrices keep to one thread: each has a core, and threads that wait for that of another take eight times as long.
    """
    from touchr1_jax.training.compilation import FLAGS, compiled_quickly  # after `install`, which checks its imports

    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if LEAN not in os.environ.get(FLAGS, ""):  # else this is a worker, with the environment of its session
        os.environ[FLAGS] = f"{os.environ.get(FLAGS, '')} {LEAN}".strip()
    quick = contextlib.ExitStack()
    quick.enter_context(compiled_quickly())
    config.add_cleanup(quick.close)
    if PROGRAMS not in os.environ:  # else this is a worker of a session that has its folder
        folder = tempfile.TemporaryDirectory(prefix="touchr1-programs-")
        config.add_cleanup(folder.cleanup)
        config.add_cleanup(lambda: os.environ.pop(PROGRAMS))
        os.environ[PROGRAMS] = folder.name
    jax.config.update("jax_compilation_cache_dir", os.environ[PROGRAMS])
    jax.config.update("jax_compilation_cache_max_size", MOST_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", WORTH_KEEPING_S)


def pytest_collection_finish() -> None:
    """Spare the garbage collector what lives long: modules and tests, to the end; traces, to the end of their file."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(MADE_BETWEEN_WALKS)


def programs_fill_memory() -> bool:
    """True once this process holds too much memory or too many mapped sections, and on systems that do not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        mapped = Path("/proc/self/maps").read_bytes().count(b"\n")
    except FileNotFoundError:
        return True
    return pages * os.sysconf("SC_PAGE_SIZE") > MOST_RESIDENT_BYTES or mapped > MOST_MAPPED


@pytest.fixture(scope="module", autouse=True)
def forget_programs() -> Iterator[None]:
    """Drop compiled programs after a file once they fill the memory; until then, small ones serve other files too."""
    from touchr1_jax.training.compilation import return_memory

    yield
    if programs_fill_memory():
        jax.clear_caches()
        return_memory()
