"""The tutorial, done to the letter in a copy of the sources: its files are written, its commands run."""

import os
import re
import shlex
import shutil
import subprocess
import sys
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
    skip = shutil.ignore_patterns("__pycache__", "data", "figures")
    for package in ("touchr1_jax", "sensors_io", "experiments", "tests"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=skip)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def run(checkout: Path, *arguments: str) -> str:
    """What a Python command prints in the copy, whose sources come before the installed ones."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def follow(checkout: Path, commands_left_out: tuple[str, ...]) -> list[str]:
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
        elif body.strip() not in commands_left_out:
            program, *arguments = shlex.split(body)
            assert program == "python"
            printed = run(checkout, *arguments)
            done.append(arguments[1])
    return done


def test_every_step_does_what_it_says(checkout):
    assert RUN in TUTORIAL.read_text(encoding="utf-8")
    assert follow(checkout, (RUN,)) == ["experiments", "pytest", "touchr1_jax.rewards", "experiments", "pytest"]
    proof = (
        "from experiments.paper.brevity import ABLATION, EXPERIMENT as E; from experiments.study import study as s; "
    )
    assert run(checkout, "-c", proof + "s.check_arms(ABLATION.arms); print(E.name)") == "brevity\n"


@pytest.mark.slow
def test_the_template_runs_as_it_stands(checkout):
    run(checkout, "-m", "experiments", "new", "answered", "--reward")
    run(checkout, "-m", "pytest", "-q", "tests/touchr1_jax/rewards/test_answered.py", "tests/test_architecture.py")
    out = run(checkout, "-m", "experiments", "answered", "--scale", "smoke")
    assert "report: runs/answered" in out
    assert "reward_answered" in (checkout / "runs" / "answered" / "latest" / "metrics.jsonl").read_text()
    assert "finished" in run(checkout, "-m", "experiments", "list", "answered")
