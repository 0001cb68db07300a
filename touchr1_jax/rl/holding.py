"""Weights that a loop reads over and over, held where it reads them.

Sampling reads all weights for every token.  Where they are split among devices to be gathered where they are used, that
would be as many exchanges as tokens; whoever splits them says here how one exchange before the loop makes them whole.
"""

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar

from touchr1_jax.types import Params

Hold = Callable[[Params], Params]

_hold: ContextVar[Hold] = ContextVar("hold", default=lambda params: params)


def held(params: Params) -> Params:
    """The parameters as a loop reads them: as they are, unless the code runs inside `holding`."""
    return _hold.get()(params)


@contextlib.contextmanager
def holding(hold: Hold) -> Iterator[None]:
    """Within this context `held` does `hold`."""
    before = _hold.set(hold)
    try:
        yield
    finally:
        _hold.reset(before)
