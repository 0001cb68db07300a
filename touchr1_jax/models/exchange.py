"""Two folders exchange their names in one step, where the system can."""

import ctypes
import os
from pathlib import Path

_SWAP = 2  # RENAME_EXCHANGE of Linux and RENAME_SWAP of macOS
_HERE = -100  # AT_FDCWD: paths begin at the working directory


def exchanged(a: Path, b: Path) -> bool:
    """Exchange two paths of one file system; False, and nothing is changed, where it cannot be done in one step."""
    library = ctypes.CDLL(None)
    from_, to = os.fsencode(a), os.fsencode(b)
    if hasattr(library, "renameat2"):
        return library.renameat2(_HERE, from_, _HERE, to, _SWAP) == 0
    return hasattr(library, "renamex_np") and library.renamex_np(from_, to, _SWAP) == 0
