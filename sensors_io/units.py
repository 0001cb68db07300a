"""Work as units that are each done once, and the engines that run them: this machine, Ray, or Slurm by submitit.

A unit is named by the hash of what it computes, takes its randomness from there, and writes its result in one step, so
that it does not matter where, when and together with what it runs.  Whoever lists the units asks which are done and
has the others run; a driver that was killed is started again with the same command.
"""

import concurrent.futures
import contextlib
import dataclasses
import functools
import hashlib
import importlib
import importlib.metadata
import itertools
import multiprocessing
import os
import pathlib
import platform
import shutil
import signal
import socket
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from typing import Annotated, Any, Literal

import tyro

from sensors_io.errors import UserError

AGAIN = 8  # times that a unit is run again after its worker died: one that needs more memory than there is must end
POLL_S = 0.02
_PACKAGES = ("jax", "jaxlib", "numpy", "flax", "optax", "grain", "array-record")


class LauncherError(UserError):
    """An engine that is not there, or workers that differ from the driver; the message says the fix."""


class UnitsError(UserError):
    """Units that failed; the message names the first, and that the others stay."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorkUnit:
    """Some work with a result under a name of its own.

    Attributes:
      name: of the result: a hash of everything that decides it.
      run: makes the result and puts it in its place in one step; pickled to workers.
      done: True if the result is there.
    """

    name: str
    run: Callable[[], object]
    done: Callable[[], bool]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Launcher:
    """Where units run."""

    engine: Annotated[
        Literal["local", "ray", "slurm"], tyro.conf.arg(name="launcher", prefix_name=False, help="Runs the units.")
    ] = "local"
    workers: Annotated[int, tyro.conf.arg(name="launcher.workers", prefix_name=False)] = 1
    """Processes; of an existing Ray cluster, all of its cores."""
    address: Annotated[str, tyro.conf.arg(name="launcher.address", prefix_name=False)] = ""
    """Of a Ray cluster, `auto` for the one on this machine; without it one is started here."""
    partition: Annotated[str, tyro.conf.arg(name="launcher.partition", prefix_name=False)] = ""
    """Of Slurm, `local` for submitit's own processes on this machine."""

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise LauncherError(f"launcher.workers is {self.workers}: must be ≥ 1; raise it")
        for name, engine in (("address", "ray"), ("partition", "slurm")):
            if getattr(self, name) and self.engine != engine:
                raise LauncherError(f"launcher.{name} is of {engine}: leave it out, or set --launcher {engine}")

    @property
    def here(self) -> bool:
        """True if units run in this process, one after the other."""
        return self.engine == "local" and self.workers == 1


HERE = Launcher()  # this process


def finish(units: Sequence[WorkUnit], launcher: Launcher, say: Callable[[str], object] = print) -> Iterator[WorkUnit]:
    """Have the units run that are not done, and yield each of them as soon as it is.

    Args:
      units: the work.
      launcher: where it runs.
      say: gets a line for each unit that is run again.

    Raises:
      LauncherError: before anything is computed.
      UnitsError: after all the others are done.
      Exception: of a unit that this process runs itself, at once.
    """
    done = [unit.done() for unit in units]
    yield from itertools.compress(units, done)
    missing = [unit for unit, there in zip(units, done, strict=True) if not there]
    if launcher.here:
        for unit in missing:
            unit.run()
            yield unit
    elif missing:
        yield from _run(missing, launcher, say)


