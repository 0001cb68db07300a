"""The measurement of reading weights, shrunken, and the random checkpoints that it reads."""

import json
import pickle
from concurrent.futures.process import BrokenProcessPool

import jax.numpy as jnp
import numpy as np
import pytest
from flax import traverse_util

from experiments.core.artifacts import read_json
from experiments.engine import load_checkpoints, load_weights
from experiments.engine.load_checkpoints import READERS, SHAPES, measure, random_checkpoint
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.models.qwen.weights import load_params
from touchr1_jax.models.stacked import unstacked

TINY = SHAPES["tiny"]


def here(work, *arguments, progress):
    """In the place of a process of its own, which takes seconds to begin; what is sent there must be pickled."""
    work, arguments = pickle.loads(pickle.dumps((work, arguments)))
    return work(*arguments, progress=progress)


@pytest.mark.long
def test_experiment_runs_shrunken(tmp_path, monkeypatch):
    monkeypatch.setattr(load_checkpoints, "in_own_process", here)
    config = load_weights.LoadWeightsConfig(sizes=("tiny",), compare=("tiny",), scratch=tmp_path, shard_bytes=50_000)
    directory = run_shrunk(load_weights, config, tmp_path / "runs")
    results = read_json(directory / "results.json")
    rows = results["tables"][0]["rows"]
    assert [row[0] for row in rows] == ["tiny, streamed", "tiny, whole first"]
    assert all(peak >= before > 0 for _, _, peak, _, before, _ in rows)
    assert not list(tmp_path.glob("weights-*"))  # the checkpoint is gone


def silent(done: int, total: int) -> None:
    del done, total


@pytest.mark.long
def test_readers_read_the_same_small_numbers(tmp_path):
    folder, progress = tmp_path, []
    size = random_checkpoint(folder, TINY, 50_000, lambda *word: progress.append(word))
    assert progress == sorted(progress)
    assert progress[-1] == (size, size)
    assert len(list(folder.glob("*.safetensors"))) > 3
    assert json.loads((folder / "model.safetensors.index.json").read_text())["metadata"]["total_size"] == size
    ours, theirs = ([np.asarray(x) for x in read(folder, TINY, silent)] for read in READERS.values())
    layers = unstacked(traverse_util.flatten_dict(load_params(folder, TINY, jnp.bfloat16), sep="."))
    by_content = lambda arrays: sorted((x.shape, x.tobytes()) for x in arrays)
    assert by_content(map(np.asarray, layers.values())) == by_content(theirs)
    assert size == sum(x.nbytes for x in ours) == load_weights.weight_bytes("tiny")
    sizes = np.abs(np.concatenate([x.ravel() for x in ours]).astype(np.float32))
    assert 2**-7 <= sizes.min() <= sizes.max() < 2**-6


def test_a_reader_that_is_stopped_is_named(tmp_path, monkeypatch):
    def stopped(*work, **options):
        raise BrokenProcessPool

    monkeypatch.setattr(load_checkpoints, "in_own_process", stopped)
    with pytest.raises(RuntimeError, match="ended without an answer: probably too little memory"):
        measure(silent, tmp_path, TINY, silent)


def test_sizes_must_have_room(tmp_path):
    with pytest.raises(ValueError, match=r"size 7B takes 16.6 GB of disk and .* of memory"):
        load_weights.check_room("7B", tmp_path, copies=10**6)
