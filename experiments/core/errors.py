"""Errors whose message names the field, the value, the constraint and the fix; the runner prints them as one line."""

from sensors_io.errors import UserError


class ConfigurationError(UserError, ValueError):
    """Settings that an experiment cannot run with."""


class DataError(UserError, ValueError):
    """Data that an experiment cannot use."""


class ResultsError(ValueError):
    """Results that must not be published."""


def require(ok: bool, field: str, value: object, constraint: str, fix: str) -> None:
    """Raise `ResultsError` unless `ok`."""
    if not ok:
        raise ResultsError(f"{field} is {value!r}: {constraint}; {fix}")
