"""Waiting for a save of which one process of several knows that it failed."""

import asyncio
import logging
import threading
import types

import jax
import pytest

from touchr1_jax.training import background_saves
from touchr1_jax.training.background_saves import failed_save, wait_for_save, without_closed_loops


@pytest.fixture(autouse=True)
def of_two_processes(monkeypatch):
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(background_saves, "_FAILED", [])


def log_failure(where, error):
    """What Orbax logs in its thread."""
    text = f"[process=1] Failed to run 3 Handler Commit operations, directory: {where}/6.orbax-checkpoint-tmp"
    record = logging.LogRecord("absl", logging.ERROR, "/orbax/a.py", 1, text, (), (type(error), error, None))
    logging.getLogger("absl").handle(record)


def test_a_failed_save_is_raised_though_orbax_waits_for_the_other_processes(tmp_path):
    barrier, full = threading.Event(), OSError("disk quota exceeded")
    stage, other = tmp_path / "sft" / "1", tmp_path / "sft" / "11"
    log_failure(other, full)
    assert failed_save(stage) is None
    wait_for_save(types.SimpleNamespace(wait_until_finished=lambda: None), stage)
    log_failure(stage, full)
    with pytest.raises(OSError, match="quota"):
        wait_for_save(types.SimpleNamespace(wait_until_finished=barrier.wait), stage)
    assert failed_save(stage) is full
    barrier.set()


def test_a_process_alone_keeps_no_errors_with_the_arrays_of_their_tracebacks(tmp_path, monkeypatch):
    """Saves of a training that tries again and again."""
    monkeypatch.setattr(jax, "process_count", lambda: 1)
    log_failure(tmp_path, OSError("disk quota exceeded"))
    assert failed_save(tmp_path) is None


def test_an_error_of_the_wait_itself_is_raised(tmp_path):
    def fail():
        raise ValueError("barrier timed out")

    with pytest.raises(ValueError, match="timed out"):
        wait_for_save(types.SimpleNamespace(wait_until_finished=fail), tmp_path)


def test_a_thread_that_finds_the_event_loop_of_a_failed_save_closed_is_not_reported():
    """A full disk made up to 173 tracebacks of one save."""
    loop = asyncio.new_event_loop()
    loop.close()
    with pytest.raises(RuntimeError) as closed:
        loop.call_soon_threadsafe(print)
    lost = [(None, closed.value), ("a callback of the user's", closed.value), (None, RuntimeError("another"))]
    lost = [types.SimpleNamespace(object=where, exc_value=error) for where, error in lost]
    reported = []
    for one in lost:
        without_closed_loops(reported.append)(one)
    assert reported == lost[1:]
