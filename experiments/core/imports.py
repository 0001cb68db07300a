"""Who imports whom, read from the sources: the packages' parts and the imports between them."""

import ast
from collections.abc import Mapping
from pathlib import Path

PACKAGES = ("touchr1_jax", "sensors_io", "experiments")

EXPERIMENTS = "experiments, one file each"
"""Stands for every module of `experiments` itself; nobody imports them."""

Graph = Mapping[str, frozenset[str]]
"""Part → the parts that it imports."""


def part_graph(root: Path) -> dict[str, frozenset[str]]:
    """The imports between parts, `package.part` → the parts of all packages that its modules import.

    A part is a folder or a module right below a package; command lines (`__main__`) and a package's own `__init__` are
    left out, and all experiments are one part.

    Args:
      root: the folder that the packages lie in.
    """
    files = {path: _part(path.relative_to(root)) for package in PACKAGES for path in (root / package).rglob("*.py")}
    parts = {part for part in files.values() if part}
    found: dict[str, set[str]] = {part: set() for part in sorted(parts)}
    for path, part in files.items():
        if part:
            found[part] |= {name for name in _imported(path) if name in parts} - {part}
    return {part: frozenset(names) for part, names in found.items()}


def within(graph: Graph, package: str) -> dict[str, frozenset[str]]:
    """The parts of one package and the imports between them, by the parts' own names."""
    own = {part for part in graph if part.startswith(f"{package}.")}
    short = lambda part: part.removeprefix(f"{package}.")
    return {short(part): frozenset(short(x) for x in graph[part] & own) for part in own}


def reachable(graph: Graph) -> dict[str, frozenset[str]]:
    """Every part that a part imports, directly or by way of others."""
    found = {part: set(names) for part, names in graph.items()}
    for middle in graph:
        for names in found.values():
            if middle in names:
                names |= found[middle]
    return {part: frozenset(names) for part, names in found.items()}


def condensed(graph: Graph) -> dict[str, frozenset[str]]:
    """The same graph with parts that import each other as one, their names joined."""
    reach = reachable(graph)
    group = {p: tuple(sorted({p} | {q for q in reach[p] if p in reach[q]})) for p in graph}
    name = {p: " + ".join(members) for p, members in group.items()}
    joined: dict[str, set[str]] = {name[p]: set() for p in sorted(graph)}
    for part, names in graph.items():
        joined[name[part]] |= {name[x] for x in names} - {name[part]}
    return {part: frozenset(names) for part, names in joined.items()}


def reduced(graph: Graph) -> dict[str, frozenset[str]]:
    """The fewest imports of an acyclic graph that reach the same parts."""
    reach = reachable(graph)
    return {p: frozenset(x for x in names if not any(x in reach[y] for y in names)) for p, names in graph.items()}


def rows(graph: Graph) -> list[list[str]]:
    """The parts of an acyclic graph in rows, lowest first: each stands right above the highest that it imports."""
    height: dict[str, int] = {}

    def of(part: str) -> int:
        if part not in height:
            height[part] = max((of(x) + 1 for x in graph[part]), default=0)
        return height[part]

    top = max(map(of, graph))
    return [sorted(p for p in graph if height[p] == level) for level in range(top + 1)]


def _part(path: Path) -> str:
    """The part that a module belongs to; empty where it belongs to none."""
    package, *rest = path.with_suffix("").parts
    if rest == ["__init__"] or path.stem == "__main__":
        return ""
    alone = len(rest) == 1
    return f"{package}.{EXPERIMENTS if package == 'experiments' and alone else rest[0]}"


def _imported(path: Path) -> set[str]:
    """The parts whose names a source imports, `package.part`."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {".".join(name.split(".")[:2]) for name in names}
