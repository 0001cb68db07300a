"""`python -m sensors_io`: import recordings, generate scenes, check and list records."""

import sys
from typing import Annotated

import tyro

from sensors_io.calibration.geometry import GeometryError
from sensors_io.commands.calibrate import Calibrate
from sensors_io.commands.choices import sections, with_devices
from sensors_io.commands.console import ERR, complain
from sensors_io.commands.devices import Devices
from sensors_io.commands.extract import Extract
from sensors_io.commands.force_zero import ForceZeroing
from sensors_io.commands.generate import Generate
from sensors_io.commands.geometry import Geometry
from sensors_io.commands.imports import Import
from sensors_io.commands.label import Label, LabelsError
from sensors_io.commands.record import Record
from sensors_io.commands.records import Check, List
from sensors_io.commands.sync import Sync
from sensors_io.commands.view import View
from sensors_io.commands.zero import Zero
from sensors_io.devices.errors import DeviceError
from sensors_io.fields.sources import SourceError
from sensors_io.fields.types import CalibrationError
from sensors_io.force import ForceError
from sensors_io.importers.keep import ImportSourceError
from sensors_io.offsets import OffsetsError
from sensors_io.recording.journal import JournalError
from sensors_io.records import RecordsError
from sensors_io.schema import SchemaError

Command = (
    Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[Generate, tyro.conf.subcommand("generate")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Label, tyro.conf.subcommand("label")]
    | Annotated[Geometry, tyro.conf.subcommand("geometry")]
    | Annotated[Devices, tyro.conf.subcommand("devices")]
    | Annotated[Record, tyro.conf.subcommand("record")]
    | Annotated[Zero, tyro.conf.subcommand("zero")]
    | Annotated[ForceZeroing, tyro.conf.subcommand("force-zero")]
    | Annotated[Sync, tyro.conf.subcommand("sync")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Extract, tyro.conf.subcommand("extract")]
)

KNOWN_ERRORS = (
    RecordsError,
    SchemaError,
    ImportSourceError,
    LabelsError,
    DeviceError,
    ForceError,
    OffsetsError,
    JournalError,
    SourceError,
    CalibrationError,
    GeometryError,
    OSError,
)
"""Whose message says all that a user needs."""


def main(args: list[str] | None = None) -> int:
    """Run one command; known errors become one line on stderr and exit status 1.

    Args:
      args: the command line; None takes that of the process.
    """
    first, *others = sections(sys.argv[1:] if args is None else args)
    command = tyro.cli(Command, args=first, prog="sensors_io", config=(tyro.conf.OmitArgPrefixes,))
    try:
        return with_devices(command, others).run()
    except KNOWN_ERRORS as error:
        complain(error)
        return 1
    except KeyboardInterrupt:
        ERR.print("interrupted: run the same command again to go on")
        return 130


if __name__ == "__main__":
    sys.exit(main())
