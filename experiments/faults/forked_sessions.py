"""Sessions of an experiment in processes of their own, which a signal can end at any moment.

Processes are forked from a server that has imported everything and computed nothing, so that a session costs what its
work costs; `kill -9` ends it as it would any other.
"""

import multiprocessing
import os
import sys
from multiprocessing.process import BaseProcess
from pathlib import Path

import jax

from experiments.core.runner import main
from experiments.faults.trainings import PACKAGE

QUICKLY = "--xla_cpu_use_fusion_emitters=false" if jax.__version_info__ < (0, 11) else ""
"""Flag of XLA: the older of its two ways to write a loop compiles twice as fast."""

PROGRAMS_BYTES = 2**30
"""Never reached; but without a bound JAX takes no lock on what it writes."""

_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload([f"{PACKAGE}.{name}" for name in ("small_study", "small_grpo", "counting")])


def start(arguments: list[str], log: Path, programs: Path) -> BaseProcess:
    """Begin a session of an experiment of this package.

    Args:
      arguments: the command line after the program's name.
      log: file that what it prints is added to.
      programs: folder of compiled programs.
    """
    process = _SERVER.Process(target=_session, args=(arguments, str(log), str(programs)), daemon=True)
    process.start()
    return process


def _session(arguments: list[str], log: str, programs: str) -> None:
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    for stream in (sys.stdout.fileno(), sys.stderr.fileno()):
        os.dup2(file, stream)
    _compile_little(programs)
    sys.exit(main(arguments, package=PACKAGE))


def _compile_little(programs: str) -> None:
    """Keep every program, however small, and let XLA leave its optimisations out: sessions are short."""
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICKLY}".strip()  # read with the first program
    jax.config.update("jax_disable_most_optimizations", True)
    jax.config.update("jax_compilation_cache_dir", programs)
    jax.config.update("jax_compilation_cache_max_size", PROGRAMS_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
