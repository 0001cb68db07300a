"""What the stages are fed: right answers, random questions, exact resumption."""

import dataclasses
import itertools
import json
import threading
from functools import partial

import jax
import numpy as np
import pytest

from experiments.study.stages import StudySFT, answer_feed
from sensors_io.augment import AugmentConfig
from sensors_io.pipeline import clip_batches
from sensors_io.schema import LEVELS
from tests.experiments import tiny
from touchr1_jax.text.oracle import read
from touchr1_jax.training.feeds import (
    AnswerFeed,
    encoded_clips,
    falling_share,
    random_streams,
    take,
    verified_answer,
)
from touchr1_jax.training.packing import Packing
from touchr1_jax.training.questions import QuestionFeed, equal_blocks, question_batch
from touchr1_jax.training.train_encoder import touch_rows


@pytest.fixture(scope="module")
def evidence(data):
    """Made-up evidence of every contact; −∞ past an attribute's levels."""
    drawn = np.random.default_rng(0).normal(size=(len(data.store), 4, 4, 9)).astype(np.float32)
    exists = np.arange(9) < np.array(list(LEVELS.values()))[:, None]
    return np.where(exists, drawn, -np.inf)


@pytest.fixture(scope="module")
def clips(data):
    """Three contacts; sensor 3 did not see the last one."""
    rows = data.parts["sft"][:3]
    clips = next(iter(clip_batches(data.store, rows, data.clip, batch_size=3, seed=0, shuffle=False, repeat=False)))
    clips["stream_mask"] = clips["stream_mask"].copy()
    clips["stream_mask"][2, 3] = False
    return clips


@pytest.fixture
def answers(policy, data, evidence):
    def feed(**changes):
        order = {"batch_size": 3, "seed": 1} | {k: v for k, v in changes.items() if k in ("seed", "own")}
        clips = data.batches(data.parts["sft"], with_touch=not changes.get("blind"), **order)
        return AnswerFeed(policy, clips, evidence, **{"questions": 3, **order, **changes})

    return feed


@pytest.fixture
def encoded(policy, data, evidence):
    """The same contacts, encoded once."""
    rows = data.parts["sft"]

    def feed(**changes):
        order = {"batch_size": 3, "seed": 1} | changes
        clips = encoded_clips(tiny.features(len(rows)), rows, data.label[rows], **order)
        return AnswerFeed(policy, clips, evidence, questions=3, **order)

    return feed


@pytest.fixture(scope="module")
def features(data):
    return tiny.features(len(data.parts["grpo"]))


@pytest.fixture
def questions(policy, data, features):
    label = data.label[data.parts["grpo"]]
    return lambda **changes: QuestionFeed(policy, features, label, **{"batch_size": 4, "seed": 1, **changes})


