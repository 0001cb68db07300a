"""What is shipped and what is said of it: type information, importable folders, the glossary, links."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("touchr1_jax", "sensors_io", "experiments")
DOCUMENTS = [
    ROOT / "README.md",
    *(ROOT / ".github").glob("*.md"),
    *(p for x in (*PACKAGES, "docs") for p in (ROOT / x).rglob("*.md")),
]
SHAPE = re.compile(r'\w+\[[\w. |]+, "([^"]*)"\]')


@pytest.mark.parametrize("package", PACKAGES)
def test_types_are_shipped(package):
    shipped = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    assert "py.typed" in shipped[package]
    assert (ROOT / package / "py.typed").exists()


@pytest.mark.parametrize("package", PACKAGES)
def test_every_folder_of_sources_is_a_package(package):
    """The wheel leaves out folders without `__init__.py`."""
    folders = {path.parent for path in (ROOT / package).rglob("*.py")}
    assert not [folder for folder in folders if not (folder / "__init__.py").exists()]


@pytest.mark.long
def test_recording_needs_no_jax():
    """As the README of sensors_io says: these import where there is none."""
    needed = (
        "sensors_io.recording.session",
        "sensors_io.devices.uvc",
        "sensors_io.pipeline",
        "sensors_io.viewer.server",
    )
    blocked = f"import sys; sys.modules['jax'] = None; import {', '.join(needed)}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", blocked], env=environment, check=True)


def test_every_dimension_is_in_the_glossary():
    glossary = (ROOT / "touchr1_jax" / "README.md").read_text().partition("## Dimensions")[2]
    known = {
        name.strip() for line in re.findall(r"^\| ([A-Z][^|]*) \|", glossary, re.MULTILINE) for name in line.split(",")
    }
    known |= set(re.findall(r"\b[A-Z]v\b", glossary))
    shapes = {s for path in (ROOT / "touchr1_jax").rglob("*.py") for s in SHAPE.findall(path.read_text())}
    used = {name for shape in shapes for name in re.findall(r"[A-Z]\w*", shape)}
    assert {"P", "G", "T", "KV", "Hv"} <= used
    assert used <= known


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_and_named_files_exist(document):
    text = document.read_text(encoding="utf-8")
    links = [link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text)]
    assert not [link for link in links if link and not (document.parent / link).exists()]
