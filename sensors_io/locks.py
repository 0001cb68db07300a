"""The lock of a folder that one process at a time writes to."""

import fcntl
import pathlib
from typing import IO

from sensors_io.codec import RecordsError


class RecordsExistError(RecordsError):
    """Records that are already there, or that somebody else is writing."""


class RecordsBusyError(RecordsExistError):
    """Records, or pictures for a calibration, that somebody else is writing."""


def write_lock(root: pathlib.Path) -> IO[str]:
    """An advisory lock on the directory, until it is closed or the process dies.

    Raises:
      RecordsBusyError: another process holds it.
    """
    file = (root / ".lock").open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise RecordsBusyError(
            f"{root} is being written by another process; wait for it or choose another path"
        ) from error
    except OSError:  # of a file system without locks
        file.close()
        raise
    return file
