"""Mutation check: a source is changed in one small place at a time, and some quick test that executes it should fail.

    python -m tests.mutants --sample 300 --seed 31 --workers 2

A mutant takes some ten seconds of a core, in a process forked from one that has imported JAX and computed nothing.  A
run continues where the last one stopped; with `--again` it tries survivors again.  The first asks by `coverage`
which lines each test executes.  A survivor without consequence is judged by hand: append its line of `outcomes.jsonl`
with the outcome `equivalent`, and the reason as `why`.
"""

import ast
import contextlib
import dataclasses
import functools
import itertools
import json
import multiprocessing
import os
import random
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import tyro

ROOT = Path(__file__).resolve().parent.parent
PATHS = ("touchr1_jax/rl", "touchr1_jax/rewards", "touchr1_jax/text", "sensors_io/fields", "sensors_io/records.py")
TESTS = ("tests/touchr1_jax/rl", "tests/touchr1_jax/rewards", "tests/touchr1_jax/text", "tests/sensors_io")
QUICK = ("-q", "-p", "no:cacheprovider", "--hypothesis-seed=0", "-m", "not long and not slow")
TESTS_S = 25.0  # longest time of a mutant's tests, by their durations when coverage was asked
DONE = 10  # exit codes from here on are pytest's
KILLED, SURVIVED, EQUAL = "killed", "survived", "equivalent"

UNTOUCHED = {"annotation", "returns", "decorator_list"}
FLAGS = {"strict", "frozen", "kw_only"}  # arguments without consequence for results
DROPPED = {"abs", "clip", "exp", "log", "sqrt", "square", "sorted", "stop_gradient"}  # f(x, …) becomes x
ONE_WAY = "FloorDiv Mult|Mod FloorDiv|Pow Mult|Lt LtE|LtE Lt|Gt GtE|GtE Gt"
BOTH_WAYS = "Add Sub|Mult Div|BitAnd BitOr|And Or|Lt Gt|LtE GtE|Eq NotEq|Is IsNot|In NotIn|min max|any all|sum mean|"
BOTH_WAYS += "minimum maximum|argmin argmax|floor ceil|sin cos|zeros ones|zeros_like ones_like"
SWAPS = [pair.split() for pair in f"{ONE_WAY}|{BOTH_WAYS}".split("|")] + [p.split()[::-1] for p in BOTH_WAYS.split("|")]

_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload(["flax.linen", "optax", "orbax.checkpoint", "chex", "scipy.signal", "cv2", "beartype"])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Sources, number of mutants drawn from them, and minutes after which none is begun."""

    paths: tuple[str, ...] = PATHS
    sample: int = 300
    seed: int = 31
    workers: int = 1
    minutes: float = float("inf")
    again: bool = False
    state: Path = ROOT / "build" / "mutants"


class Mutant(NamedTuple):
    """A change of the bytes [start, end) of a source."""

    path: str
    line: int
    start: int
    end: int
    old: str
    new: str


class Test(NamedTuple):
    """A test, its duration, and the lines of each source that it executes."""

    name: str
    seconds: float
    lines: dict[str, list[int]]


def nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes of a tree that may be changed: no annotations, decorators, errors, texts, flags."""
    for name, value in ast.iter_fields(tree):
        for child in [] if name in UNTOUCHED else value if isinstance(value, list) else [value]:
            skipped = isinstance(child, ast.JoinedStr | ast.Raise) or getattr(child, "arg", None) in FLAGS
            if isinstance(child, ast.AST) and not skipped:
                yield child
                yield from nodes(child)


def changes(node: Any) -> Iterator[ast.expr]:
    """Expressions that could stand in a node's place."""
    swaps = lambda name: [new for old, new in SWAPS if old == name]
    ops = lambda op: [getattr(ast, name)() for name in swaps(type(op).__name__)]
    but = lambda **field: type(node)(**dict(ast.iter_fields(node)) | field)
    match node:
        case ast.Constant(value=bool(value)):
            yield but(value=not value)
        case ast.Constant(value=int(value) | float(value)):
            yield but(value=value + 1 if isinstance(value, int) else 2 * value or 1.0)
        case ast.BinOp(op=op) | ast.BoolOp(op=op):
            yield from (but(op=new) for new in ops(op))
        case ast.Compare(ops=[op]):
            yield from (but(ops=[new]) for new in ops(op))
        case ast.Name(id=name):
            yield from (but(id=new) for new in swaps(name))
        case ast.Attribute(attr=name):
            yield from (but(attr=new) for new in swaps(name))
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            yield operand
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name), args=[first, *_]) if name in DROPPED:
            yield first


