"""The timed job and its failing peers; the recipe for sixteen devices, counted."""

import dataclasses
from typing import get_args

import jax
import numpy as np
import pytest

from experiments.engine import scale_compiling as compiling
from experiments.engine import speed_grpo
from experiments.engine.job import Job, config_of
from experiments.engine.peers import PeerFailed, PeerTimes
from experiments.engine.processes import in_own_process
from experiments.engine.scale_paper import DEFAULT
from experiments.engine.speed import LongRun, Option, options, time_alone
from experiments.engine.speed_report import steadiness
from touchr1_jax.distributed.memory import counted_peak

TINY = speed_grpo.SMOKE.size


@pytest.mark.slow
def test_the_second_process_reads_what_the_first_compiled(tmp_path):
    """Shown by the files that one leaves and by none that the other adds."""
    measure = lambda: in_own_process(time_alone, TINY, 16, config_of(TINY), 1, tmp_path)
    measure()
    kept = sorted(p.name for p in tmp_path.rglob("*-cache"))
    measure()
    assert kept
    assert sorted(p.name for p in tmp_path.rglob("*-cache")) == kept


@pytest.mark.long
def test_seeds_share_a_program_that_serves_all_steps():
    one, two = (Job(TINY, 16, config_of(TINY), seed=seed) for seed in (0, 1))
    assert (one.batch.ids != two.batch.ids).any()
    before = jax.tree.leaves(jax.tree.map(np.array, one.state.params))
    norms = [[float(job.step()["grad_norm"]) for _ in range(2)] for job in (one, two)]
    assert norms[0] != norms[1]
    assert one.compilations == two.compilations == 1
    assert any((a != np.asarray(b)).any() for a, b in zip(before, jax.tree.leaves(one.state.params), strict=True))


def test_drift_and_growth_by_hand():
    """Steps that slow down by half, and memory that grows by 20 MB."""
    seconds = np.concatenate([np.full(500, 1.0), np.full(500, 1.5), np.full(1000, 9.0)])
    long = LongRun(seconds=seconds, resident_mb=np.array([100.0, 110.0, 120.0]), lengths=(2.0, 9.0), programs=1)
    time, memory, programs = steadiness(long)
    assert (time.measured, time.met) == (1.5, False)  # judged by the first thousand
    assert (memory.measured, memory.met) == (20.0, False)
    assert programs.met


@dataclasses.dataclass(frozen=True)
class FailingPeer:
    """An engine that fails past a prefix."""

    name: str
    most: int

    def measure(self, job):
        if job.prefix > self.most:
            raise PeerFailed(f"{self.name} ended with -9", -9)
        return PeerTimes(seconds=(1.0,), first_s=2.0, peak_gb=0.5, versions={})


def test_an_engine_that_fails_at_a_long_prefix_costs_no_other_figure(context):
    config = dataclasses.replace(speed_grpo.SMOKE, prefixes=(16, 32))
    peers = FailingPeer("Short", 16), FailingPeer("Long", 32)
    found, failed = speed_grpo.measure_peers(config, peers, context)
    assert list(found) == [("Short", 16), ("Long", 16), ("Long", 32)]
    assert failed == ("Short has no figure at 32: its process ended with -9.",)
    with pytest.raises(PeerFailed, match="None ended with -9"):
        speed_grpo.measure_peers(config, [FailingPeer("None", 0)], context)


def test_the_paper_fits_by_count_and_adapters_need_less():
    first, adapters, *_ = DEFAULT.setups
    whole, lean = (DEFAULT.training.counted(setup) for setup in (first, adapters))
    assert DEFAULT.training.prompt.tokens == 4 * 1024 + 256 + 128
    assert whole["parameters"] == pytest.approx(4 * 7.616e9 / 16, rel=1e-3)
    assert counted_peak(lean) + 2.5 * whole["parameters"] < counted_peak(whole) < DEFAULT.machine.memory_bytes / 2


def test_without_nvidias_compiler_the_error_names_the_packages_to_install():
    with pytest.raises(ModuleNotFoundError, match=r"compiler is h200, but there is no nvidia\.absent: install"):
        compiling.toolkit("nvidia.absent")


@pytest.fixture(scope="module")
def jobs():
    """Every option, small, after one step each."""
    every = options(TINY, 16, (4,), get_args(Option))
    return {name: (job, jax.device_get(job.step())) for name, job in ((name, make()) for name, make in every.items())}


@pytest.mark.slow
def test_options_change_the_cost_and_not_the_step(jobs):
    """Rewards in the graph and on the host, one micro-batch or several, weights of an exact sampler, rematerialised."""
    plain = jobs["this"][1]
    for name in ("one micro-batch", "remat", "lean compilation", "importance weights", "host reward"):
        assert jobs[name][1]["reward"] == pytest.approx(float(plain["reward"]), rel=1e-6), name
        assert jobs[name][1]["grad_norm"] == pytest.approx(float(plain["grad_norm"]), rel=1e-4), name
    assert jobs["bfloat16"][1]["grad_norm"] == pytest.approx(float(plain["grad_norm"]), rel=0.2)
    short, cut = jobs["short answers"][1], jobs["short answers, buckets"][1]
    assert short["length"] < TINY.length
    assert cut["grad_norm"] == pytest.approx(float(short["grad_norm"]), rel=1e-4)
