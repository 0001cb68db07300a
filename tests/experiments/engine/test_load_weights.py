"""The measurement of reading weights, shrunken, and the random checkpoints that it reads."""

import json
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.engine import load_weights
from experiments.engine.load_checkpoints import READERS, SHAPES, measure, random_checkpoint, shards
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.models.load import peak_memory

TINY = SHAPES["tiny"]


def test_experiment_runs_shrunken(tmp_path):
    config = load_weights.LoadWeightsConfig(sizes=("tiny",), compare=("tiny",), scratch=tmp_path, shard_bytes=50_000)
    directory = run_shrunk(load_weights, config, tmp_path / "runs")
    results = read_json(directory / "results.json")
    rows = results["tables"][0]["rows"]
    assert [row[0] for row in rows] == ["tiny, streamed", "tiny, whole first"]
    assert all(peak >= before > 0 for _, _, peak, _, before, _ in rows)
    assert not list(tmp_path.glob("weights-*"))  # the checkpoint is gone


def test_readers_read_the_same(tmp_path):
    told: list[tuple[int, int]] = []
    size = random_checkpoint(tmp_path, TINY, 50_000, tell=lambda *word: told.append(word))
    assert told == sorted(told)
    assert told[-1] == (size, size)
    assert len(list(tmp_path.glob("*.safetensors"))) > 3
    ours, theirs = (sorted(map(digest, read(tmp_path, TINY, silent))) for read in READERS.values())
    assert ours == theirs
    assert json.loads((tmp_path / "model.safetensors.index.json").read_text())["metadata"]["total_size"] == size
    assert (
        size == sum(x.nbytes for x in READERS["streamed"](tmp_path, TINY, silent)) == load_weights.weight_bytes("tiny")
    )


def silent(done: int, total: int) -> None:
    del done, total


def digest(x: jax.Array) -> tuple[tuple[int, ...], bytes]:
    return x.shape, np.asarray(x).tobytes()


def test_contents_are_small_numbers(tmp_path):
    random_checkpoint(tmp_path, TINY, 10**9, tell=silent)
    for x in READERS["streamed"](tmp_path, TINY, silent):
        size = jnp.abs(x.astype(jnp.float32))
        assert float(size.min()) >= 2**-7
        assert float(size.max()) < 2**-6


def test_no_shard_is_larger_than_said_but_for_single_tensors():
    for shard in shards(TINY, 20_000):
        assert len(shard) == 1 or 2 * sum(int(np.prod(s)) for s in shard.values()) <= 20_000


def test_a_reader_that_fails_says_why(tmp_path):
    with pytest.raises(FileNotFoundError, match="no weights; correct the directory"):
        measure(READERS["streamed"], tmp_path, TINY, silent)


def end_at_once(*_: object) -> list[jax.Array]:
    os._exit(9)


def test_a_reader_that_is_stopped_is_named(tmp_path):
    with pytest.raises(RuntimeError, match="ended without an answer: probably too little memory"):
        measure(end_at_once, tmp_path, TINY, silent)


@pytest.mark.parametrize("reader", READERS)
def test_bytes_are_told_from_the_process_that_reads(tmp_path, reader):
    size = random_checkpoint(tmp_path, TINY, 10**9, tell=silent)
    told: list[tuple[int, int]] = []
    measure(READERS[reader], tmp_path, TINY, lambda *word: told.append(word))
    assert told == sorted(told)
    assert told[-1] == (size, size)
    assert len(told) > 3


def test_sizes_must_have_shapes_and_room(tmp_path):
    with pytest.raises(ValueError, match="must be of tiny, "):
        load_weights.LoadWeightsConfig(sizes=("70B",))
    with pytest.raises(ValueError, match="compare of sizes"):
        load_weights.LoadWeightsConfig(sizes=("3B",), compare=("7B",))
    with pytest.raises(ValueError, match=r"size 7B takes 16.6 GB of disk and .* of memory"):
        load_weights.check_room("7B", tmp_path, copies=10**6)


def test_peak_memory_is_that_of_the_program_and_not_of_its_parent(tmp_path):
    """This process has imported more than the reader will, and has held what its child has not."""
    held = np.ones(max(0, 2 * 10**8 - peak_memory()) // 8 + 10**6)
    random_checkpoint(tmp_path, TINY, 10**9, tell=silent)
    assert measure(READERS["streamed"], tmp_path, TINY, silent).before < peak_memory()
    assert peak_memory() >= held.nbytes
