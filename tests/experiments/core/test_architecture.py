"""The graph of imports on made-up packages, and the committed picture against the real ones."""

from pathlib import Path

import pytest

from experiments.core.architecture import PICTURE, draw
from experiments.core.imports import EXPERIMENTS, condensed, part_graph, reachable, reduced, rows, within

ROOT = Path(__file__).resolve().parents[3]

DIAMOND = {
    "top": frozenset({"left", "right", "bottom"}),
    "left": frozenset({"bottom"}),
    "right": frozenset({"bottom"}),
    "bottom": frozenset(),
}


def test_parts_and_their_imports(tmp_path):
    sources = {
        "touchr1_jax/__init__.py": "",
        "touchr1_jax/types.py": "import numpy",
        "touchr1_jax/models/lm.py": "from touchr1_jax import types\nfrom touchr1_jax.models.layers import attend",
        "sensors_io/__init__.py": "",
        "sensors_io/__main__.py": "from sensors_io import schema",
        "sensors_io/schema.py": "",
        "experiments/one.py": "from touchr1_jax.models.lm import Decoder\nimport experiments.core.runner",
        "experiments/two.py": "def f():\n    from sensors_io.schema import Flag",
        "experiments/core/runner.py": "",
    }
    for path, text in sources.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    assert part_graph(tmp_path) == {
        "touchr1_jax.types": frozenset(),
        "touchr1_jax.models": {"touchr1_jax.types"},
        "sensors_io.schema": frozenset(),
        f"experiments.{EXPERIMENTS}": {"touchr1_jax.models", "experiments.core", "sensors_io.schema"},
        "experiments.core": frozenset(),
    }


def test_an_import_that_follows_from_others_is_not_drawn():
    assert reduced(DIAMOND) == {**DIAMOND, "top": {"left", "right"}}
    assert reachable(reduced(DIAMOND)) == reachable(DIAMOND)
    assert rows(DIAMOND) == [["bottom"], ["left", "right"], ["top"]]


def test_parts_that_import_each_other_are_one():
    graph = {**DIAMOND, "bottom": frozenset({"right"})}
    assert condensed(graph) == {
        "top": {"left", "bottom + right"},
        "left": {"bottom + right"},
        "bottom + right": frozenset(),
    }


@pytest.mark.parametrize("package", ["touchr1_jax", "sensors_io"])
def test_no_parts_of_a_library_import_each_other(package):
    graph = within(part_graph(ROOT), package)
    assert condensed(graph) == graph


def test_the_committed_picture_is_that_of_the_imports():
    drawn, committed = draw(ROOT), (ROOT / PICTURE).read_text(encoding="utf-8")
    assert drawn == committed, "the imports have changed since it was drawn: run `make picture`"
    for part in part_graph(ROOT):
        assert part.partition(".")[2] in drawn
