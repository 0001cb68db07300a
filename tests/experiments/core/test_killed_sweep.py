"""A sweep of eight smoke runs by Ray whose workers and driver are killed ends in the results of one left alone."""

import collections
import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.core import runs
from experiments.core.artifacts import read_json
from tests.experiments.core.noted_sweep import attempts

SWEEP = ("dataset_card", "--scale", "smoke", "--vary", "seed=0,1,2,3,4,5,6,7")
RAY = ("--launcher", "ray", "--launcher.workers", "2")
WORKERS, DRIVERS, SEED = 20, 3, 33
LONGEST_LIFE_S = 5.0
"""Of a unit that is about to be killed; one that is left alone takes longer."""


def begin(folder: Path, *options: str) -> subprocess.Popen:
    words = [*SWEEP, "--into", str(folder), "--cache-dir", str(folder.parent / "cache"), *options]
    command = [sys.executable, "-m", "tests.experiments.core.noted_sweep", *words]
    with (folder.parent / "printed.txt").open("a") as log:
        return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)


def running(folder: Path) -> list[tuple[str, int]]:
    """Units that a live process has begun and not ended."""
    return [(unit, pid) for unit, pid, ended in attempts(folder) if not ended and alive(pid)]


def alive(pid: int) -> bool:
    with contextlib.suppress(FileNotFoundError):
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    return False


def kill_all(folder: Path) -> collections.Counter[str]:
    """Kill workers and drivers in a drawn order at drawn moments, then let the sweep end; unit → its kills."""
    rng, killed = random.Random(SEED), collections.Counter[str]()
    order = ["worker"] * WORKERS + ["driver"] * DRIVERS
    rng.shuffle(order)
    driver = begin(folder, *RAY)
    for victim in order:
        life_s, seen = rng.uniform(0, LONGEST_LIFE_S), collections.Counter[int]()
        while not (old := [x for x in running(folder) if seen[x[1]] * 0.1 >= life_s]):
            assert driver.poll() is None, f"the sweep ended before a {victim} was killed"
            seen.update(pid for _, pid in running(folder))
            time.sleep(0.1)
        if victim == "worker":
            unit, pid = rng.choice(old)
            os.kill(pid, signal.SIGKILL)
            killed[unit] += 1
        else:
            killed.update(unit for unit, _ in running(folder))
            driver.kill()
            driver.wait()
            while running(folder):
                time.sleep(0.1)
            driver = begin(folder, *RAY)
    assert driver.wait() == 0
    return killed


def results(folder: Path) -> dict[str, dict]:
    """Content of `results.json` of each run by its configuration, without its time."""
    found = [read_json(run / "results.json") for run in runs.started(folder / SWEEP[0])]
    return {str(one["config"]): {name: value for name, value in one.items() if name != "timing"} for one in found}


@pytest.mark.slow
def test_twenty_three_kills_change_nothing(tmp_path):
    pytest.importorskip("ray")
    assert begin(tmp_path / "alone").wait() == 0
    killed = kill_all(tmp_path / "killed")
    tried = collections.Counter(unit for unit, _, _ in attempts(tmp_path / "killed"))
    sys.stdout.write(f"attempts {dict(tried)}, kills {dict(killed)}\n")
    assert len(tried) == 8
    assert all(tried[unit] <= killed[unit] + 1 for unit in tried)
    assert results(tmp_path / "killed") == results(tmp_path / "alone")
    assert len(results(tmp_path / "alone")) == 8
