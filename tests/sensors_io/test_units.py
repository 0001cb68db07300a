"""Units are each done once by whichever engine: a worker that dies costs its unit a second run, and no other."""

import functools
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from sensors_io import units
from sensors_io.units import Launcher, LauncherError, UnitsError, WorkUnit, check_versions, finish, versions
from tests.sensors_io.checks import refused

ENGINES = {
    "processes": Launcher(workers=2),
    "ray": Launcher(engine="ray", workers=2),
    "submitit": Launcher(engine="slurm", workers=2, partition="local"),
}
NEEDS = {"ray": "ray", "submitit": "submitit"}


def write(folder: pathlib.Path, name: str, ends: str = "") -> None:
    """Note the attempt, then write the result; the first attempt may end as `ends` says."""
    with (folder / f"{name}.attempts").open("a") as file:
        file.write(f"{os.getpid()}\n")
    first = len((folder / f"{name}.attempts").read_text().split()) == 1
    if first and ends in ("SIGKILL", "SIGTERM"):
        os.kill(os.getpid(), signal.Signals[ends])
    if ends == "wait":
        time.sleep(60)
    if ends == "raise":
        raise ValueError(f"{name} cannot be made")
    (folder / f"{name}.tmp").write_text(name)
    (folder / f"{name}.tmp").replace(folder / name)


def listed(folder: pathlib.Path, count: int = 6, **ends: str) -> list[WorkUnit]:
    names = [f"u{i}" for i in range(count)]
    run = lambda name: functools.partial(write, folder, name, ends.get(name, ""))
    return [WorkUnit(name=name, run=run(name), done=(folder / name).exists) for name in names]


def attempts(folder: pathlib.Path) -> dict[str, int]:
    return {path.stem: len(path.read_text().split()) for path in sorted(folder.glob("*.attempts"))}


@pytest.fixture(params=ENGINES)
def launcher(request, tmp_path, monkeypatch):
    if request.param in NEEDS:
        pytest.importorskip(NEEDS[request.param], reason=f"the extra of {request.param} is not installed")
    monkeypatch.chdir(tmp_path)
    return ENGINES[request.param]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "made").mkdir()
    return tmp_path / "made"


def write_cores(path: pathlib.Path) -> None:
    """The cores of this worker."""
    path.write_text(" ".join(map(str, os.sched_getaffinity(0))))


@pytest.mark.skipif(len(getattr(os, "sched_getaffinity", lambda _: ())(0)) < 2, reason="one core, or no affinity here")
def test_a_worker_process_keeps_to_a_part_of_the_cores(tmp_path):
    paths = [tmp_path / str(i) for i in range(4)]
    work = [WorkUnit(name=p.name, run=functools.partial(write_cores, p), done=p.exists) for p in paths]
    assert len(list(finish(work, ENGINES["processes"]))) == 4
    parts = {frozenset(map(int, p.read_text().split())) for p in paths}
    every = os.sched_getaffinity(0)
    assert all(part and part < every for part in parts)
    assert sum(map(len, parts)) == len(frozenset().union(*parts))


def test_every_unit_is_run_once_and_none_that_is_done(folder):
    (folder / "u2").write_text("made before")
    said = []
    assert {unit.name for unit in finish(listed(folder), Launcher(), said.append)} == {f"u{i}" for i in range(6)}
    assert attempts(folder) == {f"u{i}": 1 for i in (0, 1, 3, 4, 5)}
    assert (folder / "u2").read_text() == "made before"
    assert said == []


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_a_worker_that_dies_costs_its_unit_one_more_run_and_a_unit_that_fails_no_other(launcher, folder):
    """None that is done is run.  submitit goes on after SIGTERM, which Slurm sends with the signal it waits for."""
    (folder / "u2").write_text("made before")
    said, ended, goes_on = [], [], launcher.engine == "slurm"
    work = listed(folder, u1="SIGKILL", u3="raise", u4="SIGTERM")
    with pytest.raises(UnitsError, match=r"^1 of 5 units failed, the first u3: .*u3 cannot be made"):
        ended.extend(unit.name for unit in finish(work, launcher, said.append))
    assert sorted(ended) == ["u0", "u1", "u2", "u4", "u5"] == sorted(path.name for path in folder.glob("u?"))
    assert attempts(folder) == {"u0": 1, "u1": 2, "u3": 1, "u4": 1 if goes_on else 2, "u5": 1}
    assert (folder / "u2").read_text() == "made before"
    assert sorted(line.partition(": its worker died")[0] for line in said) == ["u1"] + ["u4"] * (not goes_on)


