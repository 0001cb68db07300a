"""Times of calls that take turns, by a clock that only they and their caller move."""

from experiments.core import timing
from experiments.core.timing import interleaved


def test_every_call_is_timed_once_in_every_round_and_nothing_between(monkeypatch):
    spent: list[float] = [0.0]
    monkeypatch.setattr(timing.time, "perf_counter", lambda: sum(spent))
    order: list[str] = []

    def taking(name: str, *seconds: float):
        left = list(seconds)

        def call() -> None:
            order.append(name)
            spent.append(left.pop(0))

        return call

    def rounds():
        for _ in range(2):
            spent.append(100.0)  # a bar is drawn
            yield

    found = interleaved({"a": taking("a", 1.0, 2.0), "b": taking("b", 10.0, 20.0)}, rounds())
    assert order == ["a", "b", "a", "b"]
    assert {name: seconds.tolist() for name, seconds in found.items()} == {"a": [1.0, 2.0], "b": [10.0, 20.0]}


def test_rounds_are_shown_while_calls_are_timed(context):
    seen = []
    interleaved({"a": lambda: seen.append(context.loops[0].completed)}, context.rounds("timing a", 3))
    assert seen == [0, 1, 2]
    assert "timing a: 3/3" in context.console.file.getvalue()
