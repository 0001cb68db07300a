"""The released package: what the wheel holds, and that it works from an empty folder, away from any checkout."""

import importlib.util
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import touchr1_jax

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("touchr1_jax", "sensors_io", "experiments")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        any(importlib.util.find_spec(name) is None for name in ("build", "twine")),
        reason="needs `pip install -e '.[release]'`, and the network",
    ),
]


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """Folder of wheel and sdist, built from a copy, since setuptools leaves files among the sources."""
    folder = tmp_path_factory.mktemp("sources")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"):
        shutil.copy(ROOT / name, folder)
    subprocess.run([sys.executable, "-m", "build", str(folder)], check=True, capture_output=True)
    return folder / "dist"


@pytest.fixture(scope="module")
def wheel(built) -> Path:
    """The wheel, which `build` makes from the sdist."""
    (path,) = built.glob("*.whl")
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


def test_both_are_ready_for_an_index(built):
    paths = sorted(map(str, built.iterdir()))
    assert [Path(path).suffix for path in paths] == [".whl", ".gz"]
    command = [sys.executable, "-m", "twine", "check", "--strict", *paths]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_policy_of_the_package_loads_in_an_empty_folder(installed, tmp_path):
    (tmp_path / "loads.py").write_text(
        "import touchr1_jax as t\nprint(t.__file__, t.__version__, t.load_policy().name)"
    )
    place, *rest = run(installed, tmp_path, "loads").stdout.split()
    assert place.startswith(str(installed))
    assert rest == [touchr1_jax.__version__, "touch-small"]


def test_an_experiment_runs_in_an_empty_folder(installed, tmp_path):
    done = run(installed, tmp_path, "experiments", "paper_audit", "--scale", "smoke")
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "runs" / "paper_audit" / "latest" / "report.html").exists()
    assert "paper_audit" in run(installed, tmp_path, "experiments", "list").stdout
    assert (installed / "experiments" / "bench" / "paper_audit.py").exists()


def test_every_command_answers(installed, tmp_path):
    for module, printed in (
        ("touchr1_jax.rewards", "explain"),
        ("touchr1_jax.models.load", "Read a checkpoint"),
        ("sensors_io", "calibrate"),
        ("experiments.bench", "annotate"),
    ):
        assert printed in run(installed, tmp_path, module, "--help").stdout, module


def test_what_needs_a_checkout_says_so_and_writes_nothing(installed, tmp_path):
    done = run(installed, tmp_path, "experiments", "new", "brevity", "--reward")
    assert done.returncode == 1
    assert "must be a checkout of the project; clone it and work there" in done.stderr
    assert not list(tmp_path.iterdir())
    assert not list(installed.rglob("brevity*"))
