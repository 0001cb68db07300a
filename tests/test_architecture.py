"""Rules of the sources: who may import whom, how long things may get, which names and docstrings are refused."""

import ast
import builtins
import collections
import functools
import graphlib
import importlib
import re
import symtable
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("touchr1_jax", "sensors_io", "experiments")
MAX_FILE, MAX_FUNCTION, MAX_ENTRIES = 400, 60, 15

LAYERS = {
    "touchr1_jax": "types|validation|masked|skipping|text|models|rewards|rl|training|distributed|bench|asking",
    "sensors_io": "errors json_files signals|schema|arrays clock units|sync taps force offsets|poses|deltas|quality|"
    "measures|layer|codec|augment|remote tables selection locks|shards|index|contents|records|parts cards|"
    "pipeline importers scenes exporters|fields touches|calibration|devices|recording viewer|generate live overview|"
    "commands|__main__",
    "experiments": "core|study|mechanics|scenes|fields|encoder|recordings|bench|paper|engine|active|faults|ask|"
    "__main__",
}
"""Lowest first: a module imports its own part of the package and those of lower layers."""

NO_POLICY = {"touchr1_jax.types", "touchr1_jax.masked"}
REWARDS_MAY_IMPORT = {*NO_POLICY, "touchr1_jax.rewards", "jax.numpy", "jax.errors", "numpy", "jaxtyping"}
REWARDS_MAY_IMPORT |= sys.stdlib_module_names
BENCH_MAY_IMPORT = {*NO_POLICY, "touchr1_jax.text", "touchr1_jax.bench"}
DOCUMENTS = {"README.md", "LOG.md", "REPRODUCTION.md", "TUTORIAL.md", "recorded", "figures"}
NO_CODE = {*DOCUMENTS, "py.typed", "__init__.py", "__pycache__"}