def _run(units: Sequence[WorkUnit], launcher: Launcher, say: Callable[[str], object]) -> Iterator[WorkUnit]:
    size = -(-len(units) // launcher.workers) if launcher.engine == "slurm" else 1  # a job compiles once for its share
    groups = [tuple(units[i : i + size]) for i in range(0, len(units), size)]
    failed, before = dict[str, str](), signal.getsignal(signal.SIGTERM)
    with contextlib.ExitStack() as ended:
        ended.callback(signal.signal, signal.SIGTERM, before)
        died, submit, close = _ENGINES[launcher.engine](launcher)  # Ray takes the signal
        ended.callback(close)
        signal.signal(signal.SIGTERM, signal.default_int_handler if before is signal.SIG_DFL else before)
        pending = {future: (group, 0) for future, group in zip(submit(groups), groups, strict=True)}
        while pending:
            for future in [future for future in pending if future.done()]:
                group, deaths = pending.pop(future)
                error = future.exception()
                wrong = {u.name: _line(error) for u in group if not u.done()} if error else future.result()
                yield from (unit for unit in group if unit.name not in wrong)
                left = tuple(unit for unit in group if unit.name in wrong)
                if left and isinstance(error, died) and deaths < AGAIN:
                    say(f"{left[0].name}: its worker died; {len(left)} of {len(group)} units are run again")
                    pending[submit([left])[0]] = left, deaths + 1
                else:
                    failed |= wrong
            time.sleep(POLL_S)
    if failed:
        name, why = next(iter(failed.items()))
        counts = f"{len(failed)} of {len(units)} units failed, the first {name}: {why}"
        raise UnitsError(f"{counts}; the others stay: mend it and run the same command again")


_Engine = tuple[tuple[type[BaseException], ...], Callable[[Sequence[Any]], list[Any]], Callable[[], object]]
"""Errors of a worker that died, the function that submits groups of units, and the one that ends the engine."""


def _local(launcher: Launcher) -> _Engine:
    """A process for each of some threads, so that one that dies ends no other.

    Each process has cores of its own, where the system lets it choose, so that its threads wait for no other's.
    """
    pools, numbers = threading.local(), itertools.count()
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []

    def choose_cores() -> None:
        pools.cores = cores[next(numbers) % max(1, len(cores)) :: launcher.workers]

    threads = concurrent.futures.ThreadPoolExecutor(launcher.workers, initializer=choose_cores)
    context = multiprocessing.get_context("spawn")
    made: list[concurrent.futures.ProcessPoolExecutor] = []

    def call(group: tuple[WorkUnit, ...]) -> dict[str, str]:
        if not hasattr(pools, "mine"):
            pools.mine = concurrent.futures.ProcessPoolExecutor(1, context, _begin, (pools.cores,))
            made.append(pools.mine)
        try:
            return pools.mine.submit(_work, group, None, os.getcwd()).result()
        except BrokenProcessPool:
            del pools.mine
            raise

    def close() -> None:
        threads.shutdown(wait=False, cancel_futures=True)
        while True:  # a worker may be starting while the driver is asked to end
            running = any(thread.is_alive() for thread in threads._threads)
            for process in itertools.chain(*(list((pool._processes or {}).values()) for pool in list(made))):
                process.terminate()
            if not running:
                return
            time.sleep(POLL_S)

    return (BrokenProcessPool,), lambda groups: [threads.submit(call, group) for group in groups], close


def _begin(cores: Sequence[int]) -> None:
    """Keep this worker to some cores, and have it end when its driver does, even if that is killed."""
    if cores:
        os.sched_setaffinity(0, cores)
    driver: Any = multiprocessing.parent_process()
    threading.Thread(target=lambda: os._exit(bool(driver.join())), daemon=True).start()


def _ray(launcher: Launcher) -> _Engine:
    """A cluster that is there, or one on this machine; every node is asked first what it has installed."""
    ray = _engine("ray", "ray")
    started = not ray.is_initialized()
    if started:
        host, _, port = launcher.address.rpartition("//")[2].rpartition(":")
        own = {} if launcher.address else {"num_cpus": launcher.workers, "include_dashboard": False}
        try:
            if port:
                socket.create_connection((host, int(port)), timeout=10).close()  # Ray itself tries for minutes
            ray.init(address=launcher.address or "local", log_to_driver=False, logging_level="ERROR", **own)
        except Exception as error:  # a node that does not start raises it bare
            where = f"answers at {launcher.address!r}" if launcher.address else "starts here"
            raise LauncherError(
                f"no Ray cluster {where} ({_line(error)[:200]}): start one by `ray start --head`, with the same "
                "versions, and name it by --launcher.address"
            ) from error
    node = importlib.import_module("ray.util.scheduling_strategies").NodeAffinitySchedulingStrategy
    asked = ray.remote(num_cpus=0, max_retries=0)(check_versions)
    try:
        alive = [one["NodeID"] for one in ray.nodes() if one["Alive"]]
        ray.get([asked.options(scheduling_strategy=node(n, soft=False)).remote(versions()) for n in alive])
    except ray.exceptions.RayError as error:
        cause, last = getattr(error, "cause", None), str(error).strip().splitlines()[-1]
        foreign = f"a worker cannot import this project ({last}): install the same version of it on all machines"
        raise LauncherError(str(cause) if isinstance(cause, LauncherError) else foreign) from error
    died = tuple(getattr(ray.exceptions, name) for name in ("WorkerCrashedError", "NodeDiedError", "OutOfMemoryError"))
    work = ray.remote(num_cpus=1, max_retries=0)(_work)
    where = os.getcwd()
    submit = lambda groups: [work.remote(group, None, where).future() for group in groups]
    return died, submit, ray.shutdown if started else lambda: None


def _slurm(launcher: Launcher) -> _Engine:
    """A job array; `local` is submitit's executor of processes."""
    submitit = _engine("submitit", "slurm")
    here = launcher.partition == "local"
    if not here and shutil.which("sbatch") is None:
        fix = "run this on its login node, or set --launcher local"
        raise LauncherError(f"no Slurm cluster is here (sbatch is not found): {fix}")
    executor = submitit.AutoExecutor(folder=pathlib.Path(".submitit").absolute(), cluster="local" if here else "slurm")
    partition = {"slurm_partition": launcher.partition} if launcher.partition else {}
    own = {} if here else {"slurm_array_parallelism": launcher.workers, **partition}
    executor.update_parameters(name="touchr1", timeout_min=24 * 60, **own)
    work = functools.partial(_work, expected=versions(), where=os.getcwd())
    died = submitit.core.utils.UncompletedJobError
    return (died,), lambda groups: executor.map_array(work, groups), lambda: None


_ENGINES: Mapping[str, Callable[[Launcher], _Engine]] = {"local": _local, "ray": _ray, "slurm": _slurm}


def _work(group: Sequence[WorkUnit], expected: Mapping[str, str] | None, where: str) -> dict[str, str]:
    """Run what is not done of some units, in a worker; name → error of those that failed."""
    failed = dict[str, str]()
    try:
        check_versions(expected or versions())
    except LauncherError as error:
        return {unit.name: _line(error) for unit in group}
    os.chdir(where)  # relative paths are the driver's
    for unit in group:
        try:
            if not unit.done():
                unit.run()
        except Exception as error:
            traceback.print_exc()  # in the worker's log; the driver names the error
            failed[unit.name] = _line(error)
    return failed


def _line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _engine(package: str, extra: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError as error:
        fix = f"pip install 'touchr1-jax[{extra}]'"
        raise LauncherError(f"--launcher {extra} needs {package}, which is not installed: {fix}") from error


@functools.cache
def versions() -> Mapping[str, str]:
    """Versions that decide the bits of a result: Python, the packages, and a hash of this project's sources."""
    found = {"python": platform.python_version()}
    found |= {name: importlib.metadata.version(name) for name in _PACKAGES}
    root, sum_ = pathlib.Path(__file__).parent.parent, hashlib.sha256()
    for package in ("touchr1_jax", "sensors_io", "experiments"):
        for path in sorted((root / package).rglob("*.py")):
            sum_.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return {**found, "touchr1-jax": sum_.hexdigest()[:12]}


def check_versions(expected: Mapping[str, str]) -> None:
    """Compare this worker with the driver; `LauncherError` names a version that differs."""
    for name, version in versions().items():
        if version != expected.get(name):
            differs = f"worker {socket.gethostname()} has {name} {version}, the driver {expected.get(name)}"
            raise LauncherError(f"{differs}: results would differ; install the same versions on all machines")
