"""The error of everything that must not be published."""


class ResultsError(ValueError):
    """Results that must not be published; the message names the field, the value, the constraint and the fix."""


def require(ok: bool, field: str, value: object, constraint: str, fix: str) -> None:
    """Raise `ResultsError` unless `ok`."""
    if not ok:
        raise ResultsError(f"{field} is {value!r}: {constraint}; {fix}")
