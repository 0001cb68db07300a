"""Base class of all errors that are meant for a user, and those that foreign bytes raise."""

import struct

MALFORMED = (
    ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, MemoryError, RecursionError,
    SyntaxError, struct.error,
)  # fmt: skip
"""Errors that Python and NumPy raise for bytes that another program wrote or a disk damaged; whoever reads such bytes
names the file instead.  `SyntaxError` is NumPy's for the name of a type.
"""


class UserError(Exception):
    """Its message names the field, the value, the constraint and the fix, so that a command prints it as one line."""
