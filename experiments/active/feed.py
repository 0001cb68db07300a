"""Batches that are drawn at random."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np


class DrawnFeed:
    """Batches made by a function of a generator of random numbers; batch t depends on the seed and t alone."""

    def __init__(self, make: Callable[[np.random.Generator], Any], seed: int) -> None:
        self._make, self._seed, self._step = make, seed, 0

    def __iter__(self) -> Iterator[Any]:
        return self

    def __next__(self) -> Any:
        rng = np.random.default_rng([self._seed, self._step])
        self._step += 1
        return self._make(rng)

    def get_state(self) -> int:
        """Number of the next batch."""
        return self._step

    def set_state(self, state: int) -> None:
        """Go to a batch."""
        self._step = state
