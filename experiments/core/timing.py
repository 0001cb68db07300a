"""Time of several calls, measured so that they can be compared."""

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import numpy as np


def interleaved(calls: Mapping[str, Callable[[], Any]], rounds: Iterable[object]) -> dict[str, np.ndarray]:
    """Seconds of every call in every round, [rounds] each; the calls must have run once before.

    Args:
      calls: by name.
      rounds: one round for each item: `range(9)`, or `context.rounds("timing", 9)`, which shows them.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in rounds:
        for name, call in calls.items():
            began = time.perf_counter()
            jax.block_until_ready(call())
            seconds[name].append(time.perf_counter() - began)
    return {name: np.array(s) for name, s in seconds.items()}
