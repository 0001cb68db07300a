"""Records back from an export, whichever format it has."""

import contextlib
import pathlib

from sensors_io.exporters.arrays import read_arrays
from sensors_io.exporters.lerobot import OURS, read_lerobot
from sensors_io.exporters.selection import ExportError, Progress, damage_named, write_back


def import_exported(path: pathlib.Path, out: pathlib.Path, progress: Progress) -> None:
    """Write the records that `export` wrote to a LeRobotDataset, a Zarr folder or an HDF5 file.

    Args:
      path: of the export.
      out: directory of the records; an interrupted import goes on.
      progress: called with the number of contacts done and their total.

    Raises:
      ExportError: it is no export of records, or damaged, or a library is not installed.
      RecordsExistError: `out` holds other records.
    """
    if not path.exists():
        raise ExportError(f"{path} does not exist: must be a folder or file that `export` wrote; correct the path")
    if out.resolve().is_relative_to(path.resolve()):
        raise ExportError(f"--out is {out}: is the export itself, or lies in it; name another folder")
    with contextlib.ExitStack() as stack:
        with damage_named(path):
            lerobot = (path / OURS).is_dir()
            found = read_lerobot(path) if lerobot else stack.enter_context(read_arrays(path))
        write_back(path, found, out, progress)
