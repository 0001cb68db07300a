"""Supervised fine-tuning: what counts in the loss, and that it falls."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.touchr1_jax import tiny
from touchr1_jax.text.template import answer_text, encode_answer
from touchr1_jax.training.sft import SFTBatch, SFTState, make_sft_step, sft_gradient, sft_loss

P, Q, T = 2, 2, 12
FNS = tiny.SHALLOW


def answer(level: int, asked: int) -> tuple[np.ndarray, np.ndarray]:
    """One sensor's answer, eleven tokens with its end."""
    levels = np.full(tiny.A, level)
    text = answer_text(
        tiny.LANGUAGE,
        asked=np.arange(tiny.A) == asked,
        streams=np.array([False, True]),
        perceive=np.tile(levels, (tiny.S, 1)),
        compare=levels,
        conclude=levels,
    )
    return encode_answer(tiny.TOKENIZER, text, T)


@pytest.fixture(scope="module")
def batch() -> SFTBatch:
    """Two contacts, asked for hardness and roughness; the answers differ."""
    pairs = [[answer((p + q) % 3, q) for q in range(Q)] for p in range(P)]
    return SFTBatch(
        touch=jax.tree.map(jnp.asarray, tiny.touch_batch(0, P)),
        ids=jnp.broadcast_to(jnp.asarray(tiny.LAYOUT.ids[:Q]), (P, Q, tiny.L)),
        mask=jnp.broadcast_to(jnp.asarray(tiny.LAYOUT.mask[:Q]), (P, Q, tiny.L)),
        streams=jnp.broadcast_to(jnp.array([False, True]), (P, Q, tiny.S)),
        tokens=jnp.asarray([[tokens for tokens, _ in row] for row in pairs]),
        token_mask=jnp.asarray([[mask for _, mask in row] for row in pairs]),
    )


@pytest.fixture(scope="module")
def params():
    """The whole policy with one decoder layer."""
    return {**tiny.params(), **tiny.shallow_params()}


loss = jax.jit(lambda p, b: sft_loss(FNS, p, b))
gradient = jax.jit(lambda p, b: sft_gradient(FNS, p, b))
group_logits = jax.jit(jax.vmap(FNS.group_logits, in_axes=(None, 0, 0, 0, 0)))


def assert_same_gradient(found, expected) -> None:
    """Relative to the largest number of all: some are rounding alone."""
    scale = max(float(np.abs(g).max()) for g in jax.tree.leaves(expected))
    for a, b in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5 * scale)


