"""The other processes of a run: their settings are compared before anything is compiled, and their ends are noticed.

Process 0 is connected to each of the others.  The system closes a connection when one of its processes dies; the other
one then reports it in one line and ends.  JAX itself would wait for a dead process, or abort with a stack of C++ where
the dead one served the coordination.  So this service runs in a process of its own, which outlives process 0.
"""

import atexit
import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
from jax._src import distributed  # the key-value store of the coordination service has no public name
from jax._src.lib import _jax

KEYS = "touchr1"
"""Begins all names in the key-value store."""

STDERR = 2
"""Its descriptor: another thread may be inside a print."""

MOST_NAMED = 5
"""Differences that a message lists."""

COMPARE_S = 60.0
"""Longest wait for the settings of another process, which may still import."""

GRACE_S = 5.0
"""Time for this process to meet and report the error that ended another one."""

END_S = 15.0
"""Time for a process to end by itself after its error."""

ERROR_WAIT_S = 2.0
"""Time after an error in which the end of another process, which may be its cause, is noticed."""

WELL, FAILED = b".", b"!"
"""Last word of a process: it came to its end, or it ends early."""

_SERVICE = """
import json, sys, time
from jaxlib import _jax
arguments, options = json.loads(sys.argv[1])
service = _jax.get_distributed_runtime_service(*arguments, **options)
print("ready", flush=True)
if sys.stdin.read(1):
    service.shutdown()
else:
    time.sleep(float(sys.argv[2]))
"""
"""Serves until its input says to shut down, or ends: then the other processes have some time to notice that."""


class DifferentProcessesError(RuntimeError):
    """Processes of one run with different configurations, code, versions or settings."""


class _Service:
    """The coordination service in a process of its own, in the place of JAX's."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        order = [sys.executable, "-c", _SERVICE, json.dumps([arguments, options]), str(3 * GRACE_S)]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen(order, text=True, start_new_session=True, **pipes)
        if self._process.stdout.readline() != "ready\n":  # type: ignore[union-attr]
            raise ValueError(f"no process can listen at {arguments[0]}; choose a free port")

    def shutdown(self) -> None:
        self._process.communicate("x")


@contextlib.contextmanager
def coordination_apart() -> Iterator[None]:
    """Let `jax.distributed.initialize` start the coordination service in a process of its own, inside the block."""
    before = _jax.get_distributed_runtime_service
    _jax.get_distributed_runtime_service = _Service
    try:
        yield
    finally:
        _jax.get_distributed_runtime_service = before


class Companions:
    """The connections of this process to the others of its run, each with a thread that waits for its end.

    Args:
      count, index: number of processes, and of this one.
      fate: where the run is and how to continue it, for the last line of a process that lost another.
    """

    def __init__(self, count: int, index: int, fate: Callable[[], str]) -> None:
        self._index, self._fate, self._left, self._alone = index, fate, False, False
        self._connections = _connect(count, index)
        pairs = self._connections.items()
        self._threads = [threading.Thread(target=self._watch, args=pair, daemon=True) for pair in pairs]
        for thread in self._threads:
            thread.start()

    def leave(self, word: bytes) -> None:
        """Say the last word to the others and wait for theirs; after an error, end within `END_S` of it.

        Threads of this process may wait for the others for ever, as in a checkpoint's barrier.
        """
        self._left = True
        for connection in self._connections.values():
            with contextlib.suppress(OSError):  # it ended: its thread knows
                connection.sendall(word)
        for thread in self._threads:
            thread.join()
        if word == FAILED:
            end = threading.Timer(END_S, os._exit, (1,))
            end.daemon = True
            end.start()
        if self._alone:
            atexit.register(os._exit, 1)  # before JAX, which would wait for the process that is gone

    def _watch(self, other: int, connection: socket.socket) -> None:
        word = b""
        with contextlib.suppress(OSError):
            word = connection.recv(1)
        until = time.monotonic() + GRACE_S
        while word == FAILED and not self._left and time.monotonic() < until:
            time.sleep(0.05)
        if word == WELL or (word == FAILED and self._left):
            return
        if self._left:
            self._alone = True
            return
        ended = f"Process {other} of this run ended early, so process {self._index} ends too. {self._fate()}"
        os.write(STDERR, f"{ended}\n".encode())
        os._exit(1)


@contextlib.contextmanager
def watched(count: int, index: int, about: Mapping[str, Any], fate: Callable[[], str]) -> Iterator[None]:
    """End this process, inside the block, when another one of its run ends early; compare them all first.

    Args:
      count, index, fate: as in `Companions`.
      about: what all processes must have in common, in JSON's types.

    Raises:
      DifferentProcessesError: another process has something else.
    """
    if count == 1:
        yield
        return
    _compare(count, index, about)
    companions = Companions(count, index, fate)
    try:
        yield
    except BaseException:
        time.sleep(ERROR_WAIT_S)
        companions.leave(FAILED)
        raise
    companions.leave(WELL)


def different(here: Any, there: Any, name: str = "") -> list[str]:
    """Differences between two values in JSON's types, each as "NAME is A here and B there"."""
    if isinstance(here, Mapping) and isinstance(there, Mapping):
        keys = sorted(here.keys() | there.keys())
        return [line for k in keys for line in different(here.get(k), there.get(k), f"{name}.{k}".lstrip("."))]
    return [] if here == there else [f"{name} is {here!r} here and {there!r} there"]


