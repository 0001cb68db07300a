"""The policy on released weights: prompts, what its towers are, what SFT reads of the records, what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.paper.released_policy import (
    build_released_policy,
    check_released,
    grpo_shape,
    instruction,
    longest_answer,
    plain_answers,
)
from experiments.paper.touch_r1 import SMOKE
from experiments.study.stages import StudySFT, answer_feed, run_sft
from sensors_io.schema import SENSORS
from tests.experiments import tiny
from tests.experiments.paper.conftest import MODEL
from tests.touchr1_jax.text.vocabularies import character_level
from touchr1_jax.models.layers import SizeError
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import touch_shapes
from touchr1_jax.text.oracle import read

SFT = StudySFT(batch_size=3, questions=2, micro_contacts=1)


def test_the_system_says_what_an_answer_looks_like(policy):
    said = instruction(policy.language)
    assert said in policy.tokenizer.decode(policy.layout.ids[0])
    assert "<perceive> SENSOR LEVEL ... </perceive> <compare> LEVEL </compare> <conclude> LEVEL </conclude>" in said
    assert "hardness: soft, firm, hard;" in said


def test_no_answer_is_longer_than_the_longest(policy):
    """Letter by letter it is the one that says "protruding" six times."""
    texts = list(plain_answers(policy.language))
    assert len(texts) == 3 + 3 + 3 + 9
    (longest,) = (text for text in texts if text.count("protruding") == len(SENSORS) + 2)
    assert longest_answer(policy.language, character_level()) == len(longest) + 1


def test_completions_must_have_room_for_an_answer(checkpoint):
    model = dataclasses.replace(MODEL, completion_tokens=20)
    with pytest.raises(SizeError, match=r"model\.completion_tokens is 20: the longest answer takes \d+ tokens"):
        build_released_policy(model, checkpoint, SENSORS)


def test_sizes_that_contradict_each_other_are_named_before_there_is_data(checkpoint):
    """Three frames are no whole steps of two."""
    tactile = TactileViTConfig(sensors=0, width=16, num_layers=0, num_heads=2, stem_width=4, frames_per_step=2)
    model = dataclasses.replace(MODEL, tactile=tactile, frames=3)
    with pytest.raises(SizeError, match="no policy can be built of these sizes"):
        check_released(build_released_policy(model, checkpoint, SENSORS), touch_shapes(model, model.view_px, SENSORS))


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ((1, 2, 1), r"micro_prompts is 1: must be a multiple of data · fsdp = 2"),
        ((1, 1, 4), r"num_kv_heads is 2: must be a multiple of mesh tensor = 4"),
    ],
)
def test_a_mesh_that_cannot_share_the_work_is_named_before_there_is_data(policy, mesh, message):
    assert grpo_shape(SMOKE, policy, (1, 1, 2)).mesh.tensor == 2
    with pytest.raises(SizeError, match=f"GRPO cannot be shared by the devices of the mesh: {message}"):
        grpo_shape(SMOKE, policy, mesh)


def test_the_released_towers_are_taken_as_they_are(policy, streamed, checkpoint):
    params = policy.init(0, tiny.one_batch(streamed))
    assert params["decoder"] is checkpoint.params["decoder"]
    assert params["vision"]["tower"] is checkpoint.params["vision"]
    assert set(params) - set(policy.frozen) == {"tactile", "tactile_norm", "tactile_in", "tactile_out"}
    other = policy.init(1, tiny.one_batch(streamed))
    assert (np.asarray(other["tactile_in"]["kernel"]) != np.asarray(params["tactile_in"]["kernel"])).any()


def test_batches_of_sft_hold_the_prompts_and_answers_of_the_release(policy, streamed):
    """Read by two threads from disk; what is asked decodes to the answer that the parser reads as the label."""
    levels = max(policy.levels)
    evidence = np.zeros((len(streamed.store), len(SENSORS), len(policy.levels), levels), np.float32)
    batch = next(answer_feed(policy, streamed, evidence, SFT, seed=0))
    p, q, s = 3, 2, len(SENSORS)
    length, clip = policy.layout.ids.shape[1], streamed.clip
    assert batch.ids.shape == batch.mask.shape == (p, q, length)
    assert batch.tokens.shape == batch.token_mask.shape == (p, q, MODEL.completion_tokens)
    assert batch.touch.frames.shape == (p, s, clip.frames, clip.image_px, clip.image_px, 3)
    assert batch.touch.view.shape == (p, MODEL.view_px, MODEL.view_px, 3)
    assert (batch.ids[..., policy.layout.view] == policy.tokenizer.view_id).all()
    assert streamed.memory.held_bytes == 0
    for i, j in np.ndindex(p, q):
        asked = (policy.layout.ids == batch.ids[i, j]).all(-1).argmax()
        text = policy.tokenizer.decode(batch.tokens[i, j][batch.token_mask[i, j]])
        said = read(policy.language, text)
        assert said.formatted
        assert said.conclude[asked] == batch.touch.label[i, asked]


def test_reading_threads_change_nothing(policy, streamed):
    evidence = np.zeros((len(streamed.store), len(SENSORS), len(policy.levels), max(policy.levels)), np.float32)
    first, second = (
        next(answer_feed(policy, dataclasses.replace(streamed, threads=n), evidence, SFT, seed=0)) for n in (1, 3)
    )
    assert jax.tree.all(jax.tree.map(np.array_equal, first, second))


def test_towers_that_stand_still_need_adapters(policy, streamed, context):
    with pytest.raises(SizeError, match=r"sft\.lora_rank is 0: must be at least 1 where vision and decoder stand"):
        run_sft(policy, streamed, np.zeros(0), StudySFT(), context, seed=0, stage="sft/0")


def test_the_cache_has_the_type_of_the_weights(policy, checkpoint):
    assert policy.fns.cache_dtype == jnp.float32
    assert {x.dtype for x in jax.tree.leaves(checkpoint.params)} == {jnp.dtype(jnp.float32)}