def mutants_of(path: Path) -> list[Mutant]:
    """All changes of a source: also statements that are left out and conditions that are turned round."""
    source, pairs = path.read_bytes(), list[tuple[Any, ast.expr]]()
    for node in nodes(ast.parse(source)):
        pairs += [(node, new) for new in changes(node)]
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            pairs.append((node, ast.Constant(None)))
        if isinstance(node, ast.If | ast.IfExp) and isinstance(node.test, ast.Name | ast.Attribute | ast.Call):
            pairs.append((node.test, ast.UnaryOp(ast.Not(), node.test)))
    starts = [0, *itertools.accumulate(map(len, source.splitlines(keepends=True)))]
    found = set()
    for old, new in pairs:
        start, end = starts[old.lineno - 1] + old.col_offset, starts[old.end_lineno - 1] + old.end_col_offset
        text = source[start:end].decode()
        found.add(Mutant(str(path.relative_to(ROOT)), old.lineno, start, end, text, f"({ast.unparse(new)})"))
    return sorted(found)


def selected(mutant: Mutant, tests: list[Test]) -> list[Test]:
    """Tests to try: those that execute the line, first of the module's own file, then their neighbours."""
    span = set(range(mutant.line, mutant.line + mutant.old.count("\n") + 1))
    file, own = lambda test: test.name.partition("::")[0], f"/test_{Path(mutant.path).stem}.py::"
    direct = {x.name for x in tests if not span.isdisjoint(x.lines.get(mutant.path, ()))}
    direct = direct or {x.name for x in tests if mutant.path in x.lines}  # the line is executed at import
    files = {file(x) for x in tests if x.name in direct}
    rank = lambda x: (x.name not in direct, own not in x.name, x.seconds)
    ranked = sorted((x for x in tests if file(x) in files), key=rank)
    ends = itertools.accumulate(x.seconds for x in ranked)
    return [x for x, end in zip(ranked, ends, strict=True) if end <= TESTS_S] or ranked[:1]


class _Chosen:
    """Plugin: tests in the order given."""

    def __init__(self, names: list[str]) -> None:
        self._rank = {name: i for i, name in enumerate(names)}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = sorted((x for x in items if x.nodeid in self._rank), key=lambda x: self._rank[x.nodeid])


class _Lines:
    """Plugin: writes the tests with their durations and the lines that they execute."""

    def __init__(self, out: Path) -> None:
        import coverage  # of this one run

        include = [str(ROOT / path) + ("" if path.endswith(".py") else "/*") for path in PATHS]
        self._coverage = coverage.Coverage(data_file=None, config_file=False, include=include)
        self._out, self._seconds = out, Counter[str]()
        self._coverage.start()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self._coverage.switch_context(item.nodeid)
        return (yield)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._seconds[report.nodeid] += report.duration

    def pytest_sessionfinish(self) -> None:
        self._coverage.stop()
        data = self._coverage.get_data()
        lines: dict[str, dict[str, list[int]]] = {name: {} for name in self._seconds}
        for path, name in itertools.product(data.measured_files(), lines):
            data.set_query_context(name)
            if found := data.lines(path):
                lines[name][str(Path(path).relative_to(ROOT))] = sorted(found)
        rows = (json.dumps((name, seconds, lines[name])) + "\n" for name, seconds in self._seconds.items())
        self._out.write_text("".join(rows), encoding="utf-8")


