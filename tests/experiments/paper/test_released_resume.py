"""A run goes on with the weights that it began with."""

import numpy as np
import pytest

from experiments.paper.released_resume import mark, require_same
from touchr1_jax.models.load import WeightsError


@pytest.mark.parametrize("at", [0, 2**20 - 1, 3 * 2**20 - 1])
def test_weights_of_the_same_size_with_another_byte_at_either_end_are_refused(tmp_path, context, at):
    shard = np.zeros(3 * 2**20, np.uint8)
    (tmp_path / "config.json").write_text("{}")
    shard.tofile(tmp_path / "model.safetensors")
    for _ in range(2):
        require_same(tmp_path, context)
    shard[at] = 1
    shard.tofile(tmp_path / "model.safetensors")
    with pytest.raises(WeightsError, match=r"not what this run began with: model\.safetensors changed; put it back"):
        require_same(tmp_path, context)


def test_a_file_that_came_later_is_named(tmp_path, context):
    (tmp_path / "config.json").write_text("{}")
    require_same(tmp_path, context)
    (tmp_path / "model.safetensors").write_bytes(b"0")
    with pytest.raises(WeightsError, match=r"model\.safetensors changed"):
        require_same(tmp_path, context)


def test_a_mark_is_the_size_and_the_checksums_of_both_ends(tmp_path):
    file = tmp_path / "file"
    file.write_bytes(b"123456789")
    assert mark(file) == [9, 0xCBF43926, 0xCBF43926]  # the check value of CRC-32
    file.write_bytes(b"")
    assert mark(file) == [0, 0, 0]
