"""`python -m sensors_io`: import recordings, generate scenes, check and list records, watch and record sensors."""

import ast
import difflib
import importlib
import os
import pathlib
import sys
from collections.abc import Iterator, Mapping
from typing import Any

from sensors_io.errors import UserError, require_words
from sensors_io.signals import end_as_interrupted, leave_interrupted, say

PROG = "python -m sensors_io"

COMMANDS: Mapping[str, str] = {
    "import": "imports.Import",
    "generate": "generate.Generate",
    "check": "check.Check",
    "list": "list.List",
    "reindex": "reindex.Reindex",
    "push": "push.Push",
    "export": "export.Export",
    "label": "label.Label",
    "devices": "devices.Devices",
    "view": "view.View",
    "record": "record.Record",
    "snap": "snap.Snap",
    "calibrate": "calibrate.Calibrate",
    "geometry": "geometry.MeasureGeometry",
    "extract": "extract.Extract",
    "zero": "zero.Zero",
    "force-zero": "force_zero.ForceZeroing",
    "sync": "sync.Sync",
    "ros2": "ros2.Ros2",
}
"""Module and class of each, in `sensors_io.commands`.

The one that is asked for is imported alone: all together take seconds.
"""

PLUS = "+"
"""Stands between devices."""


def main(args: list[str] | None = None) -> int:
    """Run one command; known errors become one line on stderr and exit status 1, signals, also during imports, 128 + n.

    Args:
      args: the command line; None takes that of the process.
    """
    try:
        return _run(sys.argv[1:] if args is None else args)
    except KeyboardInterrupt as error:
        return leave_interrupted(error, "interrupted: run the same command again to resume")
    except OSError as error:  # of help or an error that cannot be printed
        say(
            f"{type(error).__name__}: {error}: let standard output and standard error lead to something that takes text"
        )
        return 1


def _run(args: list[str]) -> int:
    # before NumPy is loaded: its matrices are small here, and on a busy machine a second thread costs `calibrate` six
    # times the processor time and, by another order of sums, other bits
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from sensors_io.commands.console import ERR, OUT, complain, print_in_any_encoding

    print_in_any_encoding()
    if not args or args[0] in ("-h", "--help"):
        OUT.print("\n".join(usage()), markup=False, highlight=False, soft_wrap=True)
        return 0 if args else 2
    if args[0] not in COMMANDS:
        close = difflib.get_close_matches(args[0], COMMANDS)
        asked = f" Did you mean {' or '.join(close)}?" if close else ""
        lines = [f"There is no command {args[0]!r}.{asked}", *usage()]
        ERR.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
        return 2
    from sensors_io.commands.values import require_possible

    try:
        try:
            require_words(args)
            command = read(args)
            require_possible(command)
        except ValueError as error:  # a configuration refuses its own values
            complain(error)
            return 2
        return command.run()
    except (UserError, OSError) as error:
        complain(error)
        return 1


def read(args: list[str]) -> Any:
    """The command that a command line asks for, ready to run.

    Raises:
      SystemExit: code 2 after an answer to what is not understood, 0 after help.
      DeviceNotFoundError: devices for a command that takes none.
    """
    import tyro

    first, *others = _sections(args[1:])
    module, _, kind = COMMANDS[args[0]].partition(".")
    made = getattr(importlib.import_module(f"sensors_io.commands.{module}"), kind)
    command = tyro.cli(made, args=first, prog=f"{PROG} {args[0]}", config=(tyro.conf.OmitArgPrefixes,))
    if not others:
        return command
    from sensors_io.commands.choices import with_devices  # every device's code, of use to commands on devices alone

    return with_devices(command, others)


def usage() -> Iterator[str]:
    """Usage, and every command with the first line of its description."""
    yield f"usage: {PROG} COMMAND …       {PROG} COMMAND --help"
    width = max(map(len, COMMANDS))
    for name, place in COMMANDS.items():
        module, _, kind = place.partition(".")
        source = pathlib.Path(__file__).with_name("commands") / f"{module}.py"
        tree = ast.parse(source.read_text(encoding="utf-8"))
        [found] = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == kind]
        yield f"  {name:<{width}}  {(ast.get_docstring(found) or '').partition(chr(10))[0]}"


def _sections(args: list[str]) -> list[list[str]]:
    """Arguments, cut at every +."""
    found: list[list[str]] = [[]]
    for arg in args:
        if arg == PLUS:
            found.append([])
        else:
            found[-1].append(arg)
    return found


if __name__ == "__main__":
    end_as_interrupted()
    sys.exit(main())
