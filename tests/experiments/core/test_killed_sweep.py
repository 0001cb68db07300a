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

SWEEPS = {
    "audits a data set": ("dataset_card", "seed=0,1,2,3,4,5,6,7", 5.0),
    "trains an encoder": ("pretrain_encoder", "pretrain.optimizer.lr-scale=20,30,50,70,100,150,200,300", 15.0),
}
"""Experiment, what varies, and the longest life of a unit that is killed, s; one that is left alone takes longer."""
RAY = ("--launcher", "ray", "--launcher.workers", "2")
WORKERS, DRIVERS, SEED = 20, 3, 33


def begin(name: str, varied: str, folder: Path, *options: str) -> subprocess.Popen:
    cache = folder.parent / f"cache of {folder.name}"
    words = [name, "--scale", "smoke", "--vary", varied, "--into", str(folder), "--cache-dir", str(cache), *options]
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


def kill_all(name: str, varied: str, longest_life_s: float, folder: Path) -> collections.Counter[str]:
    """Kill workers and drivers in a drawn order at drawn moments, then let the sweep end; unit → its kills."""
    rng, killed = random.Random(SEED), collections.Counter[str]()
    order = ["worker"] * WORKERS + ["driver"] * DRIVERS
    rng.shuffle(order)
    driver = begin(name, varied, folder, *RAY)
    for victim in order:
        life_s, seen = rng.uniform(0, longest_life_s), collections.Counter[int]()
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
            driver = begin(name, varied, folder, *RAY)
    assert driver.wait() == 0
    return killed


def results(home: Path) -> dict[str, dict]:
    """Content of `results.json` of each run by its configuration, without its time."""
    found = [read_json(run / "results.json") for run in runs.started(home)]
    return {str(one["config"]): {name: value for name, value in one.items() if name != "timing"} for one in found}


@pytest.mark.slow
@pytest.mark.parametrize("kind", SWEEPS)
def test_twenty_three_kills_change_nothing(kind, tmp_path):
    pytest.importorskip("ray")
    name, varied, longest_life_s = SWEEPS[kind]
    assert begin(name, varied, tmp_path / "alone").wait() == 0
    killed = kill_all(name, varied, longest_life_s, tmp_path / "killed")
    tried = collections.Counter(unit for unit, _, _ in attempts(tmp_path / "killed"))
    sys.stdout.write(f"attempts {dict(tried)}, kills {dict(killed)}\n")
    assert len(tried) == 8
    assert all(tried[unit] <= killed[unit] + 1 for unit in tried)
    alone = results(tmp_path / "alone" / name)
    assert results(tmp_path / "killed" / name) == alone
    assert len(alone) == 8