@pytest.mark.long
@pytest.mark.parametrize("name", ["SIGTERM", "SIGKILL"])
def test_workers_end_with_their_driver(name, folder):
    """One that was preempted leaves as by Control-C, and the same command goes on."""
    driver = subprocess.Popen([sys.executable, "-m", __spec__.name, str(folder)], stderr=subprocess.PIPE, text=True)
    while not (pids := attempts(folder)):
        time.sleep(0.02)
    driver.send_signal(signal.Signals[name])
    said = driver.communicate()[1]
    assert name == "SIGKILL" or said.splitlines() == ["interrupted: run the same command again to resume"]
    assert driver.returncode == (130 if name == "SIGTERM" else -signal.SIGKILL)
    until = time.monotonic() + 5
    workers = [int(path.read_text()) for path in folder.glob("*.attempts")]
    while any(map(alive, workers)):
        assert time.monotonic() < until
        time.sleep(0.02)
    assert not [name for name in pids if (folder / name).exists()]


def alive(pid: int) -> bool:
    try:
        return "\nState:\tZ" not in pathlib.Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


def test_a_worker_that_dies_each_time_ends(folder, monkeypatch):
    monkeypatch.setattr(units, "AGAIN", 1)
    unit = WorkUnit(name="u", run=functools.partial(os._exit, 9), done=(folder / "u").exists)
    said = []
    with pytest.raises(UnitsError, match="1 of 1 units failed"):
        list(finish([unit], Launcher(workers=2), said.append))
    assert len(said) == 1


@pytest.mark.parametrize(("engine", "package"), [("ray", "ray"), ("slurm", "submitit")])
def test_an_extra_that_is_not_installed_is_named(engine, package, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    message = rf"needs {package}, which is not installed: pip install 'touchr1-jax\[{engine}\]'"
    refused(LauncherError, message, lambda: list(finish(listed(folder), Launcher(engine=engine))))
    assert not attempts(folder)


def test_a_cluster_that_is_not_there_is_named(folder, monkeypatch):
    pytest.importorskip("ray")
    launcher = Launcher(engine="ray", address="127.0.0.1:1")
    refused(
        LauncherError,
        "no Ray cluster answers at '127.0.0.1:1'.*ray start --head",
        lambda: list(finish(listed(folder), launcher)),
    )
    assert not attempts(folder)


def test_slurm_without_a_cluster_is_named(folder, monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setattr(units.shutil, "which", lambda name: None)
    refused(LauncherError, "no Slurm cluster is here", lambda: list(finish(listed(folder), Launcher(engine="slurm"))))


def test_options_that_do_not_belong_together_are_named():
    refused(LauncherError, "launcher.workers is 0: must be ≥ 1", lambda: Launcher(workers=0))
    refused(LauncherError, "launcher.address is of ray", lambda: Launcher(address="auto"))
    refused(LauncherError, "launcher.partition is of slurm", lambda: Launcher(engine="ray", partition="gpu"))


def test_workers_with_other_versions_are_refused():
    check_versions(versions())
    message = "has numpy .*, the driver 1.0: results would differ; install the same versions on all machines"
    refused(LauncherError, message, lambda: check_versions({**versions(), "numpy": "1.0"}))


def test_another_project_on_the_workers_is_refused_before_anything_runs(folder, monkeypatch, tmp_path):
    pytest.importorskip("submitit")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(units, "versions", lambda: {**versions(), "numpy": "1.0"})
    with pytest.raises(UnitsError, match=r"LauncherError: worker .* has numpy"):
        list(finish(listed(folder), Launcher(engine="slurm", workers=2, partition="local")))
    assert not attempts(folder)


if __name__ == "__main__":
    from tests.sensors_io import test_units  # workers import it by this name

    try:
        list(finish(test_units.listed(pathlib.Path(sys.argv[1]), 2, u0="wait", u1="wait"), Launcher(workers=2)))
    except KeyboardInterrupt:
        sys.stderr.write("interrupted: run the same command again to resume\n")
        sys.exit(130)