def _session(arguments: list[str], plugin: Callable[[], Any], mutant: Mutant | None, state: Path) -> None:
    """The process: pytest, where the changed source is all that there is of it."""
    os.setpgid(0, 0)
    for stream in (1, 2):
        os.dup2(os.open(state / "printed.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(state / "bytecode")
    if mutant is not None:
        _change(mutant)
    sys.exit(DONE + pytest.main([*QUICK, *arguments], plugins=[plugin()]))


def _change(mutant: Mutant) -> None:
    """Let this process read the changed source, and no bytecode of it."""
    path, read, stat = ROOT / mutant.path, SourceFileLoader.get_data, SourceFileLoader.path_stats
    changed = path.read_bytes()[: mutant.start] + mutant.new.encode() + path.read_bytes()[mutant.end :]

    def path_stats(loader: SourceFileLoader, of: str) -> Any:
        if of == str(path):
            raise FileNotFoundError(of)
        return stat(loader, of)

    SourceFileLoader.path_stats = path_stats
    SourceFileLoader.get_data = lambda loader, of: changed if of == str(path) else read(loader, of)


def run(arguments: list[str], plugin: Callable[[], Any], mutant: Mutant | None, state: Path, limit_s: float) -> bool:
    """Whether tests pass in a process of their own; not if it crashes, nor beyond the limit."""
    process = _SERVER.Process(target=_session, args=(arguments, plugin, mutant, state))
    process.start()
    process.join(limit_s)
    code = process.exitcode
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    if code is not None and code >= 0 and code - DONE not in (0, 1, 2, 3):  # passed, failed, interrupted, crashed
        raise RuntimeError(f"pytest ended with {code} for {mutant}: read {state / 'printed.txt'}")
    return code == DONE


def survives(mutant: Mutant, tests: list[Test], state: Path) -> bool:
    """Whether the quick tests that execute a mutant pass."""
    tried = selected(mutant, tests)
    files, plugin = {x.name.partition("::")[0] for x in tried}, functools.partial(_Chosen, [x.name for x in tried])
    limit_s = 60 + 5 * sum(x.seconds for x in tried)
    return not tried or run(["-x", *sorted(files)], plugin, mutant, state, limit_s)


def report(rows: list[dict[str, Any]]) -> str:
    """Kill rates among mutants with a consequence, at first and now, and what survives."""
    from touchr1_jax.bench.statistics import wilson_interval  # not where a changed source must be first

    first, last = ({Mutant(*x["mutant"]): x["outcome"] for x in order} for order in (rows[::-1], rows))
    lines = ["| | mutants | equivalent | killed at first | now | share (95 %) |", "|---|---|---|---|---|---|"]
    for area in (*PATHS, ""):
        keys = [mutant for mutant in last if mutant.path.startswith(area)]
        equal, before, now = (
            sum(of[x] == y for x in keys) for of, y in ((last, EQUAL), (first, KILLED), (last, KILLED))
        )
        if len(keys) > equal:
            rate = wilson_interval(now, len(keys) - equal)
            share = f"{rate.mean:.0%} ({rate.low:.0%} to {rate.high:.0%})"
            lines.append(f"| {area or 'all'} | {len(keys)} | {equal} | {before} | {now} | {share} |")
    lines += [f"{x.path}:{x.line}: {x.old} → {x.new}" for x in sorted(last) if last[x] == SURVIVED]
    return "\n".join(lines) + "\n"


def main(config: Config) -> None:
    """Draw the sample, try mutants without an outcome, report."""
    config.state.mkdir(parents=True, exist_ok=True)
    os.environ["TOUCHR1_TEST_PROGRAMS"] = str(config.state / "programs")
    known, log, began = config.state / "tests.jsonl", config.state / "outcomes.jsonl", time.monotonic()
    log.touch()
    if not known.exists():
        run([*TESTS], functools.partial(_Lines, known), None, config.state, 7200)
    tests = [Test(*json.loads(line)) for line in known.read_text(encoding="utf-8").splitlines()]
    found = [x for path in map(ROOT.joinpath, config.paths) for x in [path, *path.rglob("*.py")] if x.is_file()]
    every = sorted(mutant for source in found for mutant in mutants_of(source))
    drawn = random.Random(config.seed).sample(every, min(config.sample, len(every)))
    logged = lambda: [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    outcomes = {Mutant(*row["mutant"]): row["outcome"] for row in logged()}

    def attempt(mutant: Mutant) -> None:
        if (
            outcomes.get(mutant) in (None, SURVIVED if config.again else None)
            and time.monotonic() < began + 60 * config.minutes
        ):
            result = SURVIVED if survives(mutant, tests, config.state) else KILLED
            with log.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"mutant": mutant, "outcome": result}, ensure_ascii=False) + "\n")

    with ThreadPoolExecutor(config.workers) as pool:
        list(pool.map(attempt, drawn))
    rows = [row for row in logged() if Mutant(*row["mutant"]) in set(drawn)]
    sys.stdout.write(f"{len(drawn)} of {len(every)} changes\n{report(rows)}")


if __name__ == "__main__":
    main(tyro.cli(Config))
