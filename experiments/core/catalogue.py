"""Which experiments a package holds, read from the sources without importing any."""

import ast
import dataclasses
import importlib.util
from collections.abc import Mapping
from pathlib import Path


@dataclasses.dataclass(frozen=True, kw_only=True)
class Entry:
    """An experiment of a package: its module, its family (the folder it lies in) and its question."""

    module: str
    family: str
    question: str


def find(package: str) -> dict[str, Entry]:
    """Name → entry of every experiment of a package: its own modules and those of its families.

    Raises:
      ModuleNotFoundError: no such package.
      ValueError: two modules define an experiment of one name.
    """
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(f"package is {package!r}: no such package; give the one that holds the experiments")
    found: dict[str, Entry] = {}
    for root in map(Path, spec.submodule_search_locations):
        for path in sorted([*root.glob("*.py"), *root.glob("*/*.py")]):
            source = path.read_text(encoding="utf-8")
            if "EXPERIMENT" not in source or not _defines_experiment(tree := ast.parse(source)):
                continue
            parts = path.relative_to(root).with_suffix("").parts
            module = ".".join((package, *parts))
            if path.stem in found:
                raise ValueError(f"{module} has the name of {found[path.stem].module}: names are unique; rename one")
            family = parts[0] if len(parts) > 1 else ""
            found[path.stem] = Entry(module=module, family=family, question=first_line(ast.get_docstring(tree)))
    return dict(sorted(found.items()))


def listing(entries: Mapping[str, Entry]) -> str:
    """One line per experiment, grouped by family."""
    width = max(map(len, entries), default=0)
    lines = ["experiments:"]
    for family in sorted({entry.family for entry in entries.values()}):
        lines += [f"\n{family}"] if family else []
        lines += [f"  {n:<{width}}  {e.question}" for n, e in entries.items() if e.family == family]
    return "\n".join(lines)


def first_line(text: str | None) -> str:
    """The first line of a docstring, empty where there is none."""
    return text.strip().splitlines()[0] if text else ""


def _defines_experiment(tree: ast.Module) -> bool:
    targets = [t for node in tree.body if isinstance(node, ast.Assign) for t in node.targets]
    targets += [node.target for node in tree.body if isinstance(node, ast.AnnAssign)]
    return any(isinstance(t, ast.Name) and t.id == "EXPERIMENT" for t in targets)
