"""Who may import whom, and how long things may get, read from the sources."""

import ast
import builtins
import graphlib
import importlib
import symtable
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("touchr1_jax", "sensors_io", "experiments")
MAX_FILE, MAX_FUNCTION = 400, 60

TOUCHR1_LAYERS = (
    {"types", "validation"},
    {"masked"},
    {"text"},
    {"models"},
    {"rewards"},
    {"rl"},
    {"training"},
    {"distributed"},
    {"bench"},
)
"""Lowest first: a module may import its own layer and those before it."""

SENSORS_LAYERS = (
    {"errors"},
    {"schema"},
    {"clock", "json_files"},
    {"sync", "taps", "force", "offsets"},
    {"poses"},
    {"deltas"},
    {"quality"},
    {"measures"},
    {"layer"},
    {"codec"},
    {"augment"},
    {"shards", "selection"},
    {"index"},
    {"records"},
    {"cards"},
    {"pipeline", "importers", "scenes"},
    {"fields"},
    {"calibration"},
    {"devices"},
    {"recording", "viewer"},
    {"generate", "live", "overview"},
    {"commands"},
    {"__main__"},
)
"""The same; members of one layer do not know each other."""

EXPERIMENTS_LAYERS = (
    {"core"},
    {"study"},
    {"mechanics"},
    {"scenes"},
    {"fields"},
    {"encoder"},
    {"recordings"},
    {"bench"},
    {"paper"},
    {"engine"},
    {"faults"},
)
"""The same for the families of experiments."""

REWARDS_MAY_IMPORT = {
    "touchr1_jax.types",
    "touchr1_jax.masked",
    "touchr1_jax.rewards",
    "jax.numpy",
    "jax.errors",
    "numpy",
    "jaxtyping",
}
BENCH_MAY_IMPORT = {"touchr1_jax.types", "touchr1_jax.masked", "touchr1_jax.bench"}

FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    """Dotted name of a module."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(source: str, module: str) -> set[str]:
    """Dotted names that a source imports, anywhere in it; `from a import b` gives a.b, a module or a name in one."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import of {node.module}"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def starts(name: str, prefixes: set[str]) -> bool:
    return any(name == prefix or name.startswith(f"{prefix}.") for prefix in prefixes)


IMPORTS = {name_of(path): imports_of(path.read_text(), name_of(path)) for path in FILES}


def layer_of(name: str, layers: tuple[set[str], ...]) -> int:
    """Layer of a module or of something imported from it."""
    parts = name.split(".")
    if len(parts) == 1:
        return -1  # the package itself, which must stay empty
    found = [i for i, layer in enumerate(layers) if parts[1] in layer]
    assert found, f"{name} has no layer: give it one in this test"
    return found[0]


def test_the_sources_are_found():
    assert len(FILES) > 50
    assert "sensors_io.records.RecordWriter" in IMPORTS["sensors_io.generate"]


@pytest.mark.parametrize("module", IMPORTS)
def test_packages_do_not_know_each_other(module):
    """touchr1_jax and sensors_io are strangers; nobody imports experiments or tests."""
    package = module.split(".")[0]
    strangers = {
        "touchr1_jax": {"sensors_io", "experiments", "tests"},
        "sensors_io": {"touchr1_jax", "experiments", "tests"},
        "experiments": {"tests"},
    }[package]
    assert not [name for name in IMPORTS[module] if starts(name, strangers)]


@pytest.mark.parametrize("module", [m for m in IMPORTS if starts(m, {"sensors_io"})])
def test_records_are_numpy(module):
    """Only the scene generator computes with JAX; whoever records or reads needs none."""
    jax_user = starts(module, {"sensors_io.scenes"})
    assert jax_user or not [name for name in IMPORTS[module] if starts(name, {"jax", "flax"})]


@pytest.mark.parametrize("package", ["touchr1_jax", "sensors_io"])
def test_the_package_itself_imports_nothing(package):
    """Its `__init__` runs before every module of it."""
    assert IMPORTS[package] == set()


