"""The released package: what the wheel holds, and that it works from an empty folder, away from any checkout."""

import importlib.util
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("touchr1_jax", "sensors_io", "experiments")
ANSWER = "<perceive> xense soft </perceive> <compare> soft </compare> <conclude> soft </conclude>"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("build") is None, reason="needs `pip install build`, and the network"),
]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from a copy, since setuptools leaves files beside the sources."""
    folder = tmp_path_factory.mktemp("sources")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    subprocess.run([sys.executable, "-m", "build", "--wheel", str(folder)], check=True, capture_output=True)
    (path,) = (folder / "dist").glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """The wheel, unpacked as an installer would; what it depends on is that of the tests."""
    folder = tmp_path_factory.mktemp("installed")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder


def run(installed: Path, empty: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command of the installed package, in an empty folder of a user without settings."""
    home = empty.with_name(f"{empty.name}-home")
    environment = {**os.environ, "PYTHONPATH": str(installed), "HOME": str(home), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, cwd=empty, env=environment, capture_output=True, text=True, check=False)


def test_every_source_is_there_and_nothing_else(wheel):
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    shipped = ("*.py", "py.typed", "*.jinja", "policies/*/*")
    paths = [path for package in PACKAGES for pattern in shipped for path in (ROOT / package).rglob(pattern)]
    assert held == {path.relative_to(ROOT).as_posix() for path in paths}


def test_an_experiment_runs_in_an_empty_folder(installed, tmp_path):
    done = run(installed, tmp_path, "experiments", "paper_audit", "--scale", "smoke")
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "runs" / "paper_audit" / "latest" / "report.html").exists()
    assert "paper_audit" in run(installed, tmp_path, "experiments", "list").stdout
    assert (installed / "experiments" / "bench" / "paper_audit.py").exists()


@pytest.mark.parametrize(
    ("arguments", "printed"),
    [
        (("touchr1_jax.rewards", "explain", "--text", ANSWER), "total"),
        (("touchr1_jax.models.load", "--help"), "Read a checkpoint"),
        (("sensors_io", "--help"), "calibrate"),
        (("experiments.bench", "--help"), "annotate"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_every_command_answers(installed, tmp_path, arguments, printed):
    done = run(installed, tmp_path, *arguments)
    assert done.returncode == 0, done.stderr
    assert printed in done.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        ("experiments", "new", "brevity", "--reward"),
        ("experiments.core.recorded", "fill"),
    ],
    ids=" ".join,
)
def test_what_needs_a_checkout_says_so_and_writes_nothing(installed, tmp_path, arguments):
    before = sorted(path for path in installed.rglob("*") if path.suffix != ".pyc" and path.name != "__pycache__")
    done = run(installed, tmp_path, *arguments)
    assert done.returncode == 1
    assert "must be a checkout of the project; clone it and work there" in done.stderr
    assert "Traceback" not in done.stderr
    assert before == sorted(p for p in installed.rglob("*") if p.suffix != ".pyc" and p.name != "__pycache__")
    assert not list(tmp_path.iterdir())