@pytest.mark.long
def test_encoded_contacts_train_the_decoder_as_the_contacts_do_and_nothing_else(params, batch):
    features = jax.jit(lambda p, b: FNS.encode(p, b))(params, batch.touch)
    (value, right), whole = gradient(params, batch)
    again = jax.jit(lambda p: sft_gradient(FNS, p, batch.replace(touch=features)))
    (encoded_value, encoded_right), grads = again({"decoder": params["decoder"]})
    np.testing.assert_allclose((encoded_value, encoded_right), (value, right), rtol=1e-6)
    for a, b in zip(jax.tree.leaves(grads["decoder"]), jax.tree.leaves(whole["decoder"]), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("weighted", [False, True])
def test_loss_is_the_cross_entropy_of_the_answers_by_hand(params, batch, weighted):
    """In float64 from the logits of one prompt and answer at a time."""
    weight = np.random.default_rng(0).uniform(0.5, 2, batch.tokens.shape) if weighted else np.ones(batch.tokens.shape)
    batch = batch.replace(weight=jnp.asarray(weight, jnp.float32)) if weighted else batch
    features = jax.jit(lambda p, b: FNS.encode(p, b))(params, batch.touch)
    cost, right, count, total = 0.0, 0, 0, 0.0
    for q in range(Q):
        seen = features.replace(stream_mask=features.stream_mask & batch.streams[:, q])
        logits = group_logits(params, seen, batch.ids[:, q], batch.mask[:, q], batch.tokens[:, q, None])[:, 0]
        for p, t in np.argwhere(batch.token_mask[:, q]):
            row = np.asarray(logits[p, t], np.float64)
            token = int(batch.tokens[p, q, t])
            cost += weight[p, q, t] * (np.log(np.exp(row - row.max()).sum()) - (row[token] - row.max()))
            total += weight[p, q, t]
            right += int(row.argmax() == token)
            count += 1
    value, accuracy = loss(params, batch)
    assert count == P * Q * 11
    np.testing.assert_allclose(value, cost / total, rtol=1e-5)
    np.testing.assert_allclose(accuracy, right / count, rtol=1e-6)


@pytest.mark.long
def test_blocks_of_tokens_give_the_loss_of_all_of_them(params, batch):
    """And the same gradient, five tokens' logits at a time."""
    few = jax.jit(jax.value_and_grad(lambda p: sft_loss(FNS, p, batch, max_logits=5 * tiny.V)[0]))(params)
    all_at_once = gradient(params, batch)
    np.testing.assert_allclose(few[0], all_at_once[0][0], rtol=1e-6)
    assert_same_gradient(few[1], all_at_once[1])


@pytest.mark.long
def test_micro_batches_sum_to_the_gradient_of_the_batch(params, batch):
    """With unequal numbers of answer tokens: the mean is over the tokens of the batch, not of each micro-batch."""
    uneven = batch.replace(token_mask=batch.token_mask.at[1, 1].set(False).at[0, 0, 5:].set(False))
    whole = gradient(params, uneven)
    micro = jax.jit(lambda p: sft_gradient(FNS, p, uneven, micro_contacts=1))(params)
    np.testing.assert_allclose(micro[0], whole[0], rtol=1e-6)
    np.testing.assert_allclose(whole[0], loss(params, uneven), rtol=1e-6)
    assert_same_gradient(micro[1], whole[1])


def test_micro_batches_must_divide_the_batch(params, batch):
    with pytest.raises(ValueError, match="micro_contacts is 3: must divide the 2 contacts"):
        sft_gradient(FNS, params, batch, micro_contacts=3)


@pytest.mark.long
def test_only_answer_tokens_count(params, batch):
    """Other ids where the prompt or the answer is padding, other pixels in a stream that the question may not feel."""
    before = loss(params, batch)
    tokens = jnp.where(batch.token_mask, batch.tokens, 9)
    ids = jnp.where(batch.mask, batch.ids, 11)
    frames = batch.touch.frames.at[:, 0].set(7)
    assert not batch.token_mask.all()
    np.testing.assert_array_equal(loss(params, batch.replace(tokens=tokens)), before)
    np.testing.assert_array_equal(loss(params, batch.replace(ids=ids)), before)
    np.testing.assert_array_equal(loss(params, batch.replace(touch=batch.touch.replace(frames=frames))), before)


@pytest.mark.long
def test_rows_without_an_answer_add_nothing(params, batch):
    """A question that nobody annotated: the loss is the mean over the other three."""
    without = batch.replace(token_mask=batch.token_mask.at[1, 1].set(False))
    other = without.replace(tokens=without.tokens.at[1, 1].set(tiny.TOKENIZER.pad_id))
    assert loss(params, without)[0] != loss(params, batch)[0]
    np.testing.assert_array_equal(loss(params, other)[0], loss(params, without)[0])
    nothing = loss(params, batch.replace(token_mask=jnp.zeros_like(batch.token_mask)))
    assert nothing == (0, 0)


@pytest.mark.slow
def test_a_few_answers_are_learned_by_heart(params, batch):
    optimizer = optax.adam(3e-3)
    step = make_sft_step(FNS, optimizer)
    quiet = jax.tree.map(lambda x: 0.3 * x, params)
    state = SFTState(params=quiet, opt_state=optimizer.init(quiet), step=jnp.int32(0))
    losses = []
    for _ in range(150):
        state, metrics = step(state, batch)
        losses.append(float(metrics["loss"]))
    assert losses[0] > 2
    assert losses[-1] < 0.1
    assert metrics["token_accuracy"] == 1
    assert int(state.step) == 150
    assert step._cache_size() == 1


@pytest.mark.long
def test_blind_loss_does_not_depend_on_touch(params, batch):
    blind = jax.jit(lambda p, b: sft_loss(FNS, p, b, blind=True)[0])
    other = batch.touch.replace(frames=255 - batch.touch.frames, force_n=-batch.touch.force_n)
    assert blind(params, batch) == blind(params, batch.replace(touch=other))
    assert blind(params, batch) != blind(params, batch.replace(touch=batch.touch.replace(view=255 - batch.touch.view)))
