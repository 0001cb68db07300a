"""Processes and devices of a run, and the accelerators that it needs.

    python -m experiments NAME --distributed --mesh.fsdp 8                                  Slurm, MPI, Kubernetes
    python -m experiments NAME --distributed --mesh.fsdp 8 --coordinator HOST:PORT --processes N --process I

Every process runs the same program.  Process 0 alone writes files; the others wait where a file decides the next step.
All must see the same run and cache directories, as over a network file system.
"""

import contextlib
import dataclasses
import fcntl
import functools
import glob
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
from jax._src import distributed
from jax.experimental import multihost_utils

from touchr1_jax.distributed.companions import STDERR, DifferentProcessesError, coordination_apart
from touchr1_jax.distributed.mesh import MeshConfig
from touchr1_jax.distributed.placement import DeviceMesh
from touchr1_jax.training.loop import SingleDevice

GIB = 2**30

MOST_PROCESSES, MOST_PORT = 2**20, 2**16 - 1

LOOK_S = 2.0
"""Seconds after which a lock is that of a process of the run, and a file that is not there is not shared."""

SAY_S, WAIT_S = 5.0, 300.0
"""Seconds after which a process says that it waits for the others of its run, and after which it ends."""

MESSAGE_BYTES = 8192
"""Longest value that process 0 can send to the others: twice Linux's longest path."""


class ProcessesNotFoundError(RuntimeError):
    """The other processes of a distributed run cannot be found, or one of them has the number of this one."""


