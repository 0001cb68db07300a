"""Every command that the documents and the experiments' docstrings show is one that the command line understands."""

import ast
import importlib
import itertools
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import tyro

from experiments.ask.command import AskingCommand
from experiments.bench.__main__ import Command as Bench
from experiments.core.commands import ASKING, COMMANDS, SWEEP, Command, find
from experiments.core.runner import parse
from experiments.core.sweep import SweepCommand
from sensors_io.__main__ import read as sensors_command
from touchr1_jax.models.load import Load
from touchr1_jax.rewards.__main__ import Command as Rewards

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("touchr1_jax", "sensors_io", "experiments")
DOCUMENTS = [ROOT / "README.md", *(ROOT / ".github").glob("*.md"), *(ROOT / p / "README.md" for p in PACKAGES)]
DOCUMENTS += [ROOT / "experiments" / name for name in ("TUTORIAL.md", "REPRODUCTION.md", "LOG.md")]
DOCUMENTS += sorted(path for kind in ("*.md", "*.ipynb") for path in (ROOT / "docs").rglob(kind))
DOCUMENTS += sorted((ROOT / "touchr1_jax" / "policies").glob("*/README.md"))
EXPERIMENTS = find("experiments")

MODULE = re.compile(r"^(?:    )?(?:.*`)?python -m ((?:experiments|sensors_io|touchr1_jax)[\w.]*) ?([^`\n]*)", re.M)
MAKE = re.compile(r"make experiment EXP=(\w+)(?: \[?ARGS=\"([^\"]*)\")?")
STANDS_FOR = {"D": "6.3", "S": "0.06", "N": "2", "I": "1", "MASS_KG": "0.1"}
"""Capital letters of the documents where the command line wants numbers."""

WRITTEN_BY_TUTORIAL = {"brevity"}


def shown(text: str) -> Iterator[tuple[str, str]]:
    """Module and arguments of every command in a text, lines that end in \\ joined; `a|b` counts as two commands."""
    text = re.sub(r"\s*\\\n\s*", " ", text)
    for module, rest in MODULE.findall(text):
        yield from ((module, arguments) for arguments in choices(re.split(r"\s{2,}|\s#", rest)[0]))
    for name, rest in MAKE.findall(text):
        yield from (("experiments", f"{name} {arguments}") for arguments in choices(rest))


def choices(arguments: str) -> list[str]:
    """The command lines that brackets and bars stand for."""
    words = [word.split("|") for word in shlex.split(arguments.replace("[", "").replace("]", "").replace("...", ""))]
    return [shlex.join(words) for words in itertools.product(*words)]


def status(module: str, arguments: str) -> object:
    """Exit status of parsing a command line: 2 where it is not understood, 0 after help."""
    try:
        read(module, arguments)
    except SystemExit as end:
        return end.code
    return 0


def read(module: str, arguments: str) -> None:
    """Parse a command line; `SystemExit` and every error of a configuration come out."""
    words = [STANDS_FOR.get(word, word) for word in shlex.split(arguments)]
    if module == "sensors_io":
        if words[0] not in ("-h", "--help"):
            sensors_command(words)
    elif module == "experiments" and words[0] in EXPERIMENTS:
        parse(importlib.import_module(EXPERIMENTS[words[0]].module).EXPERIMENT, words[1:], "")
    elif module == "experiments" and words[0] not in {"NAME", "EXPERIMENT", *WRITTEN_BY_TUTORIAL}:
        assert words[0] in COMMANDS, f"there is no experiment {words[0]!r}"
        if words[0] == SWEEP:
            tyro.cli(SweepCommand, args=words[1:], return_unknown_args=True)
            return
        kind: object = AskingCommand if words[0] in ASKING else Command
        tyro.cli(kind, args=words, config=(tyro.conf.OmitArgPrefixes,))
    elif module == "touchr1_jax.models.load":
        tyro.cli(Load, args=words)
    elif module in ("experiments.bench", "touchr1_jax.rewards"):
        kind = Bench if module == "experiments.bench" else Rewards
        tyro.cli(kind, args=words, config=(tyro.conf.OmitArgPrefixes,))
    else:
        importlib.import_module(module)


def test_commands_are_found():
    text = (
        "    python -m sensors_io list RECORDS   # what\nor `python -m experiments list x`, `make experiment EXP=a`\n"
    )
    text += '    make experiment EXP=b [ARGS="--scale smoke|gpu"]\n    python -m experiments c [--scale smoke]\n'
    assert list(shown(text)) == [
        ("sensors_io", "list RECORDS"),
        ("experiments", "list x"),
        ("experiments", "c --scale smoke"),
        ("experiments", "a "),
        ("experiments", "b --scale smoke"),
        ("experiments", "b --scale gpu"),
    ]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_of_the_documents_are_understood(document):
    for module, arguments in shown(document.read_text(encoding="utf-8")):
        assert status(module, arguments) == 0, f"python -m {module} {arguments}"


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_commands_of_an_experiment_are_understood(name):
    source = ROOT / Path(*EXPERIMENTS[name].module.split(".")).with_suffix(".py")
    about = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""
    commands = list(shown(about))
    assert any(arguments.split()[0] == name for _, arguments in commands), "its docstring shows no command"
    for module, arguments in commands:
        assert status(module, arguments) == 0, f"python -m {module} {arguments}"


INTERRUPTED = """
import runpy, signal, sys
_, module, imported = sys.argv
sys.argv[1:] = ["list"]
class Strike:
    def find_spec(self, name, path=None, target=None):
        if name == imported:
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Strike())
signal.signal(signal.SIGINT, signal.default_int_handler)
runpy.run_module(module, run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize(
    ("module", "imported"),
    [
        ("experiments", "experiments.core.commands"),
        ("experiments.bench", "experiments.bench.contacts"),
        ("sensors_io", "sensors_io.commands.console"),
        ("touchr1_jax.rewards", "touchr1_jax.rewards.proof"),
    ],
)
def test_ctrl_c_while_a_command_is_imported_is_no_traceback(module, imported):
    ended = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, module, imported], capture_output=True, text=True, check=False
    )
    assert ended.returncode in (128 + signal.SIGINT, -signal.SIGINT)
    assert "Traceback" not in ended.stderr
