"""Rows of several examples: what stands in them, that they teach what padding teaches, and that nothing leaks."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.touchr1_jax import tiny
from touchr1_jax.models import blocked_attention as attention
from touchr1_jax.models.lora import LoraConfig, init_adapters
from touchr1_jax.models.policy import prompt_mask
from touchr1_jax.text.template import answer_text, encode_answer
from touchr1_jax.training.packing import (
    PackedRows,
    Packing,
    existing_tokens,
    filled,
    first_fit,
    pack_rows,
    padded_tokens,
)
from touchr1_jax.training.sft import (
    SFTBatch,
    SFTState,
    encoded_group,
    make_sft_step,
    row_scores,
    sft_gradient,
    sft_loss,
)

P, Q, T = 4, 2, 16
N = tiny.L + T
FNS = tiny.FNS  # its last layer attends from few places of a row, the one before from all
WIDTH = 2 * N


def make_batch(seed: int) -> SFTBatch:
    """Questions with touch of one or both sensors; a contact without a view, one with a step without frames."""
    rng = np.random.default_rng(seed)
    streams = np.array([[1, 0], [0, 1], [1, 1], [1, 1]], bool)[rng.integers(0, 4, (P, Q))]
    asked = rng.integers(0, tiny.A, (P, Q))
    pairs = [[answer(rng, streams[p, q], asked[p, q]) for q in range(Q)] for p in range(P)]
    touch = tiny.touch_batch(seed, P)
    touch.frame_mask[1, 0, 2:] = False
    touch.view_mask[2] = False
    touch.stream_mask[3, 1] = False
    return SFTBatch(
        touch=touch,
        ids=tiny.LAYOUT.ids[asked],
        mask=tiny.LAYOUT.mask[asked],
        streams=streams,
        tokens=np.array([[tokens for tokens, _ in row] for row in pairs]),
        token_mask=np.array([[mask for _, mask in row] for row in pairs]),
    )


def answer(rng: np.random.Generator, streams: np.ndarray, asked: int) -> tuple[np.ndarray, np.ndarray]:
    """An answer with random levels."""
    levels = rng.integers(0, 3, (tiny.S + 2, tiny.A))
    text = answer_text(
        tiny.LANGUAGE,
        asked=np.arange(tiny.A) == asked,
        streams=streams,
        perceive=levels[2:],
        compare=levels[0],
        conclude=levels[1],
    )
    return encode_answer(tiny.TOKENIZER, text, T)


def packed(batch: SFTBatch, packing: Packing) -> SFTBatch:
    """The same with rows."""
    given = batch.touch, batch.mask, batch.streams, batch.token_mask
    exists = existing_tokens(FNS.module, FNS.slots, *given)
    return batch.replace(rows=pack_rows(exists, batch.token_mask, packing))


@pytest.fixture(scope="module")
def batch():
    return make_batch(0)


@pytest.fixture(scope="module")
def params():
    return tiny.params()


@functools.cache
def gradient(micro: int | None, *, blind: bool = False):
    return jax.jit(functools.partial(sft_gradient, FNS, micro_contacts=micro, blind=blind))


def assert_same(found, expected, tolerance: float = 1e-5) -> None:
    """Values, and gradients relative to the largest number of all: some are rounding alone."""
    np.testing.assert_allclose(found[0], expected[0], rtol=tolerance)
    scale = max(float(np.abs(g).max()) for g in jax.tree.leaves(expected[1]))
    for a, b in zip(jax.tree.leaves(found[1]), jax.tree.leaves(expected[1]), strict=True):
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * scale)


@pytest.fixture(scope="module")
def padding(params, batch):
    """Loss, token accuracy and gradient of the padded batch."""
    return gradient(None)(params, batch)


@pytest.mark.long
@pytest.mark.parametrize(("micro", "contacts", "width"), [(None, 4, WIDTH), (2, 1, N)], ids=["all", "alone"])
def test_rows_teach_what_padding_teaches(params, batch, padding, micro, contacts, width):
    """Loss, token accuracy and every gradient, whoever shares the rows."""
    packing = Packing(width=width, contacts=contacts, micro_batches=P // (micro or P))
    assert_same(gradient(micro)(params, packed(batch, packing)), padding)


@pytest.mark.long
def test_a_blind_policy_is_packed_too(params, batch):
    unfelt = batch.replace(streams=np.zeros_like(batch.streams))
    rows = packed(unfelt, Packing(width=WIDTH, contacts=4))
    assert_same(gradient(None, blind=True)(params, rows), gradient(None, blind=True)(params, unfelt))


@pytest.mark.long
def test_answers_of_which_a_part_counts_teach_that_part(params, batch):
    """Nothing of one example, the first tokens of another, not the third of a third, which later ones see; all tokens
    weigh differently."""
    counted = batch.token_mask.copy()
    counted[1, 1] = counted[0, 0, 5:] = counted[2, 0, 2] = False
    weight = np.random.default_rng(0).uniform(0.5, 2, counted.shape).astype(np.float32)
    some = batch.replace(token_mask=counted, weight=weight)
    rows = packed(some, Packing(width=WIDTH, contacts=4))
    assert_same(gradient(None)(params, rows), gradient(None)(params, some))
    examples = np.unique(np.asarray(rows.rows.source)[np.asarray(rows.rows.source) >= 0] // N)
    assert examples.tolist() == [0, 1, 2, 4, 5, 6, 7]


@pytest.mark.long
def test_blocks_of_logits_and_rematerialisation_change_nothing(params, batch, padding):
    rows = packed(batch, Packing(width=WIDTH, contacts=4))
    lean = dataclasses.replace(FNS, module=FNS.module.clone(remat=True))
    found = jax.jit(functools.partial(sft_gradient, lean, max_logits=5 * tiny.V))(params, rows)
    assert_same(found, padding)


@pytest.mark.long
def test_adapters_learn_from_rows_what_they_learn_from_padding(params, batch):
    lora = LoraConfig(rank=2)
    fns = dataclasses.replace(FNS, lora=lora, base=params)
    adapters = jax.tree.map(lambda x: 0.1 + x, init_adapters(jax.random.key(0), params, lora))
    trained = {"adapters": adapters, "tactile": params["tactile"]}
    found = jax.jit(functools.partial(sft_gradient, fns))
    of_rows, of_padding = found(trained, packed(batch, Packing(width=WIDTH, contacts=4))), found(trained, batch)
    assert_same(of_rows, of_padding, tolerance=1e-4)  # so large adapters round by 4e-5 on some processors


@pytest.fixture(scope="module")
def scores(params, batch):
    """batch → log-probabilities of the first row, and the example of each."""
    rows = packed(batch, Packing(width=3 * N, contacts=4)).rows
    source, predicts = jnp.asarray(rows.source[0, 0]), jnp.asarray(rows.predicts[0, 0])
    examples = rows.source[0, 0][rows.predicts[0, 0]] // N
    assert len(np.unique(examples[predicts >= 0])) >= 3

    @jax.jit
    def run(batch):
        encoded, features = encoded_group(FNS, params, batch)
        tokens = tokens_of(features, batch)
        found = row_scores(FNS, params, encoded.reshape(-1, encoded.shape[-1]), tokens, source, predicts)["log_prob"]
        return jnp.where(predicts >= 0, found, 0.0)

    return run, np.where(predicts >= 0, examples, -1)


def tokens_of(features, batch: SFTBatch):
    """All tokens of all examples, which are one group."""
    prompt = batch.ids, batch.mask, batch.streams, batch.tokens
    tokens = padded_tokens(FNS.module, FNS.slots, features, *prompt, contacts=P)
    return jax.tree.map(lambda x: x.reshape(P * Q, *x.shape[2:]), tokens)


def other_inputs(batch: SFTBatch, example: int) -> list[SFTBatch]:
    """Other pixels and forces of its contact; another question; another answer."""
    p, q = divmod(example, Q)
    frames, force = batch.touch.frames.copy(), batch.touch.force_n.copy()
    frames[p], force[p] = 255 - frames[p], force[p] + 1
    ids, tokens = batch.ids.copy(), batch.tokens.copy()
    ids[p, q, -2:], tokens[p, q, 1:5] = 11, 12
    touch = dataclasses.replace(batch.touch, frames=frames, force_n=force)
    return [batch.replace(touch=touch), batch.replace(ids=ids), batch.replace(tokens=tokens)]


@pytest.mark.long
def test_no_input_of_an_example_changes_another(batch, scores):
    """Bit for bit: log-probabilities of all tokens of a row, before and after."""
    run, examples = scores
    before = np.asarray(run(batch))
    for example in np.unique(examples[examples >= 0]):
        for number, other in enumerate(other_inputs(batch, int(example))):
            after = np.asarray(run(other))
            touched = examples // Q == example // Q if number == 0 else examples == example
            np.testing.assert_array_equal(after[~touched], before[~touched])
            assert (after[examples == example] != before[examples == example]).any()


@pytest.mark.long
def test_blocks_of_queries_see_all_keys_within_reach(monkeypatch):
    """Nine queries in blocks of two, examples of four tokens at most: as all at once."""
    rng = np.random.default_rng(0)
    q = jnp.asarray(rng.normal(size=(9, 2, 3, 4)), jnp.float32)
    cache = attention.LayerCache(*(jnp.asarray(rng.normal(size=(2, 9, 4)), jnp.float32) for _ in range(2)))
    attend = lambda reach: attention.attend_in_segments(q, cache, attention.Segments(number=number, reach=reach))
    number = jnp.array([0, 0, 0, 0, 1, 1, 1, 2, -1])
    whole = attend(9)
    monkeypatch.setattr(attention, "ROW_QUERIES", 2)
    monkeypatch.setattr(attention, "ROW_BLOCKS", 9)
    np.testing.assert_allclose(attend(4), whole, atol=1e-6)
    short = attend(2)
    assert np.flatnonzero(np.abs(short - whole).max(-1) > 1e-3).tolist() == [2, 3, 6]  # who lost keys of their own


@pytest.mark.long
def test_one_program_for_batches_that_fill_other_rows(params):
    """Five batches, of which one fills a single row, and the losses of padding."""
    optimizer = optax.sgd(0.0)
    packing = Packing(width=WIDTH, contacts=2, micro_batches=2)
    step, losses, used = make_sft_step(FNS, optimizer, micro_contacts=2), [], set()
    batches = [make_batch(seed) for seed in range(5)]
    batches[4].token_mask[:, 1] = False
    for batch in batches:
        rows = packed(batch, packing)
        used.add(filled(rows.rows)[1])
        fresh = tiny.copy(params)
        state = SFTState(params=fresh, opt_state=optimizer.init(fresh), step=jnp.int32(0))
        losses.append(float(step(state, rows)[1]["loss"]))
    assert len(used) > 1
    assert step._cache_size() == 1
    padded = jax.jit(functools.partial(sft_loss, FNS))
    np.testing.assert_allclose(losses, [float(padded(params, b)[0]) for b in batches], rtol=1e-5)


@pytest.mark.long
def test_the_host_knows_which_tokens_exist(params, batch):
    features = jax.jit(lambda p, touch: FNS.encode(p, touch))(params, batch.touch)
    exists = existing_tokens(FNS.module, FNS.slots, batch.touch, batch.mask, batch.streams, batch.token_mask)
    for p in range(P):
        for q in range(Q):
            seen = jax.tree.map(lambda x, p=p: x[p], features)
            seen = seen.replace(stream_mask=seen.stream_mask & batch.streams[p, q])
            there = prompt_mask(seen, jnp.asarray(batch.mask[p, q]), FNS.slots)
            np.testing.assert_array_equal(exists[p, q, : tiny.L], there)
    np.testing.assert_array_equal(exists[..., tiny.L :], batch.token_mask)
    assert exists[..., : tiny.L].mean() < 1


examples = st.lists(st.tuples(st.integers(0, 12), st.integers(1, 6)), min_size=1, max_size=12)


@given(examples=examples, width=st.integers(18, 60), most=st.integers(6, 30))
def test_first_fit_places_every_example_and_leaves_no_room_that_would_do(examples, width, most):
    sizes = np.array([(prompt + said, said) for prompt, said in examples])
    rows = first_fit(sizes, (width, most))
    assert rows.min() >= 0
    assert set(rows) == set(range(rows.max() + 1))
    room = np.array([width, most])
    left = room - np.array([sizes[rows == row].sum(0) for row in range(rows.max() + 1)])
    assert (left >= 0).all()
    for size, row in zip(sizes, rows, strict=True):
        assert not (size <= left[:row]).all(-1).any()
    surely = int((room // sizes.max(0)).min())
    assert rows.max() + 1 <= -(-len(sizes) // surely)


@given(
    seed=st.integers(0, 2**32 - 1),
    slots=st.integers(1, 2),
    contacts=st.integers(1, 2),
    micro=st.integers(1, 3),
    questions=st.integers(1, 3),
    spare=st.integers(0, 30),
)
def test_every_token_stands_in_one_row_of_its_group(seed, slots, contacts, micro, questions, spare):
    rng = np.random.default_rng(seed)
    p, t, n = slots * contacts * micro, 3, 8
    exists = rng.random((p, questions, n)) < 0.6
    exists[..., n - t - 1 :] = True
    counted = np.broadcast_to([True, False, True], (p, questions, t))
    rows = pack_rows(exists, counted, Packing(width=n + spare, contacts=contacts, micro_batches=micro))
    assert rows.source.shape[0] == rows.predicts.shape[0] == p
    placed = np.zeros(p * questions, int)
    for first in range(slots):
        for j in range(micro):
            members = np.array([(first * contacts + c) * micro + j for c in range(contacts)])
            source = rows.source[members].reshape(-1, n + spare)
            predicts = rows.predicts[members].reshape(len(source), -1)
            used = (source >= 0).any(-1)
            assert used.tolist() == sorted(used, reverse=True)
            assert ((predicts >= 0).any(-1) == used).all()
            numbers = np.concatenate([row[row >= 0] for row in source])
            expected = np.flatnonzero(exists[members].reshape(-1))
            assert sorted(numbers) == expected.tolist()
            for row, at in zip(source, predicts, strict=True):
                whole = row[row >= 0]
                assert (row[: len(whole)] == whole).all()
                assert (np.diff(whole)[np.diff(whole // n) == 0] > 0).all()
                assert sorted(row[at[at >= 0] + 1] % n) == sorted([n - t, n - 1] * len(np.unique(whole // n)))
            placed[(members[:, None] * questions + np.arange(questions)).ravel()] += 1
    assert (placed == 1).all()


def test_a_row_says_what_it_holds():
    exists = np.ones((1, 2, 4), bool)
    rows = pack_rows(exists, np.array([[[True, True], [False, False]]]), Packing(width=6, contacts=1))
    assert rows.source[0, 0].tolist() == [0, 1, 2, 3, -1, -1]
    assert rows.predicts[0, 0].tolist() == [1, 2, -1]


@pytest.mark.parametrize(
    ("packing", "message"),
    [
        ({"width": 7, "contacts": 1}, "width is 7: contact 1, question 0 has 8 tokens and must fit into a row; 8 are"),
        ({"width": 8, "contacts": 3}, "contacts is 3: 1 micro-batches of such groups must divide the 2 contacts"),
        ({"width": 8, "contacts": 2, "micro_batches": 2}, "contacts is 2: 2 micro-batches of such groups must divide"),
    ],
)
def test_what_does_not_fit_is_named(packing, message):
    exists = np.ones((2, 1, 8), bool)
    exists[0, 0, 0] = False
    with pytest.raises(ValueError, match=message):
        pack_rows(exists, np.ones((2, 1, 3), bool), Packing(**packing))


@pytest.mark.parametrize("field", ["width", "contacts", "micro_batches"])
def test_sizes_must_be_positive(field):
    with pytest.raises(ValueError, match=f"{field} is 0: must be at least 1"):
        Packing(**{"width": 8, "contacts": 1, field: 0})


def test_rows_are_of_the_micro_batches_that_are_computed(params, batch):
    rows = packed(batch, Packing(width=WIDTH, contacts=2, micro_batches=2))
    with pytest.raises(ValueError, match="rows were packed for 2 micro-batches: must be as many as the gradient's, 4"):
        sft_gradient(FNS, params, rows, micro_contacts=1)


def test_rows_know_how_full_they_are():
    source = np.array([[[0, 1, -1], [2, -1, -1]], [[0, 1, 2], [-1, -1, -1]]])
    assert filled(PackedRows(source=source, predicts=source, contacts=1, micro_batches=1)) == (6, 9)
