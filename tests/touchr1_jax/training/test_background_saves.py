"""Waiting for a save of which one process of several knows that it failed."""

import logging
import threading
import types

import jax
import pytest

from touchr1_jax.training import background_saves
from touchr1_jax.training.background_saves import failed_save, wait_for_save


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


def test_an_error_of_the_wait_itself_is_raised(tmp_path):
    def fail():
        raise ValueError("barrier timed out")

    with pytest.raises(ValueError, match="timed out"):
        wait_for_save(types.SimpleNamespace(wait_until_finished=fail), tmp_path)
