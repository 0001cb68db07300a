"""What a server is asked for: embedded prompts as the learner reads them, in PyTorch's format."""

import base64
import importlib.util
import io

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest

from tests.touchr1_jax import tiny
from tests.touchr1_jax.training.stand_in import read_torch
from touchr1_jax.rl.config import GRPOConfig, Paper
from touchr1_jax.rl.served import (
    TOKEN,
    RolloutError,
    completion_request,
    embedded_prompts,
    read_completions,
    torch_file,
)

KINDS = [np.float32, ml_dtypes.bfloat16]


def numbers(kind, *shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=shape).astype(kind)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(7, 24), (1, 24), (300, 2)])
def test_a_tensor_is_read_as_it_was_written(kind, shape):
    x = numbers(kind, *shape)
    found = read_torch(torch_file(x))
    assert found.dtype == x.dtype
    np.testing.assert_array_equal(found, x)


@pytest.mark.skipif(not importlib.util.find_spec("torch"), reason="the parity extra is not installed")
@pytest.mark.parametrize("kind", KINDS)
def test_pytorch_reads_what_is_written_and_writes_what_is_read(kind):
    """As vLLM reads it: of weights alone, on the CPU."""
    import torch

    x = numbers(kind, 7, 24)
    found = torch.load(io.BytesIO(torch_file(x)), weights_only=True, map_location=torch.device("cpu"))
    assert found.dtype == {np.float32: torch.float32, ml_dtypes.bfloat16: torch.bfloat16}[kind]
    assert found.is_contiguous()
    np.testing.assert_array_equal(found.float().numpy(), x.astype(np.float32))
    torch.save(found, written := io.BytesIO())
    np.testing.assert_array_equal(read_torch(written.getvalue()), x)


def test_other_types_are_refused():
    with pytest.raises(KeyError, match="float64"):
        torch_file(np.zeros((2, 3)))


@pytest.mark.long
def test_prompts_are_embedded_as_the_decoder_reads_them():
    """Words, touch and view in their places; what a contact lacks does not exist."""
    table, batch = tiny.params()["decoder"]["embedding"]["embedding"], tiny.question_batch(0, 2)
    lacking = jnp.array([[True, False], [True, True]])
    batch = batch.replace(features=batch.features.replace(stream_mask=lacking, view_mask=jnp.array([True, False])))
    x, exists = jax.jit(lambda b: embedded_prompts(table, b, tiny.SLOTS))(batch)
    words = np.setdiff1d(np.arange(tiny.L), np.concatenate([tiny.SLOTS.touch.ravel(), tiny.SLOTS.view]))
    np.testing.assert_array_equal(x[:, words], table[batch.ids][:, words])
    np.testing.assert_array_equal(x[:, tiny.SLOTS.touch], batch.features.touch)
    np.testing.assert_array_equal(x[:, tiny.SLOTS.view], batch.features.view)
    assert exists[:, tiny.SLOTS.touch[0]].all()
    assert not exists[0, tiny.SLOTS.touch[1]].any()
    assert not exists[1, tiny.SLOTS.view].any()
    assert exists[:, -1].all()


@pytest.mark.parametrize(("centred", "logprobs"), [(0, 1), (20, 20)])
def test_a_request_says_all_that_a_generation_config_could_change(centred, logprobs):
    config = GRPOConfig(group=3, length=9, algorithm=Paper(score_centering=centred))
    x = numbers(np.float32, 5, 4)
    asked = completion_request("touch-1", x, config, tiny.FNS, 41)
    np.testing.assert_array_equal(read_torch(base64.b64decode(asked.pop("prompt_embeds"))), x)
    assert {int(i) for i in asked.pop("logit_bias")} == set(np.flatnonzero(tiny.TOKENIZER.banned))
    assert asked == {
        "model": "touch-1",
        "n": 3,
        "max_tokens": 9,
        "seed": 41,
        "stop_token_ids": [1],
        "ignore_eos": True,
        "logprobs": logprobs,
        "return_token_ids": True,
        "return_tokens_as_token_ids": True,
        "temperature": 1.0,
        "top_p": 1.0,
        "top_k": 0,
        "min_p": 0.0,
        "repetition_penalty": 1.0,
        "presence_penalty": 0.0,
        "frequency_penalty": 0.0,
    }


def completed(index: int, ids: list[int], heads: int) -> dict:
    """A completion of tokens at log-probability −.5, with so many of the most likely tokens of each place."""
    best = {f"{TOKEN}{i}": -0.5 - n for n, i in enumerate(np.flatnonzero(~tiny.TOKENIZER.banned)[:heads].tolist())}
    return {
        "index": index,
        "token_ids": ids,
        "logprobs": {"token_logprobs": [-0.5] * len(ids), "top_logprobs": [best] * len(ids)},
    }


def test_completions_become_arrays_that_are_0_after_the_end():
    config = GRPOConfig(group=2, length=3, algorithm=Paper(score_centering=2))
    free = int(np.flatnonzero(~tiny.TOKENIZER.banned)[3])
    answer = {"choices": [completed(1, [free, free, 1], heads=3), completed(0, [1], heads=2)]}
    found = read_completions(answer, config, tiny.FNS)
    np.testing.assert_array_equal(found.mask, [[True, False, False], [True, True, True]])
    np.testing.assert_array_equal(found.log_prob, -0.5 * found.mask)
    assert found.tokens[1].tolist() == [free, free, 1]
    np.testing.assert_array_equal(found.head_log_prob[1], [[-0.5] * 3, [-1.5] * 3])
    few = {"choices": [completed(0, [1], heads=2), completed(1, [1], heads=1)]}
    with pytest.raises(RolloutError, match="a mapping of 2 tokens"):
        read_completions(few, config, tiny.FNS)
    with pytest.raises(RolloutError, match=r"choices of .* a list of completions"):
        read_completions({"choices": [completed(0, [1], heads=2), 3]}, config, tiny.FNS)
