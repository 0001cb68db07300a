"""The timed job, its options, and the experiment, shrunken."""

import dataclasses
from typing import get_args

import jax
import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.engine import speed_grpo
from experiments.engine.job import Job, config_of, init_decoder, make_batch, make_fns
from experiments.engine.peers import JobSize, PeerFailed, PeerTimes
from experiments.engine.processes import in_own_process
from experiments.engine.speed import LongRun, Option, many_steps, options, time_alone
from experiments.engine.speed_report import steadiness
from tests.experiments.shrunk import run_shrunk

TINY = speed_grpo.SMOKE.size


def test_a_run_too_short_for_a_look_at_the_memory_is_refused():
    with pytest.raises(ValueError, match="steps is 4: must be at least 100"):
        speed_grpo.SpeedConfig(steps=4)


def test_the_decoder_has_its_advertised_size():
    fns, batch = make_fns(JobSize(), 64), make_batch(JobSize(), 64, 1)
    assert sum(x.size for x in jax.tree.leaves(init_decoder(fns, batch))) == 1_050_752


@pytest.mark.slow
def test_the_second_process_reads_what_the_first_compiled(tmp_path):
    """Shown by the files that one leaves and by none that the other adds."""
    measure = lambda: in_own_process(time_alone, TINY, 16, config_of(TINY), 1, tmp_path)
    measure()
    kept = sorted(p.name for p in tmp_path.rglob("*-cache"))
    measure()
    assert kept
    assert sorted(p.name for p in tmp_path.rglob("*-cache")) == kept


@pytest.fixture(scope="module")
def jobs():
    """Every option, small, after one step each."""
    every = options(TINY, 16, (4,), get_args(Option))
    return {name: (job, jax.device_get(job.step())) for name, job in ((name, make()) for name, make in every.items())}


@pytest.mark.slow
def test_the_repeated_way_does_the_same_number_of_rollouts():
    job = Job(TINY, 16, config_of(TINY), repeated=True)
    metrics = jax.device_get(job.step())
    assert job.batch.ids.shape == (TINY.prompts * TINY.group, 16)
    assert metrics["length"] == TINY.length
    assert np.isfinite(metrics["loss"])


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


def test_seeds_share_a_program_that_serves_all_steps():
    one, two = (Job(TINY, 16, config_of(TINY), seed=seed) for seed in (0, 1))
    assert (one.batch.ids != two.batch.ids).any()
    before = jax.tree.leaves(jax.tree.map(np.array, one.state.params))
    norms = [[float(job.step()["grad_norm"]) for _ in range(2)] for job in (one, two)]
    assert norms[0] != norms[1]
    assert one.compilations == two.compilations == 1
    assert any((a != np.asarray(b)).any() for a, b in zip(before, jax.tree.leaves(one.state.params), strict=True))


@pytest.mark.slow
def test_many_steps_take_every_length_in_one_program():
    size = dataclasses.replace(speed_grpo.LONG_SIZE, vocab_size=16, hidden_size=16)
    reported: list[tuple[int, int]] = []
    long = many_steps(size, 16, (4, 8), 200, lambda *word: reported.append(word))
    assert reported == [(100, 200), (200, 200)]
    assert long.seconds.shape == (200,)
    assert long.resident_mb.shape == (2,)
    assert long.programs == 1
    assert long.lengths[0] < size.length


def test_drift_and_growth_by_hand():
    """Steps that slow down by half, and memory that grows by 20 MB."""
    seconds = np.concatenate([np.full(500, 1.0), np.full(500, 1.5), np.full(1000, 9.0)])
    long = LongRun(seconds=seconds, resident_mb=np.array([100.0, 110.0, 120.0]), lengths=(2.0, 9.0), programs=1)
    time, memory, programs = steadiness(long)
    assert (time.measured, time.met) == (1.5, False)  # judged by the first thousand
    assert (memory.measured, memory.met) == (20.0, False)
    assert programs.met


@pytest.mark.slow
def test_the_experiment_reports_every_prefix(tmp_path):
    small = dataclasses.replace(speed_grpo.SMOKE, prefixes=(16,), words=256)
    directory = run_shrunk(speed_grpo, small, tmp_path)
    results = read_json(directory / "results.json")
    assert [row[0] for row in results["tables"][0]["rows"]] == [16]
    names = {row[0] for row in results["tables"][1]["rows"]}
    assert names == {"this", "importance weights", "short answers, buckets"}
    assert {p.name for p in (directory / "plots").iterdir()} == {"prefixes.svg", "steps.svg"}
    measured = {r["name"]: r["measured"] for r in results["requirements"]}
    assert measured["programs for one shape"] == measured["programs for all lengths"] == 1


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
