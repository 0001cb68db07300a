"""`python -m sensors_io`: import recordings, generate scenes, check and list records."""

import sys
from typing import Annotated

import tyro

from sensors_io.commands.console import ERR, complain
from sensors_io.commands.generate import Generate
from sensors_io.commands.imports import Import
from sensors_io.commands.records import Check, List
from sensors_io.importers.physiclear import ImportSourceError
from sensors_io.records import RecordsError
from sensors_io.schema import SchemaError

Command = (
    Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[Generate, tyro.conf.subcommand("generate")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[List, tyro.conf.subcommand("list")]
)


def main(args: list[str] | None = None) -> int:
    """Run one command; known errors become one line on stderr and exit status 1.

    Args:
      args: the command line; None takes that of the process.
    """
    command = tyro.cli(Command, args=args, prog="sensors_io", config=(tyro.conf.OmitArgPrefixes,))
    try:
        return command.run()
    except (RecordsError, SchemaError, ImportSourceError, OSError) as error:
        complain(error)
        return 1
    except KeyboardInterrupt:
        ERR.print("interrupted: run the same command again to go on")
        return 130


if __name__ == "__main__":
    sys.exit(main())
