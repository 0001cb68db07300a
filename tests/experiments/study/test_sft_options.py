"""SFT in rows and by adapters, through the stage: the same policy, or a change of low rank."""

import dataclasses

import jax
import numpy as np
import pytest
from rich.console import Console

from experiments.core.context import Context, read_metrics
from experiments.study.stages import StudySFT, run_sft
from tests.experiments import tiny

CONFIG = StudySFT(steps=3, batch_size=4)
WIDTH = 128


@pytest.fixture(scope="module")
def evidence(data):
    """Evidence that says nothing."""
    return np.zeros((len(data.store), len(data.clip.sensors), data.label.shape[1], 9), np.float32)


@pytest.fixture(scope="module")
def train(policy, data, evidence, tmp_path_factory):
    """Parameters after SFT with some settings changed, and its losses."""

    def run(**changes):
        context = Context(tmp_path_factory.mktemp("run"), tmp_path_factory.mktemp("cache"), Console(quiet=True))
        try:
            config = dataclasses.replace(CONFIG, **changes)
            params = run_sft(policy, data, evidence, config, context, seed=0, stage="sft/0")
            return params, [line["loss"] for line in read_metrics(context.directory)]
        finally:
            context.close()

    return run


@pytest.fixture(scope="module")
def first(policy, data):
    """Parameters before it."""
    return policy.init(0, tiny.one_batch(data))


@pytest.fixture(scope="module")
def padded(train):
    return train()


def same(found, expected) -> None:
    """Losses of all steps; Adam makes steps of the rounding of gradients that are zero, so parameters differ."""
    assert len(expected) == CONFIG.steps
    assert np.ptp(expected) > 1e-3
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_rows_train_the_policy_that_padding_trains(train, padded):
    found, losses = train(pack=WIDTH)
    same(losses, padded[1])
    assert jax.tree.structure(found) == jax.tree.structure(padded[0])


def test_adapters_change_the_decoder_by_their_rank_and_train_the_rest(train, padded, first):
    found = train(lora_rank=2)[0]
    assert jax.tree.structure(found) == jax.tree.structure(padded[0])
    before, after = first["decoder"], found["decoder"]
    np.testing.assert_array_equal(after["embedding"]["embedding"], before["embedding"]["embedding"])
    for name in ("q_proj", "o_proj"):
        change = np.asarray(after["layers_0"][name]["kernel"] - before["layers_0"][name]["kernel"])
        sizes = np.linalg.svd(change, compute_uv=False)
        assert sizes[0] > 0
        assert sizes[2] < 1e-2 * sizes[0]  # what is left is the rounding of their sum
    assert (np.asarray(found["tactile_out"]["kernel"]) != np.asarray(first["tactile_out"]["kernel"])).any()


def test_adapters_learn_from_rows_too(train):
    same(train(lora_rank=2, pack=WIDTH)[1], train(lora_rank=2)[1])


@pytest.mark.parametrize("field", ["pack", "lora_rank"])
def test_numbers_must_not_be_negative(field):
    with pytest.raises(ValueError, match=f"{field} is -1: must be at least 0"):
        StudySFT(**{field: -1})


def test_a_curriculum_is_a_share_of_the_steps(train, padded):
    """Here of all of them: it learns from other questions."""
    assert train(curriculum=1.0)[1][0] != padded[1][0]
    with pytest.raises(ValueError, match=r"curriculum is 1\.5: must lie in 0 … 1"):
        StudySFT(curriculum=1.5)


def test_devices_share_a_micro_batch():
    config = StudySFT(batch_size=16, micro_contacts=8, pack=WIDTH)
    packing = config.packing(4)
    assert (packing.width, packing.contacts, packing.micro_batches) == (WIDTH, 2, 2)
    assert StudySFT().packing(3) is None
    with pytest.raises(ValueError, match="micro_contacts is 8: must be a multiple of the 3 devices"):
        config.packing(3)
