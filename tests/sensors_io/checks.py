"""Checks that many tests share."""

from collections.abc import Callable
from typing import Any

import pytest


def refused(
    error: type[Exception] | tuple[type[Exception], ...],
    match: str,
    call: Callable[..., Any],
    /,
    *args: Any,
    **kwargs: Any,
) -> None:
    """A call raises an error whose message matches a pattern: the field, its value, the fix."""
    with pytest.raises(error, match=match):
        call(*args, **kwargs)
