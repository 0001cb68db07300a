"""A device that stands in, and what batches take."""

import time

import numpy as np
import pytest
from rich.console import Console

from experiments.core.context import Context
from experiments.engine.feed_supply import SimulatedDevice, idle_share, make_seconds


class SlowBatches:
    """Batches that take as long as they are told, by sleeping."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.made = seconds, 0

    def __iter__(self):
        return self

    def __next__(self):
        time.sleep(self.seconds)
        self.made += 1
        return {"x": bytes(8)}

    def get_state(self):
        return self.made

    def set_state(self, state):
        self.made = state


@pytest.fixture
def context(tmp_path):
    with_log = Context(tmp_path, tmp_path / "cache", Console(quiet=True))
    yield with_log
    with_log.close()


def test_a_device_that_is_fed_in_time_never_stands_still(context):
    assert idle_share(SlowBatches(0.0), 0.15, 6, context, "fast/0") < 0.05


def test_a_device_stands_still_for_as_long_as_its_batch_is_late(context):
    share = idle_share(SlowBatches(0.3), 0.1, 6, context, "slow/0")
    assert share == pytest.approx(1 - 0.1 / 0.3, abs=0.1)


def test_steps_queue_as_on_a_device():
    device = SimulatedDevice(0.2)
    began = time.perf_counter()
    (_, first), (_, second) = device.step(None, None), device.step(None, None)
    assert time.perf_counter() - began < 0.1
    assert not first["idle_s"].is_ready()
    assert np.asarray(second["idle_s"]) == 0
    assert time.perf_counter() - began >= 0.4
    assert first["idle_s"].is_ready()
    assert device.idle_share == 0


def test_only_work_counts_and_what_was_made_ahead_does_not():
    def batches():
        for i in range(5):
            until = time.process_time() + (10 if i > 3 else 0.5 if i < 1 else 0.05)
            while time.process_time() < until:
                pass
            time.sleep(0.1)
            yield {"x": bytes(8)}

    assert make_seconds(batches(), range(2), range(1)).cpu_s == pytest.approx(0.05, abs=0.03)
