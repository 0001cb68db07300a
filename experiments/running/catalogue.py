"""Which experiments a package holds, read from the sources without importing any."""

import ast
import importlib.util
from collections.abc import Mapping
from pathlib import Path


def find(package: str) -> dict[str, str]:
    """Name → question of every experiment of a package.

    Raises:
      ModuleNotFoundError: no such package.
    """
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(f"package is {package!r}: no such package; give the one that holds the experiments")
    sources = sorted(path for folder in spec.submodule_search_locations for path in Path(folder).glob("*.py"))
    trees = {path.stem: ast.parse(path.read_text(encoding="utf-8")) for path in sources}
    return {stem: first_line(ast.get_docstring(tree)) for stem, tree in trees.items() if _defines_experiment(tree)}


def listing(questions: Mapping[str, str]) -> str:
    """One line per experiment."""
    width = max(map(len, questions), default=0)
    return "\n".join(["experiments:", *(f"  {name:<{width}}  {question}" for name, question in questions.items())])


def first_line(text: str | None) -> str:
    """The first line of a docstring, empty where there is none."""
    return text.strip().splitlines()[0] if text else ""


def _defines_experiment(tree: ast.Module) -> bool:
    targets = [t for node in tree.body if isinstance(node, ast.Assign) for t in node.targets]
    targets += [node.target for node in tree.body if isinstance(node, ast.AnnAssign)]
    return any(isinstance(t, ast.Name) and t.id == "EXPERIMENT" for t in targets)