@pytest.mark.parametrize(
    ("package", "layers"),
    [("touchr1_jax", TOUCHR1_LAYERS), ("sensors_io", SENSORS_LAYERS)],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_lower_layers_do_not_import_higher_ones(package, layers):
    wrong = []
    for module, names in IMPORTS.items():
        if not module.startswith(f"{package}."):
            continue
        own = layer_of(module, layers)
        wrong += [f"{module} imports {n}" for n in names if starts(n, {package}) and layer_of(n, layers) > own]
    assert not wrong


def test_equal_layers_of_sensors_io_do_not_import_each_other():
    wrong = []
    for module, names in IMPORTS.items():
        if not module.startswith("sensors_io."):
            continue
        own = module.split(".")[1]
        for name in names:
            if not starts(name, {"sensors_io"}) or name.split(".")[1] == own:
                continue
            if layer_of(name, SENSORS_LAYERS) == layer_of(module, SENSORS_LAYERS):
                wrong.append(f"{module} imports {name}")
    assert not wrong


@pytest.mark.parametrize("module", [m for m in IMPORTS if starts(m, {"experiments"}) and m.count(".") > 1])
def test_parts_of_experiments_know_no_experiment_and_no_part_above_them(module):
    ours = [name for name in IMPORTS[module] if starts(name, {"experiments"})]
    own = layer_of(module, EXPERIMENTS_LAYERS)
    assert not [name for name in ours if layer_of(name, EXPERIMENTS_LAYERS) > own]


def test_no_module_imports_itself_by_way_of_others():
    known = set(IMPORTS)
    graph = {}
    for module, names in IMPORTS.items():  # `from a import b` is module a.b where there is one, else a
        graph[module] = {n if n in known else n.rpartition(".")[0] for n in names} & known - {module}
    assert graph["sensors_io.pipeline"] >= {"sensors_io.selection", "sensors_io.schema"}
    tuple(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError and names the cycle


@pytest.mark.parametrize("module", [m for m in IMPORTS if starts(m, {"touchr1_jax.rewards"})])
def test_rewards_import_next_to_nothing(module):
    """The command line beside them reads the answer language too; no reward imports it."""
    if module.endswith(".__main__"):
        return
    allowed = REWARDS_MAY_IMPORT | set(sys.stdlib_module_names)
    assert not [name for name in IMPORTS[module] if not starts(name, allowed)]


@pytest.mark.parametrize("module", [m for m in IMPORTS if starts(m, {"touchr1_jax.bench"})])
def test_the_bench_does_not_know_the_policy(module):
    ours = [name for name in IMPORTS[module] if starts(name, {"touchr1_jax"})]
    assert not [name for name in ours if not starts(name, BENCH_MAY_IMPORT)]


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_files_and_functions_are_short(path):
    source = path.read_text()
    assert len(source.splitlines()) <= MAX_FILE
    functions = (n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))
    long = {f.name: f.end_lineno - f.lineno + 1 for f in functions if f.end_lineno - f.lineno + 1 > MAX_FUNCTION}
    assert not long


def unknown_globals(source: str, known: set[str]) -> set[str]:
    """Global names that the functions of a source read and nobody defines; shape strings keep linters from it."""
    unknown, tables = set(), symtable.symtable(source, "source", "exec").get_children()
    while tables:
        table = tables.pop()
        tables += table.get_children()
        names = {s.get_name() for s in table.get_symbols() if s.is_global() and s.is_referenced()}
        unknown |= {n for n in names if n not in known and not hasattr(builtins, n)}
    return unknown


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_every_global_name_exists(path):
    if path.name == "__main__.py":
        known = {n for top in ast.parse(path.read_text()).body for n in bound_names(top)} | {"__name__", "__file__"}
    else:
        known = set(vars(importlib.import_module(name_of(path))))
    assert not unknown_globals(path.read_text(), known)


def bound_names(statement: ast.stmt) -> set[str]:
    """What a statement of a module binds."""
    if isinstance(statement, ast.Import | ast.ImportFrom):
        return {(a.asname or a.name).split(".")[0] for a in statement.names}
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return {statement.name}
    return {n.id for n in ast.walk(statement) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}


def test_an_unknown_global_name_would_be_seen():
    source = "import os\n\ndef f(x):\n    y = [os.sep for z in x]\n    return g(y, len(x), missing)\n"
    assert unknown_globals(source, {"os", "f", "g"}) == {"missing"}


def test_a_forbidden_import_would_be_seen():
    """Also one inside a function, and one by its parent package."""
    hidden = "def f():\n    from sensors_io import schema\n    import experiments.core.runs\n"
    assert imports_of(hidden, "touchr1_jax.x") == {"sensors_io.schema", "experiments.core.runs"}
    assert starts("sensors_io.schema", {"sensors_io"})
    assert not starts("sensors_io_extra", {"sensors_io"})
    with pytest.raises(AssertionError, match="relative import"):
        imports_of("from . import schema", "sensors_io.x")
