"""Errors whose message says all that whoever began a run needs; the runner prints them as one line."""

from sensors_io.errors import UserError


class ConfigurationError(UserError, ValueError):
    """Settings that an experiment cannot run with; the message names the field, the value and the fix."""


class DataError(UserError, ValueError):
    """Data that an experiment cannot use; the message says what they lack."""
