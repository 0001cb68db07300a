"""Work in a process of its own."""

import os
from concurrent.futures.process import BrokenProcessPool

import pytest

from experiments.engine.processes import in_own_process


def report_steps(steps, progress):
    for step in range(steps):
        progress(step + 1, steps)
    return os.getpid()


def end_at_once(progress):
    progress(1, 2)
    os._exit(9)


@pytest.fixture
def heard():
    """Progress that the other process reported."""
    return []


def test_progress_arrives_before_the_answer(heard):
    assert in_own_process(report_steps, 3, progress=lambda *word: heard.append(word)) != os.getpid()
    assert heard == [(1, 3), (2, 3), (3, 3)]


@pytest.mark.long
def test_errors_come_back_and_a_process_that_ends_is_not_waited_for(heard):
    with pytest.raises(ZeroDivisionError):
        in_own_process(divmod, 1, 0)
    with pytest.raises(BrokenProcessPool):
        in_own_process(end_at_once, progress=lambda *word: heard.append(word))
    assert heard == [(1, 2)]
