"""The timed job computes what it says, and the experiment reports it."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments import speed_grpo
from experiments.grpo.job import Job, Size, config_of, init_decoder, make_agent, make_batch
from experiments.running.artifacts import read_json
from experiments.running.runner import main

TINY = speed_grpo.SMOKE.size


def test_the_decoder_has_its_advertised_size():
    agent, batch = make_agent(Size(), 64), make_batch(Size(), 64, 1)
    assert sum(x.size for x in jax.tree.leaves(init_decoder(agent, batch))) == 1_050_752


def test_work_by_hand():
    """One layer of width 2 with one head of 2, MLP 2, vocabulary 2: 16 + 12 weights, 4 to the vocabulary."""
    size = Size(
        prompts=1,
        group=1,
        length=1,
        vocab_size=2,
        hidden_size=2,
        num_layers=1,
        num_heads=1,
        num_kv_heads=1,
        head_dim=2,
        intermediate_size=2,
    )
    weights, pair = 8 + 8 + 12, 4
    prompt, completion = 3 * weights + pair * 6, weights + 4 + pair * (3 + 1)
    assert size.gflop(3) == pytest.approx(2 * 5 * (prompt + completion) / 1e9)
    assert size.gflop(3, 0.0) == pytest.approx(2 * 4 * (prompt + completion) / 1e9)


@pytest.mark.slow
def test_the_second_process_reads_what_the_first_compiled(tmp_path):
    """Shown by the files that one leaves and by none that the other adds."""
    small = dataclasses.replace(speed_grpo.SMOKE, rounds=1)
    speed_grpo.in_own_process(speed_grpo.time_alone, small, 16, tmp_path)
    kept = sorted(p.name for p in tmp_path.glob("*-cache"))
    speed_grpo.in_own_process(speed_grpo.time_alone, small, 16, tmp_path)
    assert kept
    assert sorted(p.name for p in tmp_path.glob("*-cache")) == kept


def test_the_repeated_way_does_the_same_number_of_rollouts():
    job = Job(TINY, 16, config_of(TINY), repeated=True)
    metrics = jax.device_get(job.step())
    assert job.batch.ids.shape == (TINY.prompts * TINY.group, 16)
    assert metrics["length"] == TINY.length
    assert np.isfinite(metrics["loss"])


def test_the_reward_on_the_host_is_the_one_in_the_graph():
    inside, outside = (jax.device_get(Job(TINY, 16, config_of(TINY), host=host).step()) for host in (False, True))
    assert outside["reward"] == pytest.approx(float(inside["reward"]), rel=1e-6)
    assert outside["grad_norm"] == pytest.approx(float(inside["grad_norm"]), rel=1e-4)


def test_one_program_serves_all_steps():
    job = Job(TINY, 16, config_of(TINY))
    before = jax.tree.map(np.array, job.state.params)
    for _ in range(3):
        job.step()
    assert job.compilations == 1
    assert any(
        (a != np.asarray(b)).any() for a, b in zip(*map(jax.tree.leaves, (before, job.state.params)), strict=True)
    )


@pytest.mark.slow
def test_the_experiment_reports_every_prefix(tmp_path):
    small = dataclasses.replace(speed_grpo.SMOKE, prefixes=(16,), flat_steps=12, rounds=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speed_grpo, "EXPERIMENT", dataclasses.replace(speed_grpo.EXPERIMENT, config=small))
        patch.setattr(speed_grpo, "in_own_process", lambda work, config, prefix, cache: work(config, prefix, None))
        assert main(["speed_grpo", "--runs-dir", str(tmp_path)]) == 0
    (directory,) = (p for p in (tmp_path / "speed_grpo").iterdir() if not p.is_symlink())
    results = read_json(directory / "results.json")
    assert [row[0] for row in results["tables"][0]["rows"]] == [16]
    names = {row[0] for row in results["tables"][1]["rows"]}
    assert names == {"this", "one micro-batch", "Gumbel draws", "remat", "bfloat16", "host reward", "repeated prefix"}
    measured = {r["name"]: r["measured"] for r in results["requirements"]}
    assert measured["programs for one shape"] == 1