def _compare(count: int, index: int, about: Mapping[str, Any]) -> None:
    client: Any = distributed.global_state.client
    with _answer_expected(f"process {index}"):
        client.key_value_set(f"{KEYS}/about/{index}", json.dumps(about))
    for other in range(count):
        with _answer_expected(f"process {other}"):
            found = json.loads(client.blocking_key_value_get(f"{KEYS}/about/{other}", round(1000 * COMPARE_S)))
        lines = different(about, found)
        if lines:
            more = f" and {len(lines) - MOST_NAMED} more" if len(lines) > MOST_NAMED else ""
            raise DifferentProcessesError(
                f"processes {index} and {other} differ: {'; '.join(lines[:MOST_NAMED])}{more}; start all processes "
                "with the same command, code, versions and settings"
            )


@contextlib.contextmanager
def _answer_expected(who: str) -> Iterator[None]:
    """Say in one line that a process, inside the block, does not answer: it ended after it had joined the run.

    Raises:
      ConnectionError: the coordination service or a connection reports an error, or nothing for `COMPARE_S`.
    """
    try:
        yield
    except (jax.errors.JaxRuntimeError, OSError) as error:
        raise ConnectionError(
            f"{who} joined the run and did not answer for up to {COMPARE_S:g} s ({str(error).splitlines()[0]}): read "
            "what it says in the end, then start all processes again"
        ) from error


def _connect(count: int, index: int) -> dict[int, socket.socket]:
    """Connections by the number of the other process: process 0 has one to each, the others one to process 0."""
    client: Any = distributed.global_state.client
    host = str(distributed.global_state.coordinator_address).rpartition(":")[0].strip("[]")
    with _answer_expected("process 0" if index else "one of the processes"):
        if index:
            port = int(client.blocking_key_value_get(f"{KEYS}/port", round(1000 * COMPARE_S)))
            found = {0: socket.create_connection((host, port), COMPARE_S)}
            found[0].sendall(index.to_bytes(4, "big"))
        else:
            with socket.create_server(("", 0), backlog=count) as server:
                server.settimeout(COMPARE_S)
                client.key_value_set(f"{KEYS}/port", str(server.getsockname()[1]))
                found = dict(_accepted(server) for _ in range(count - 1))
        for connection in found.values():
            connection.settimeout(None)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # a machine may lose its power
    return found


def _accepted(server: socket.socket) -> tuple[int, socket.socket]:
    connection, _ = server.accept()
    connection.settimeout(COMPARE_S)
    index = connection.recv(4, socket.MSG_WAITALL)
    if len(index) < 4:
        raise ConnectionError("closed at once")
    return int.from_bytes(index, "big"), connection
