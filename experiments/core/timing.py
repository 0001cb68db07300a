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


def median_ms(calls: Mapping[str, Callable[[], Any]], rounds: Iterable[object]) -> dict[str, float]:
    """Milliseconds of every call, median over interleaved rounds; each call is first run once without timing."""
    for call in calls.values():
        jax.block_until_ready(call())
    return {name: 1e3 * float(np.median(s)) for name, s in interleaved(calls, rounds).items()}
