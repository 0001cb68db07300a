"""`python -m experiments.bench`: make, annotate, audit and score the questions of the touch bench."""

import sys
from typing import Annotated

import tyro

from experiments.bench.card import CardError
from experiments.bench.commands import (
    Accept,
    Annotate,
    AnnotateSheets,
    Audit,
    AuditSheet,
    GenerateItems,
    Propose,
    Score,
)
from experiments.bench.contacts import ContactError
from experiments.bench.draw import QuotaError
from experiments.bench.sheets import SheetError
from sensors_io.commands.console import complain
from sensors_io.errors import UserError
from touchr1_jax.bench.items import ItemError
from touchr1_jax.bench.json_lines import LinesError

Command = (
    Annotated[GenerateItems, tyro.conf.subcommand("generate")]
    | Annotated[Propose, tyro.conf.subcommand("propose")]
    | Annotated[Accept, tyro.conf.subcommand("accept")]
    | Annotated[Score, tyro.conf.subcommand("score")]
    | Annotated[AnnotateSheets, tyro.conf.subcommand("annotate-sheets")]
    | Annotated[Annotate, tyro.conf.subcommand("annotate")]
    | Annotated[AuditSheet, tyro.conf.subcommand("audit-sheet")]
    | Annotated[Audit, tyro.conf.subcommand("audit")]
)

KNOWN_ERRORS = (
    CardError,
    QuotaError,
    ContactError,
    ItemError,
    LinesError,
    SheetError,
    UserError,
    OSError,
)
"""Whose message says all that a user needs."""


def main(arguments: list[str] | None = None) -> int:
    """Run one command; known errors become one line on stderr and exit status 1.

    Args:
      arguments: the command line; None takes that of the process.
    """
    command = tyro.cli(Command, args=arguments, prog="experiments.bench", config=(tyro.conf.OmitArgPrefixes,))
    try:
        return command.run()
    except KNOWN_ERRORS as error:
        complain(error)
        return 1


if __name__ == "__main__":
    sys.exit(main())
