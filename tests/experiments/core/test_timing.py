"""Times of calls that take turns, by a clock that only they and their caller move."""

import numpy as np
import pytest

from experiments.core import timing
from experiments.core.timing import interleaved


@pytest.fixture
def clock(monkeypatch):
    """A list whose sum is the time."""
    spent: list[float] = [0.0]
    monkeypatch.setattr(timing.time, "perf_counter", lambda: sum(spent))
    return spent


def test_every_call_is_timed_once_in_every_round(clock):
    order: list[str] = []

    def taking(name: str, seconds: list[float]):
        def call() -> None:
            order.append(name)
            clock.append(seconds.pop(0))

        return call

    found = interleaved({"a": taking("a", [1.0, 2.0]), "b": taking("b", [10.0, 20.0])}, range(2))
    assert order == ["a", "b", "a", "b"]
    np.testing.assert_array_equal(found["a"], [1.0, 2.0])
    np.testing.assert_array_equal(found["b"], [10.0, 20.0])


def test_what_happens_between_rounds_is_no_time_of_a_call(clock):
    def rounds():
        for _ in range(3):
            clock.append(100.0)  # a bar is drawn
            yield

    found = interleaved({"a": lambda: clock.append(1.0)}, rounds())
    np.testing.assert_array_equal(found["a"], [1.0, 1.0, 1.0])


def test_rounds_are_shown_while_calls_are_timed(context):
    seen = []
    interleaved({"a": lambda: seen.append(context._loops[0].completed)}, context.rounds("timing a", 3))
    assert seen == [0, 1, 2]
    assert "timing a: 3/3" in context.console.file.getvalue()