class MachineError(Exception):
    """A machine that has less than a scale needs; the message names both and the fix."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Launch:
    """The processes and devices of a run.  No part of its configuration: it can continue on others.

    Raises:
      ValueError: an incomplete or impossible address, one of a run that is not distributed, a process beyond the last.
    """

    distributed: bool = False
    """Be one of several processes; Slurm, Open MPI or Kubernetes name the others."""
    coordinator: str | None = None
    """HOST:PORT of process 0, where no such system names it."""
    processes: int | None = None
    """Number of processes, where no such system names it."""
    process: int | None = None
    """Number of this process, from 0, where no such system names it."""
    mesh: MeshConfig = MeshConfig()
    """Mesh over the devices of all processes."""

    def __post_init__(self) -> None:
        address = {"coordinator": self.coordinator, "processes": self.processes, "process": self.process}
        missing = [name for name, value in address.items() if value is None]
        if missing and len(missing) < len(address):
            raise ValueError(
                f"{', '.join(missing)} is not given, and {address} are: must be all or none; give all three or none"
            )
        if not missing and not self.distributed:
            raise ValueError(f"coordinator is {self.coordinator}, but the run is not distributed; add --distributed")
        if self.processes is not None and not 0 <= (self.process or 0) < self.processes:
            raise ValueError(f"process is {self.process}: must be 0 … {self.processes - 1}, one of the processes")
        if self.processes is not None and self.processes > MOST_PROCESSES:
            raise ValueError(f"processes is {self.processes}: must be at most {MOST_PROCESSES:,}; lower it")
        if self.coordinator is not None:
            host, _, port = self.coordinator.rpartition(":")
            if not host or not port.isdecimal() or not 1 <= int(port) <= MOST_PORT:  # JAX would wait for minutes
                raise ValueError(
                    f"coordinator is {self.coordinator!r}: must be HOST:PORT, 1 ≤ PORT ≤ {MOST_PORT}; correct it"
                )


@dataclasses.dataclass(frozen=True)
class ProcessGroup:
    """The processes of a run; with a single one JAX is never asked for others."""

    count: int = 1
    index: int = 0

    @property
    def writes(self) -> bool:
        """True in the one process that writes files."""
        return self.index == 0

    def numbered_by_devices(self) -> Self:
        """The same processes in the order of their devices, in which JAX gathers; on TPUs it may be another one."""
        return self if self.count == 1 else type(self)(jax.process_count(), jax.process_index())

    def write_once(self, write: Callable[[], object]) -> None:
        """Let process 0 write files, between two barriers; all processes must make the same calls.

        Before the call every process sees the old files, after it every process sees the new ones.
        """
        self._barrier()
        if self.writes:
            write()
        self._barrier()

    def broadcast(self, choose: Callable[[], Any]) -> Any:
        """Return in all processes the small JSON value that `choose` returns in process 0."""
        if self.count == 1:
            return choose()
        letters = np.zeros(MESSAGE_BYTES, np.uint8)
        if self.writes:
            chosen = json.dumps(choose()).encode()
            letters[: len(chosen)] = np.frombuffer(chosen, np.uint8)
        return json.loads(bytes(multihost_utils.broadcast_one_to_all(letters)).rstrip(b"\0"))

    def any(self, here: bool) -> bool:
        """True if it is true in any process; with several it waits for their computations."""
        return here if self.count == 1 else bool(np.any(multihost_utils.process_allgather(np.array(here))))

    def split_work(self, rows: np.ndarray, make: Callable[[np.ndarray], Any]) -> Any:
        """Return make(rows); each process computes a part.

        Args:
          rows: one entry for each piece of work; parts are contiguous, the last one padded with the last row.
          make: from some rows to a tree of host arrays with one entry a row.
        """
        if self.count == 1:
            return make(rows)
        size = -(-len(rows) // self.count)
        mine = np.minimum(np.arange(size) + self.index * size, len(rows) - 1)
        made = multihost_utils.process_allgather(make(rows[mine]), tiled=True)
        return jax.tree.map(lambda x: x[: len(rows)], made)

    def _barrier(self) -> None:
        if self.count > 1:
            multihost_utils.sync_global_devices("experiments")


SINGLE_PROCESS = ProcessGroup()


@contextlib.contextmanager
def _announced(launch: Launch, say_s: float, wait_s: float) -> Iterator[None]:
    """Say what the block waits for, and in the end that it waits no longer: JAX aborts with a stack of C++ instead.

    Signals end the process at once, since their handlers would run after the block.
    """
    at = f"at {launch.coordinator}" if launch.coordinator else "that the cluster names"
    me = "this process" if launch.process is None else f"process {launch.process} of {launch.processes}"

    def end() -> None:
        say(
            f"{ProcessesNotFoundError.__name__}: {me} did not find the other processes {at} within {wait_s:g} s: start "
            "all of them with the same command and numbers from 0 on, and let them reach this address"
        )
        os._exit(1)  # the thread that waits is inside JAX

    waits = f"{me} waits for the other processes of the run {at}, for at most {wait_s:g} s"
    timers = [threading.Timer(say_s, say, (waits,)), threading.Timer(wait_s, end)]
    handlers = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    heard = {n: signal.signal(n, signal.SIG_DFL) for n, handler in handlers.items() if callable(handler)}
    for timer in timers:
        timer.daemon = True
        timer.start()
    try:
        yield
    finally:
        for n, handler in heard.items():
            signal.signal(n, handler)
        for timer in timers:
            timer.cancel()


def say(text: str) -> None:
    """Write a line to standard error, at once: another thread may be inside a print."""
    with contextlib.suppress(OSError):
        os.write(STDERR, f"{text}\n".encode())


def join_processes(
    launch: Launch, folder: Path | None = None, say_s: float = SAY_S, wait_s: float = WAIT_S
) -> ProcessGroup:
    """Join the processes of a run; must come before any computation.

    After `say_s` seconds standard error names what is waited for; after `wait_s` the process ends with status 1.

    Args:
      folder: shared by all processes; there each locks its number, where the launch gives one.

    Raises:
      ProcessesNotFoundError: a distributed run without an address, and no cluster that JAX knows to name one; another
        process has this one's number.
    """
    if not launch.distributed:
        return SINGLE_PROCESS
    if folder is not None and launch.coordinator is not None:
        _lock_number(launch, folder)
    try:
        with coordination_apart(), _announced(launch, say_s, wait_s):
            later = round(2 * wait_s)
            address = launch.coordinator, launch.processes, launch.process
            jax.distributed.initialize(*address, initialization_timeout=later)
    except (ValueError, jax.errors.JaxRuntimeError) as error:
        raise ProcessesNotFoundError(
            f"--distributed finds no other processes ({error}): start them with srun, mpirun or as an indexed "
            "Kubernetes job, or give --coordinator HOST:PORT --processes N --process I in each"
        ) from error
    known = distributed.global_state  # `jax.process_count` would exchange devices, and wait for a process that ended
    return ProcessGroup(known.num_processes, known.process_id)


def require_common_folders(launch: Launch, processes: ProcessGroup, run: Path, cache: Path) -> None:
    """Check that this process sees the run's configuration, and the file of process 0 in the cache; all must call it.

    Raises:
      DifferentProcessesError: it is in another working directory, or on a disk of its own.
    """
    own = None if launch.coordinator is None else _number_file(launch, cache, launch.process).name
    name = processes.broadcast(lambda: own)  # others may have been given its address in another spelling
    for file in (run / "config.json", *([cache / name] if name else [])):
        if not _soon(file.exists):
            raise DifferentProcessesError(
                f"process {processes.index} does not see {file.absolute()}, which process 0 has written: all must "
                "share runs-dir and cache-dir; give whole paths"
            )


def _number_file(launch: Launch, folder: Path, process: int | None) -> Path:
    """File that a process locks; one of another run at the same address stays there, unlocked."""
    return folder / f".process-{process}-of-{launch.coordinator}".replace("/", "_")


def _lock_number(launch: Launch, folder: Path) -> None:
    """Lock the number of a process until it ends, with the number of processes that it was given.

    Where two have one number, or one states fewer processes than there are, JAX aborts with a stack of C++.
    """
    file = _number_file(launch, folder, launch.process)
    number = os.open(file, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC)
    if not _soon(lambda: _locks(number)):
        raise ProcessesNotFoundError(
            f"process is {launch.process}: another process has this number in the run at {launch.coordinator}; give "
            f"each its own, 0 … {(launch.processes or 1) - 1}, or wait for the other to end"
        )
    os.ftruncate(number, 0)
    os.pwrite(number, str(launch.processes).encode(), 0)
    os.fsync(number)  # a network file system else shows others what was there before
    for path in folder.glob(".process-*-of-" + glob.escape(file.name.partition("-of-")[2])):
        if not _soon(functools.partial(_agrees, path, str(launch.processes))):
            raise ProcessesNotFoundError(
                f"processes is {launch.processes}: another process of the run at {launch.coordinator} was given "
                f"{path.read_text(encoding='utf-8')}; give all the same --processes, and each its own --process"
            )


def _soon(found: Callable[[], bool]) -> bool:
    """True once `found` is, in `LOOK_S` at most: others lock a file for a moment, and network disks show one late."""
    until = time.monotonic() + LOOK_S
    while not found():
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def _agrees(path: Path, processes: str) -> bool:
    """False where a process that lives states another number of processes."""
    try:
        with path.open("r+", encoding="utf-8") as other:  # a network file system locks only what may be written
            return other.read() in ("", processes) or _locks(other.fileno())
    except PermissionError:  # of another user
        return True


def _locks(number: int) -> bool:
    """Lock an open file; false where another process has locked it."""
    try:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def select_devices(launch: Launch) -> SingleDevice:
    """Select the devices of a run.

    Raises:
      MachineError: the mesh has another number of devices than the processes.
    """
    if launch.mesh.devices == 1 and not launch.distributed:
        return SingleDevice()
    try:
        return DeviceMesh(launch.mesh.build())
    except ValueError as error:
        raise MachineError(f"{error}: --mesh.data, --mesh.fsdp or --mesh.tensor") from error


@dataclasses.dataclass(frozen=True, kw_only=True)
class Accelerators:
    """Accelerators over all processes, and the memory of each."""

    number: int
    memory_gib: float

    def __str__(self) -> str:
        return f"{self.number} accelerator{'s' if self.number > 1 else ''} of {self.memory_gib:g} GiB"


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
