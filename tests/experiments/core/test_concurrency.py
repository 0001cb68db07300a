"""Several seeds at a time: results, log and stops are those of one after the other."""

import contextlib
import resource
import signal
import threading
import time

import grain
import jax.numpy as jnp
import pytest
from rich.console import Console

from experiments.core.concurrency import concurrently, idle_cores
from experiments.core.context import Context
from experiments.core.loops import run_loop
from experiments.core.stopping import Stopped, Stopping
from touchr1_jax.training.loop import LoopConfig


def open_run(folder, stopping=None) -> Context:
    folder.mkdir(exist_ok=True)
    return Context(folder, folder, Console(quiet=True), stopping=stopping)


def add_up(context, seed, steps=6, at_step=lambda seed, step: None) -> float:
    """A stage of a seed that adds up the batches, slower for the first seed, so that later seeds log before it."""

    def step(state, batch):
        at_step(seed, batch)
        time.sleep(0.02 if seed == 0 else 0.001)
        total = state["total"] + batch + seed
        return {"total": total}, {"total": total}

    loop = LoopConfig(steps=steps, save_every=2)
    numbers = iter(grain.MapDataset.range(steps).to_iter_dataset(grain.ReadOptions(num_threads=0)))
    return float(run_loop(step, {"total": jnp.float32(0)}, numbers, loop, context, f"sum/{seed}")["total"])


def train(folder, at_once, seeds=3) -> tuple[list[float], bytes]:
    with contextlib.closing(open_run(folder)) as context:
        found = concurrently(context, "seeds", range(seeds), lambda seed: add_up(context, seed), at_once=at_once)
    return found, (folder / "metrics.jsonl").read_bytes()


@pytest.mark.long
def test_results_and_log_do_not_depend_on_how_many_run_at_once(tmp_path):
    apart, log = train(tmp_path / "one", 1)
    assert apart == [15.0, 21.0, 27.0]
    for at_once in (2, 3):
        assert train(tmp_path / str(at_once), at_once) == (apart, log)


def test_items_do_run_at_once(tmp_path):
    """Each waits for the other: one after the other would wait for ever."""
    both = threading.Barrier(2, timeout=20)
    with contextlib.closing(open_run(tmp_path)) as context:
        assert sorted(concurrently(context, "seeds", (0, 1), lambda _: both.wait(), at_once=2)) == [0, 1]


def test_the_first_step_of_a_program_is_one_thread_s(tmp_path):
    """The second thread finds the program compiled; later steps of both may overlap."""
    active, most = [], []

    def at_step(seed, step):
        if step == 0:
            active.append(seed)
            most.append(len(active))
            time.sleep(0.05)
            active.remove(seed)

    with contextlib.closing(open_run(tmp_path)) as context:
        concurrently(context, "seeds", range(3), lambda seed: add_up(context, seed, at_step=at_step), at_once=3)
    assert most == [1, 1, 1]


def test_an_error_of_one_ends_the_others_after_their_step(tmp_path):
    """The error comes once the other seed is in its loop, which would take a minute."""
    begun = threading.Event()

    def work(seed):
        if seed == 1:
            assert begun.wait(20)
            raise ZeroDivisionError("seed 1")
        return add_up(context, seed, steps=3000, at_step=lambda *_: begun.set())

    with contextlib.closing(open_run(tmp_path)) as context:
        with pytest.raises(ZeroDivisionError, match="seed 1"):
            concurrently(context, "seeds", range(3), work, at_once=2)
        assert not context.in_threads
        assert concurrently(context, "again", (2,), lambda seed: add_up(context, seed)) == [27.0]


@pytest.mark.long
def test_a_signal_ends_all_after_their_step_and_the_run_resumes_with_the_same_bits(tmp_path):
    _, log = train(tmp_path / "whole", 1)
    stopping, struck = Stopping(), []

    def strike(seed, step):
        if seed == 0 and step == 2 and not struck:
            struck.append(signal.raise_signal(signal.SIGTERM))

    with (
        pytest.raises(Stopped, match="SIGTERM"),
        contextlib.closing(open_run(tmp_path / "stopped", stopping)) as context,
        stopping.listening(),
    ):
        concurrently(context, "seeds", range(3), lambda seed: add_up(context, seed, at_step=strike), at_once=2)
    assert train(tmp_path / "stopped", 2)[1] == log


def test_processes_meshes_and_little_memory_train_one_seed_after_the_other(tmp_path):
    with contextlib.closing(open_run(tmp_path)) as context:
        assert idle_cores(context) >= 1
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        try:
            resource.setrlimit(resource.RLIMIT_AS, (5 * 2**30, hard))  # memory for one seed
            assert idle_cores(context) == 1
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        context.devices.shape = (2, 1, 1)
        assert idle_cores(context) == 1
