"""The tutorial, done to the letter in a copy of the sources: its files are written, its commands run."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = ROOT / "experiments" / "TUTORIAL.md"
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

RUN = 'make experiment EXP=brevity ARGS="--scale smoke"'
"""The one step that takes minutes."""

NEW_FILES = {"touchr1_jax/rl/knocking.py", "tests/touchr1_jax/rl/test_knocking.py"}
"""Files that the reader makes without a template."""


@pytest.fixture
def checkout(tmp_path):
    """A copy of what a reader has."""
    skip = shutil.ignore_patterns("data", "figures")
    for package in ("touchr1_jax", "sensors_io", "experiments", "tests"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=skip)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


FORKS = """
import json, os, runpy, sys
import flax.linen, jax, optax, pytest, scipy.stats, tyro
for line in sys.stdin:
    child = os.fork()
    if not child:
        os.dup2(os.open("printed", os.O_CREAT | os.O_TRUNC | os.O_WRONLY), 1)
        os.dup2(1, 2)
        sys.argv = json.loads(line)
        sys.exit(runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True) and 0)
    print(os.waitpid(child, 0)[1], flush=True)
"""
"""Runs one module after the other, each in a fork that has imported already what all of them take seconds to import."""


@pytest.fixture
def run(checkout):
    """Runs a Python module in the copy, whose sources come before the installed ones; what it prints."""
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    with subprocess.Popen(
        [sys.executable, "-c", FORKS], cwd=checkout, env=environment, stdin=-1, stdout=-1, text=True
    ) as process:

        def once(*arguments: str) -> str:
            print(json.dumps(arguments), file=process.stdin, flush=True)
            status, printed = process.stdout.readline(), checkout / "printed"
            assert status == "0\n", printed.read_text()
            return printed.read_text()

        yield once
        process.stdin.close()


def follow(checkout: Path, run: Callable[..., str]) -> list[str]:
    """Do what each block says; the commands that were run."""
    printed, done = "", []
    for kind, body in FENCE.findall(TUTORIAL.read_text(encoding="utf-8")):
        if kind == "python":
            path = body.partition("\n")[0].removeprefix("# ")
            made = path in NEW_FILES or (checkout / path).exists()
            assert made, f"{path} is neither new nor a file that the template made"
            (checkout / path).write_text(body.partition("\n")[2], encoding="utf-8")
        elif kind == "text":
            missing = [line for line in body.splitlines() if line not in printed]
            assert not missing, f"not printed: {missing}\n{printed}"
        elif body.strip() != RUN:
            python, option, *arguments = shlex.split(body)
            assert (python, option) == ("python", "-m")
            printed = run(*arguments)
            done.append(arguments[0])
    return done


@pytest.mark.long
def test_every_step_does_what_it_says(checkout, run):
    assert RUN in TUTORIAL.read_text(encoding="utf-8")
    assert follow(checkout, run) == ["experiments", "pytest", "touchr1_jax.rewards", "experiments", "pytest"]
    (checkout / "proof.py").write_text(
        "from experiments.paper.brevity import ABLATION, EXPERIMENT\nfrom experiments.study.study import check_arms\n"
        "check_arms(ABLATION.arms); print(EXPERIMENT.name)"
    )
    assert run("proof") == "brevity\n"


@pytest.mark.slow
def test_the_template_runs_as_it_stands(checkout, run):
    run("experiments", "new", "answered", "--reward")
    run("pytest", "-q", "tests/touchr1_jax/rewards/test_answered.py", "tests/test_architecture.py")
    assert "report: runs/answered" in run("experiments", "answered", "--scale", "smoke")
    assert "reward_answered" in (checkout / "runs" / "answered" / "latest" / "metrics.jsonl").read_text()