def test_batches_of_one_have_the_order_of_larger_ones(encoded, questions):
    rows = lambda size: np.concatenate(
        list(itertools.islice(touch_rows(np.arange(5), np.arange(5), batch_size=size, seed=1), 12 // size))
    )
    assert rows(1).tolist() == rows(4).tolist()
    ids = lambda size: np.concatenate([b.ids for b in itertools.islice(questions(batch_size=size), 12 // size)])
    np.testing.assert_array_equal(ids(1), ids(4))
    assert next(encoded(batch_size=1)).ids.shape[:2] == (1, 3)


@pytest.fixture
def feeds(answers, encoded, questions):
    packed = partial(answers, packing=Packing(width=128, contacts=1))  # whoever reads some contacts packs those alone
    return {"answers": answers, "encoded": encoded, "questions": questions, "packed": packed}


def attribute_of(policy, ids: np.ndarray) -> int:
    """The attribute that a prompt asks for."""
    return int(np.flatnonzero((policy.layout.ids == ids).all(-1))[0])


def readings(policy, batch):
    """Contact, attribute, streams and text of every question, read by the slow and obvious parser."""
    tokenizer, p, q = policy.tokenizer, *batch.ids.shape[:2]
    for i in range(p):
        for j in range(q):
            tokens = np.asarray(batch.tokens[i, j])[np.asarray(batch.token_mask[i, j])]
            assert tokens[-1] == tokenizer.end_ids[0]
            said = read(policy.language, tokenizer.decode(tokens[:-1]))
            yield i, attribute_of(policy, batch.ids[i, j]), np.asarray(batch.streams[i, j]), said


def test_the_concluded_level_weighs_what_it_is_told(policy, answers, clips):
    """One token of each answer: the level after `<conclude>`; the same words before it weigh 1."""
    plain, weighted = (answers(**more).make(clips, np.random.default_rng(0)) for more in ({}, {"conclusion_weight": 5}))
    assert plain.weight is None
    np.testing.assert_array_equal(plain.tokens, weighted.tokens)
    for tokens, weight in zip(*(x.reshape(-1, x.shape[-1]) for x in (weighted.tokens, weighted.weight)), strict=True):
        heavy = np.flatnonzero(weight != 1)
        words = [policy.tokenizer.decode([token]).strip() for token in tokens]
        assert (len(heavy), weight[heavy[0]], words[heavy[0] - 1]) == (1, 5, "<conclude>")


def test_answers_say_what_the_evidence_and_the_labels_say(policy, answers, clips, evidence):
    seen = 0
    for draw in range(8):
        batch = answers().make(clips, np.random.default_rng(draw))
        for i, a, streams, said in readings(policy, batch):
            of_contact = evidence[clips["contact"][i], :, a]
            assert said.formatted
            for s in range(4):
                assert said.perceive[s][a] == (of_contact[s].argmax() if streams[s] else -1)
            assert said.compare[a] == of_contact[streams].sum(0).argmax()
            assert said.conclude[a] == clips["label"][i, a]
            assert [b for b in range(4) if said.conclude[b] >= 0] == [a]  # nothing that was not asked
            seen += said.compare[a] != said.conclude[a]
    assert seen, "evidence that always agrees with the label tests nothing"


def test_absent_streams_are_never_asked_about(answers, clips):
    for draw in range(10):
        streams = np.asarray(answers().make(clips, np.random.default_rng(draw)).streams)
        assert not streams[2, :, 3].any()
        assert streams.any(-1).all()


def test_an_attribute_that_nobody_annotated_has_no_answer_and_no_loss(policy, answers, clips):
    """The questions of a contact are about different attributes."""
    hidden = clips | {"label": np.where(np.arange(4) == 1, -1, clips["label"])}
    batch = answers(questions=4).make(hidden, np.random.default_rng(0))
    for i in range(3):
        asked = np.array([attribute_of(policy, ids) for ids in batch.ids[i]])
        assert sorted(asked) == [0, 1, 2, 3]
        assert np.array_equal(batch.token_mask[i].any(-1), asked != 1)
        assert (batch.tokens[i, asked == 1] == policy.tokenizer.pad_id).all()


def test_a_blind_policy_perceives_nothing_and_is_told_the_label(policy, answers, clips):
    batch = answers(blind=True).make(clips, np.random.default_rng(0))
    assert not batch.streams.any()
    for i, a, _, said in readings(policy, batch):
        assert said.perceive == [[-1] * 4] * 4
        assert said.compare[a] == said.conclude[a] == clips["label"][i, a]
    batch = next(answers(blind=True))
    assert not np.asarray(batch.touch.stream_mask).any()
    assert np.asarray(batch.touch.frames).size < np.asarray(batch.touch.view).size


def test_the_feed_of_a_study_reads_sft_contacts_alone_and_changes_their_touch_at_random(policy, data, evidence):
    views = {data.store.objects[data.object_ids[i]].view.tobytes() for i in data.parts["sft"]}
    config = StudySFT(batch_size=5, micro_contacts=5)
    mirrored = dataclasses.replace(config, augment=AugmentConfig(mirror=1))
    plain, changed = (next(answer_feed(policy, data, evidence, c, seed=1)) for c in (config, mirrored))
    assert {view.tobytes() for view in np.asarray(plain.touch.view)} <= views
    assert (np.asarray(plain.touch.frames) != np.asarray(changed.touch.frames)).any()
    np.testing.assert_array_equal(changed.touch.force_n[..., 0], -plain.touch.force_n[..., 0])
    for name in ("ids", "streams", "tokens", "token_mask"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(changed, name))


def test_rows_hold_the_examples_of_the_batch_and_nothing_else_changes(policy, answers):
    plain, packed = (next(answers(packing=packing)) for packing in (None, Packing(width=128, contacts=3)))
    assert equal([leaves(plain)], [leaves(packed.replace(rows=None))])
    n = packed.ids.shape[-1] + packed.tokens.shape[-1]
    tokens = np.concatenate([packed.ids, packed.tokens], -1).reshape(-1)
    said = [tokens[row[at[at >= 0] + 1]] for row, at in rows_of(packed.rows)]
    assert sorted(np.concatenate(said)) == sorted(packed.tokens[packed.token_mask])
    sensed = np.concatenate([row for row, _ in rows_of(packed.rows)])
    touch = np.isin(sensed % n, policy.layout.touch.ravel())
    steps = packed.streams[..., None] & packed.touch.frame_mask[:, None]  # a step is a frame here
    assert touch.sum() == steps.sum() * policy.model.tactile.tokens_per_step


def rows_of(rows):
    """Source and predicting places of equal_blocks row of one group."""
    for row, at in zip(rows.source.reshape(-1, 128), rows.predicts.reshape(-1, rows.predicts.shape[-1]), strict=True):
        yield row[row >= 0], at


def test_encoded_contacts_come_with_their_own_features_and_answers(policy, data, encoded, evidence):
    rows, features = data.parts["sft"], tiny.features(len(data.parts["sft"]))
    batch = next(encoded())
    of_row = {features.touch[i].tobytes(): contact for i, contact in enumerate(rows)}
    contacts = [of_row[np.asarray(touch).tobytes()] for touch in batch.touch.touch]
    for i, a, streams, said in readings(policy, batch):
        assert said.conclude[a] == data.label[contacts[i], a]
        assert said.compare[a] == evidence[contacts[i]][streams, a].sum(0).argmax()


def test_a_sensor_without_evidence_repeats_the_others_and_without_any_the_label(policy, evidence):
    """A probe of too few labelled objects is not fitted: its level would be the first one, of every contact."""
    label, streams, exists = np.array([2, 1, 1, 5]), np.array([True, True, True, False]), np.isfinite(evidence[0])
    for some in (np.array([False, True, False, True]), np.zeros(4, bool)):
        log_prob = np.where(exists, np.where(some[:, None, None], evidence[0], 0.0), -np.inf)
        for a in range(4):
            tokens, counts = verified_answer(policy, log_prob, a, label, streams)
            said = read(policy.language, policy.tokenizer.decode(tokens[counts][:-1]))
            together = evidence[0, 1, a].argmax() if some.any() else label[a]
            assert [level[a] for level in said.perceive] == [together, together, together, -1]
            assert (said.compare[a], said.conclude[a]) == (together, label[a])


def test_a_question_of_grpo_comes_with_its_verified_answer(policy, questions, data, evidence):
    contact = data.parts["grpo"]
    for batch in itertools.islice(questions(evidence=evidence[contact]), 3):
        for i, ids in enumerate(batch.ids):
            a = attribute_of(policy, ids)
            said = read(policy.language, policy.tokenizer.decode(batch.answer[i][batch.answer_mask[i]][:-1]))
            assert said.conclude[a] == batch.target.label[i, a]
            assert [level[a] >= 0 for level in said.perceive] == batch.target.streams[i].tolist()
    assert next(questions()).answer is None


KINDS = ["answers", "encoded", "questions", "packed"]


@pytest.mark.parametrize("kind", KINDS)
def test_one_seed_is_one_sequence_of_batches(feeds, kind):
    make = feeds[kind]
    first, again, other = ([leaves(next(feed)) for _ in range(3)] for feed in (make(), make(), make(seed=2)))
    assert equal(first, again)
    assert not equal(first, other)
    assert not equal(first[:1], first[1:2])


@pytest.mark.parametrize(("kind", "changes"), [*((kind, {}) for kind in KINDS), ("answers", {"easy_steps": 10})])
def test_a_state_resumes_exactly(feeds, kind, changes):
    make = partial(feeds[kind], **changes)
    feed = make()
    next(feed), next(feed)
    state = json.loads(json.dumps(feed.get_state()))
    rest = [leaves(next(feed)) for _ in range(3)]
    fresh = make()
    fresh.set_state(state)
    assert equal(rest, [leaves(next(fresh)) for _ in range(3)])
    feed.set_state(state)  # back again in the feed that went on
    assert equal(rest[:1], [leaves(next(feed))])


@pytest.mark.parametrize("kind", KINDS)
def test_processes_that_share_batches_make_them_together(feeds, kind):
    """What is drawn is drawn for the whole batch, so that it does not matter who makes which rows."""
    make = feeds[kind]
    for own in (np.array([0, 2]), np.array([1])):
        part, whole = make(own=own), make()
        for _ in range(3):
            assert equal([leaves(next(part))], [[x[own] for x in leaves(next(whole))]])


def leaves(batch) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(batch)]


def equal(a, b) -> bool:
    return all(np.array_equal(x, y) for m, n in zip(a, b, strict=True) for x, y in zip(m, n, strict=True))


def contacts_of(features, batch) -> list[int]:
    """The contacts that the questions of a batch are about, by their touch."""
    return [int(np.flatnonzero((features.touch == touch).all((1, 2, 3)))[0]) for touch in batch.features.touch]


def test_targets_hold_every_label_with_the_one_that_is_asked(policy, features, data):
    """Only hardness is asked about; a reward sees the material and all else that is true of the contact."""
    truth = data.labels("grpo")
    label = np.where(np.arange(4) == 0, truth, -1)
    questions = QuestionFeed(policy, features, label, batch_size=4, seed=1, truth=truth)
    for _, batch in zip(range(5), questions, strict=False):
        target = jax.tree.map(np.asarray, batch.target)
        assert (target.asked == [True, False, False, False]).all()
        np.testing.assert_array_equal(target.label, truth[contacts_of(features, batch)])


def test_every_question_comes_once_an_epoch_and_none_without_a_label(policy, features, data):
    label = np.where(np.arange(4) == 3, -1, data.label[data.parts["grpo"]])
    total = int((label >= 0).sum())
    batch = next(QuestionFeed(policy, features, label, batch_size=total, seed=0))
    asked, contact = np.asarray(batch.target.asked).argmax(1), contacts_of(features, batch)
    assert sorted(zip(contact, asked, strict=True)) == list(zip(*np.nonzero(label >= 0), strict=True))
    np.testing.assert_array_equal(batch.target.label, label[contact])


@pytest.mark.parametrize("full_share", [0.0, 0.5, 1.0])
def test_all_streams_are_felt_as_often_as_is_asked(full_share):
    n = 20_000
    streams = random_streams(np.ones((n, 4), bool), full_share, np.random.default_rng(0))
    full = full_share + (1 - full_share) / 4  # a random subset of 1 to 4 sensors may be all of them
    assert streams.all(1).mean() == pytest.approx(full, abs=0.01)
    assert np.ptp(streams.mean(0)) < 0.02  # no sensor is favoured


def test_a_curriculum_begins_with_all_sensors(answers, data):
    """Of batch after batch, as many questions have touch of all sensors as `falling_share` says; then as without it."""
    assert [falling_share(step, 4) for step in range(6)] == [1, 0.875, 0.75, 0.625, 0.5, 0.5]
    assert falling_share(0, 0) == falling_share(100, 0) == 0.5
    feed, plain = answers(easy_steps=3), answers()
    sensed = [(np.asarray(next(feed).streams), np.asarray(next(plain).streams)) for _ in range(5)]
    assert sensed[0][0].all()
    assert (sensed[0][0] != sensed[0][1]).any()
    assert all((mine >= other).all() for mine, other in sensed)
    assert all((mine == other).all() for mine, other in sensed[3:])


def test_blocks_have_one_size_and_tell_how_many_rows_are_real():
    blocks = [(rows.tolist(), real) for rows, real in equal_blocks(7, 3)]
    assert blocks == [([0, 1, 2], 3), ([3, 4, 5], 3), ([6, 6, 6], 1)]
    assert [(rows.tolist(), real) for rows, real in equal_blocks(2, 4)] == [([0, 1, 1, 1], 2)]
    assert [real for _, real in equal_blocks(6, 3)] == [3, 3]
    assert list(equal_blocks(0, 3)) == []


def test_a_contact_is_not_asked_more_questions_than_there_are(answers):
    with pytest.raises(ValueError, match="questions is 5: must be at most 4"):
        answers(questions=5)


def test_the_order_of_questions_is_not_made_ahead(questions):
    """Grain's threads would shuffle 500 batches while the training that they are for runs."""
    before = set(threading.enumerate())
    feed = questions()
    next(feed)
    assert set(threading.enumerate()) <= before  # those of other feeds may end meanwhile


def test_a_question_says_what_it_asks_and_is_felt_by_the_streams_that_it_says(policy, features, data):
    label, rows, attribute = data.label[data.parts["grpo"]], np.array([2, 0]), np.array([1, 3])
    streams = np.array([[True, False, False, True], [False, True, True, False]])
    batch = question_batch(policy, features, label, rows, attribute, streams)
    assert [attribute_of(policy, ids) for ids in batch.ids] == [1, 3]
    np.testing.assert_array_equal(batch.mask, policy.layout.mask[attribute])
    np.testing.assert_array_equal(batch.features.stream_mask, streams & features.stream_mask[rows])
    np.testing.assert_array_equal(batch.features.touch, features.touch[rows])
    assert not batch.ordered.any()  # a press shows its peak in whatever order
    np.testing.assert_array_equal(take(features, rows).view, features.view[rows])
    target = batch.target
    np.testing.assert_array_equal(target.streams, streams)
    np.testing.assert_array_equal(target.asked, np.arange(4) == attribute[:, None])
    np.testing.assert_array_equal(target.label, label[rows])
    assert (np.asarray(target.levels) == [3, 3, 3, 9]).all()
    assert (np.asarray(target.ordinal) == [True, True, True, False]).all()
