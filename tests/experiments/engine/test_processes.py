"""Work in a process of its own."""

import os
from concurrent.futures.process import BrokenProcessPool

import pytest

from experiments.engine.processes import in_own_process


def told_thrice(steps, tell):
    for step in range(steps):
        tell(step + 1, steps)
    return os.getpid()


def end_at_once(tell):
    tell(1, 2)
    os._exit(9)


def test_what_is_told_there_is_heard_here_before_the_answer():
    heard: list[tuple[int, int]] = []
    process = in_own_process(told_thrice, 3, tell=lambda *word: heard.append(word))
    assert process != os.getpid()
    assert heard == [(1, 3), (2, 3), (3, 3)]


def test_errors_come_back_as_they_are():
    with pytest.raises(ZeroDivisionError):
        in_own_process(divmod, 1, 0)
    with pytest.raises(TypeError, match="takes no keyword arguments"):
        in_own_process(os.getpid, tell=print)


def test_a_process_that_ends_is_not_waited_for():
    heard: list[tuple[int, int]] = []
    with pytest.raises(BrokenProcessPool):
        in_own_process(end_at_once, tell=lambda *word: heard.append(word))
    assert heard == [(1, 2)]