def name_of(path: Path) -> str:
    """Dotted name of a module."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(nodes: Iterable[ast.AST], module: str) -> set[str]:
    """Dotted names that a source imports, anywhere in it; `from a import b` gives a.b, a module or a name in one."""
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import of {node.module}"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def starts(name: str, prefixes: set[str]) -> bool:
    return any(name == prefix or name.startswith(f"{prefix}.") for prefix in prefixes)


SOURCES = {name_of(p): p.read_text() for package in PACKAGES for p in sorted((ROOT / package).rglob("*.py"))}


@functools.cache
def trees() -> dict[str, ast.Module]:
    """Of all sources, parsed where a test asks: a worker without these tests spares itself the seconds."""
    return {module: ast.parse(source) for module, source in SOURCES.items()}


@functools.cache
def nodes() -> dict[str, list[ast.AST]]:
    """Every node of each tree: a walk costs a second, and five rules need one."""
    return {module: list(ast.walk(tree)) for module, tree in trees().items()}


@functools.cache
def imports() -> dict[str, set[str]]:
    """Names that each module imports."""
    return {module: imports_of(found, module) for module, found in nodes().items()}


@functools.cache
def layer_of(name: str) -> int:
    """Layer of a module or of something imported from it."""
    package, part, *_ = name.split(".")
    found = [i for i, layer in enumerate(LAYERS[package].split("|")) if part in layer.split()]
    assert found, f"{name} has no layer: give it one in this test"
    return found[0]


def wrong_imports(modules: set[str], allowed: set[str], among: set[str] | None = None) -> list[str]:
    """Imports by modules of these packages of names (of these packages) that are not allowed."""
    return [
        f"{module} imports {name}"
        for module, names in imports().items()
        if starts(module, modules)
        for name in sorted(names)
        if (among is None or starts(name, among)) and not starts(name, allowed)
    ]


def test_packages_do_not_know_each_other():
    """touchr1_jax and sensors_io are strangers; nobody imports tests, or experiments from outside."""
    every = {*PACKAGES, "tests"}
    assert not wrong_imports({"touchr1_jax"}, {"touchr1_jax"}, every)
    assert not wrong_imports({"sensors_io"}, {"sensors_io"}, every)
    assert not wrong_imports({"experiments"}, set(PACKAGES), every)


def test_modules_import_their_own_part_and_lower_layers():
    wrong = []
    for module, names in imports().items():
        package, *parts = module.split(".")
        ours = [name for name in names if starts(name, {package}) and name.split(".")[1:2] != parts[:1]]
        if not parts:  # an `__init__` runs before every module of its package
            wrong += [f"{module} imports {name}" for name in ours]
        else:
            wrong += [f"{module} imports {name}" for name in ours if layer_of(name) >= layer_of(module)]
    assert not wrong


def test_records_are_numpy():
    """Only the scene generator computes with JAX; recording and reading need none."""
    scenes = [x for x in wrong_imports({"sensors_io"}, set(), {"jax", "flax"}) if not x.startswith("sensors_io.scenes")]
    assert not scenes


def test_rewards_and_the_benchmark_do_not_know_the_policy():
    rewards = wrong_imports({"touchr1_jax.rewards"}, REWARDS_MAY_IMPORT)
    tools = tuple(f"touchr1_jax.rewards.{name} " for name in ("__main__", "base", "proof", "adversary"))
    assert not [x for x in rewards if not x.startswith(tools)]
    assert not wrong_imports({"touchr1_jax.bench"}, BENCH_MAY_IMPORT, {"touchr1_jax"})


def test_no_module_imports_itself_by_way_of_others():
    known = set(imports())
    graph = {}
    for module, names in imports().items():  # `from a import b` is module a.b where there is one, else a
        graph[module] = {n if n in known else n.rpartition(".")[0] for n in names} & known - {module}
    assert graph["sensors_io.pipeline"] >= {"sensors_io.selection", "sensors_io.schema"}
    tuple(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError and names the cycle


def test_files_and_functions_are_short():
    assert not {module: n for module, source in SOURCES.items() if (n := len(source.splitlines())) > MAX_FILE}
    assert not {f"{m}.{f.name}": n for m, f in functions() if (n := f.end_lineno - f.lineno + 1) > MAX_FUNCTION}


def functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for module, found in nodes().items():
        yield from ((module, n) for n in found if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))


MUTABLE = {
    "touchr1_jax.training.loop.LoopTime": "sums grow with every step",
    "sensors_io.devices.intake.Counts": "grow with every sample, under the lock of the intake",
    "sensors_io.devices.replay.Truth": "grows with every sample",
    "sensors_io.importers.catalogue._Run": "collects what an import leaves out",
    "sensors_io.importers.pickles._Array": "a pickle makes an array first and fills it afterwards",
    "sensors_io.index.Index": "grows with every shard",
    "sensors_io.recording.book.Report": "grows with every contact",
}
"""Dataclasses that change, and why."""


def classes() -> Iterator[tuple[str, ast.ClassDef]]:
    for module, found in nodes().items():
        yield from ((f"{module}.{n.name}", n) for n in found if isinstance(n, ast.ClassDef))


def test_dataclasses_are_frozen():
    """Those of Flax are; `dataclasses.dataclass` says so, or its class is listed with a reason."""
    made = {name: [ast.unparse(d) for d in node.decorator_list] for name, node in classes()}
    plain = {name for name, by in made.items() if any("dataclasses.dataclass" in d for d in by)}
    assert {name for name in plain if not any("frozen=True" in d for d in made[name])} == MUTABLE.keys()


def test_class_names_are_unique():
    """One name, one thing: a reader who searches for a class finds it alone."""
    where = collections.defaultdict(list)
    for name, _ in classes():
        where[name.rpartition(".")[2]].append(name)
    assert not {name: found for name, found in where.items() if len(found) > 1}


def test_docstrings_open_with_a_noun_or_a_verb():
    """Only the question of an experiment may open with What, Whether or How."""
    wrong = []
    for module, found in nodes().items():
        for node in found:
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                first = (ast.get_docstring(node) or "").partition("\n")[0]
                if re.match(r"(What|Whether|How)\b", first) and not first.endswith("?"):
                    wrong.append(f"{module}: {first}")
    assert not wrong


def test_every_folder_serves_several_modules():
    """A folder that one module alone imports is a part of that module; families and commands are found by name."""
    assert len([p for p in (ROOT / "experiments").iterdir() if p.name not in NO_CODE]) <= MAX_ENTRIES
    folders = {m for m in imports() if m.count(".") >= 1 and any(other.startswith(f"{m}.") for other in imports())}
    importers = {folder: users(folder) for folder in folders if not re.fullmatch(r"experiments\.\w+", folder)}
    assert not {folder: by for folder, by in importers.items() if len(by) == 1 and not by[0].endswith("__main__")}


def users(folder: str) -> list[str]:
    """Modules outside a folder that import something of it."""
    return [
        module
        for module, names in imports().items()
        if not starts(module, {folder}) and any(starts(name, {folder}) for name in names)
    ]


def unknown_globals(source: str, known: set[str]) -> set[str]:
    """Global names that the functions of a source read and nobody defines; shape strings keep linters from it."""
    unknown, tables = set(), symtable.symtable(source, "source", "exec").get_children()
    while tables:
        table = tables.pop()
        tables += table.get_children()
        names = {s.get_name() for s in table.get_symbols() if s.is_global() and s.is_referenced()}
        unknown |= {n for n in names if n not in known and not hasattr(builtins, n)}
    return unknown


def bound_names(statement: ast.stmt) -> set[str]:
    """Names that a statement of a module binds."""
    if isinstance(statement, ast.Import | ast.ImportFrom):
        return {(a.asname or a.name).split(".")[0] for a in statement.names}
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return {statement.name}
    return {n.id for n in ast.walk(statement) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}


def test_every_global_name_exists():
    wrong = {}
    for module, source in SOURCES.items():
        if module.endswith("__main__"):
            known = {n for top in trees()[module].body for n in bound_names(top)} | {"__name__", "__file__"}
        else:
            known = set(vars(importlib.import_module(module)))
        if unknown := unknown_globals(source, known):
            wrong[module] = unknown
    assert not wrong


def of_the_locale(nodes: Iterable[ast.AST]) -> set[int]:
    """Lines that read or write a text in the encoding of the user's locale, which in another one are other words."""
    found = set()
    for node in nodes:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            texts = {"read_text": 0, "write_text": 1}.get(node.func.attr)
            if len(node.args) == texts and "encoding" not in {keyword.arg for keyword in node.keywords}:
                found.add(node.lineno)
    return found


def test_texts_state_their_encoding():
    assert not {module: lines for module, found in nodes().items() if (lines := of_the_locale(found))}


def test_the_rules_see_what_they_forbid():
    """Also an import inside a function, and one by its parent package."""
    assert len(SOURCES) > 50
    hidden = ast.parse("def f():\n    from sensors_io import schema\n    import experiments.core.runs\n")
    assert imports_of(ast.walk(hidden), "touchr1_jax.x") == {"sensors_io.schema", "experiments.core.runs"}
    assert not starts("sensors_io_extra", {"sensors_io"})
    with pytest.raises(AssertionError, match="relative import"):
        imports_of(ast.walk(ast.parse("from . import schema")), "sensors_io.x")
    source = "import os\n\ndef f(x):\n    y = [os.sep for z in x]\n    return g(y, len(x), missing)\n"
    assert unknown_globals(source, {"os", "f", "g"}) == {"missing"}
    texts = "a.read_text()\na.read_text('utf-8')\na.write_text(x)\nwrite_text(a, x)"
    assert of_the_locale(ast.walk(ast.parse(texts))) == {1, 3}
