"""Base class of all errors that are meant for a user, and those that foreign bytes raise."""

import errno
import os
import re
import struct
from collections.abc import Sequence

MALFORMED = (
    ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, MemoryError, RecursionError,
    SyntaxError, struct.error,
)  # fmt: skip
"""Errors that Python and NumPy raise for bytes that another program wrote or a disk damaged; whoever reads such bytes
names the file instead.  `SyntaxError` is NumPy's for the name of a type.
"""

_OF_SYSTEM = {errno.EMFILE, errno.ENFILE, errno.EIO, errno.ENOMEM, errno.EACCES, errno.ESTALE, errno.ETIMEDOUT}


def of_system(error: BaseException) -> bool:
    """True of an error that says nothing about a file's bytes: it could not be read here and now."""
    return isinstance(error, OSError) and error.errno in _OF_SYSTEM


def name_and_text(error: BaseException) -> str:
    """Name and text of an error; its `repr` may hold the whole file that it could not decode."""
    return f"{type(error).__name__}: {error}"


class UserError(Exception):
    """Its message names the field, the value, the constraint and the fix, so that a command prints it as one line."""


def require_words(args: Sequence[str]) -> None:
    """Refuse an empty word of a command line, which as a path would be the current folder, and ~ for the home folder.

    Raises:
      ValueError: naming the option before it.
    """
    for before, word in zip(["", *args], args, strict=False):
        if not word or (word.startswith("--") and word.endswith("=")):
            option = word.removesuffix("=") or (before if before.startswith("--") else "an argument")
            raise ValueError(f"{option} is '': must not be empty; give its value, or leave it out")
        path = word.partition("=")[2] if word.startswith("--") else word
        if path == "~" or path.startswith("~/"):  # as in --out=~/records: a folder called ~ would be made here
            raise ValueError(f"{word}: the shell leaves this ~ as it is; write the whole path, such as $HOME/…")


def require_kept(args: Sequence[str]) -> None:
    """Refuse a URL in the memory of this process: what is written there is lost when the process ends.

    Raises:
      ValueError: naming it.
    """
    for word in args:
        if re.match(r"(--[\w.-]+=)?memory:/", word):
            raise ValueError(f"{word}: is kept in the memory of this process alone; name a folder, or another URL")


def path_text(path: str | os.PathLike[str]) -> str:
    """A path as text for OpenCV, which crashes where a name is not UTF-8.

    Raises:
      UserError: it is not.
    """
    text = os.fspath(path)
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise UserError(f"path is {text!r}: must be UTF-8; rename it") from error
    return text
