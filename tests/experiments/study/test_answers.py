"""What policies answer and what answers earn: rewards by hand, blocks, streams one by one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.experiments import tiny
from tests.experiments.study.test_study import answers_about
from touchr1_jax.rewards import make_rewards, total_reward
from touchr1_jax.rl.rollout import GreedyAnswers, SampleConfig, sample_group
from touchr1_jax.training.evaluation import evaluate_policy, in_flight, reward_terms, rewards_of, sample_program
from touchr1_jax.training.questions import question_batch
from touchr1_jax.types import Parsed

WEIGHTS = {"accuracy_debiased": 0.6, "consistency": 0.3, "format": 0.1}


@pytest.fixture(scope="module")
def said(data):
    """Made-up answers to all questions about the test contacts, right and wrong, parsed and not."""
    return answers_about(data.labels("test"))


def test_the_terms_of_a_reward_sum_to_the_total(policy, data, said):
    prior = data.prior()
    terms = reward_terms(policy, said, WEIGHTS, prior)
    target = policy.target(said.attribute, said.label, said.streams)
    rewards = make_rewards(prior)
    total = jax.jit(jax.vmap(lambda p, t: total_reward(rewards, WEIGHTS, p, t)[0]))(said.parsed, target)
    assert set(terms) == set(WEIGHTS)
    np.testing.assert_allclose(np.sum(list(terms.values()), 0), total, atol=1e-6)
    np.testing.assert_allclose(rewards_of(policy, said, WEIGHTS, prior), total, atol=1e-6)
    np.testing.assert_array_equal(
        rewards_of(policy, said, WEIGHTS, prior.astype(float)), rewards_of(policy, said, WEIGHTS, prior)
    )
    assert np.ptp(np.asarray(total)) > 0.1


def test_a_perfect_answer_earns_the_sum_of_the_weights_and_silence_the_penalty(policy, data, said):
    weights = {"exact": 0.6, "consistency": 0.3, "format": 0.1}
    n = len(said.contact)
    perfect = Parsed(
        perceive=np.repeat(said.label[:, None], 4, 1).astype(np.int32),
        compare=said.label.astype(np.int32),
        conclude=said.label.astype(np.int32),
        formatted=np.ones(n, bool),
        truncated=np.zeros(n, bool),
        length=np.zeros(n, np.int32),
    )
    silent = jax.tree.map(lambda x: x & False if x.dtype == bool else x * 0 - 1, perfect)
    touched = dataclasses.replace(said, streams=np.ones((n, 4), bool), parsed=perfect)
    np.testing.assert_allclose(rewards_of(policy, touched, weights, data.prior()), 1.0, atol=1e-6)
    mute = reward_terms(policy, dataclasses.replace(touched, parsed=silent), weights, data.prior())
    material = said.attribute == 3  # consistency does not apply: the other weights grow from 0.7 to 1
    np.testing.assert_allclose(mute["exact"], np.where(material, -0.06 / 0.7, -0.06), atol=1e-6)


LABEL = np.array([[0, 1, 2, 8], [2, 1, 0, 0], [1, 1, 1, 4]], np.int32)


@pytest.mark.long
def test_padding_the_last_block_changes_nothing(policy, params):
    ask = lambda features, label: evaluate_policy(policy, params, features, label, batch_size=8)  # of two contacts
    features = tiny.features(3)
    whole, padded = (ask(jax.tree.map(lambda x, n=n: x[:n], features), LABEL[:n]) for n in (2, 3))
    assert (len(whole.tokens), len(padded.tokens)) == (8, 12)
    assert (len(whole.alone), len(padded.alone)) == (8, 12)
    for a, b in zip(jax.tree.leaves(vars(whole)), jax.tree.leaves(vars(padded)), strict=True):
        assert np.array_equal(a, b[:8])
    last = ask(jax.tree.map(lambda x: x[2:], features), LABEL[2:])  # four questions and four repeats
    assert np.array_equal(last.tokens, padded.tokens[8:])
    assert np.array_equal(last.alone, padded.alone[8:])
    assert len(np.unique(padded.tokens, axis=0)) > 1, "a policy that says one thing tests nothing"


@pytest.mark.long
def test_the_marginal_is_the_mean_over_traces_of_the_levels_that_may_follow(policy, params):
    """As the learner's forward pass scores them; under the grammar every trace concludes."""
    contact, attribute = np.divmod(np.arange(8), 4)
    batch = question_batch(policy, tiny.features(2), LABEL[:2], contact, attribute, np.ones((8, 4), bool))
    marginal = sample_program(policy, 3, constrained=True)(params, batch, jax.random.key(1))[1]
    fns, known, length = policy.fns, policy.level_tokens, policy.model.completion_tokens
    draw = SampleConfig(group=3, length=length, end_ids=fns.end_ids, pad_id=fns.pad_id, constraint=policy.constraint)
    sample = jax.jit(lambda params, batch: sample_group(fns, params, batch, jax.random.key(1), draw).tokens)
    tokens = np.asarray(sample(params, batch))
    score = jax.jit(jax.vmap(fns.group_logits, (None, 0, 0, 0, 0)))
    logits = score(params, batch.features, batch.ids, batch.mask, tokens)
    for i, a in enumerate(attribute):
        at = (tokens[i] == known.opens).argmax(-1) + 1
        scores = np.asarray(logits)[i, np.arange(3), at][:, known.level[a, : policy.levels[a]]]
        expected = np.asarray(jax.nn.softmax(scores)).mean(0)
        np.testing.assert_allclose(marginal[i, : policy.levels[a]], expected, atol=1e-6)
        assert not marginal[i, policy.levels[a] :].any()


def test_results_are_dispatched_ahead_and_come_in_order():
    dispatched = []
    results = in_flight((dispatched.append(i) or i for i in range(5)), 2)
    assert next(results) == 0
    assert dispatched == [0, 1, 2]
    assert [*results] == [1, 2, 3, 4]


def felt_sum(decoder, batch):
    """In the place of a policy: its answer to everything is the sum of 2^s over the streams that it feels."""
    del decoder
    said = jnp.tile((batch.features.stream_mask @ (1 << np.arange(4)))[:, None], (1, 4)).astype(jnp.int32)
    flag, silent = jnp.zeros(len(said), bool), jnp.zeros(len(said), jnp.int32)
    parsed = Parsed(
        perceive=said[:, None] + 0 * said[:, :, None],
        compare=said,
        conclude=said,
        formatted=flag,
        truncated=flag,
        length=silent,
    )
    return GreedyAnswers(tokens=batch.ids, parsed=parsed)


def test_every_labelled_question_is_asked_with_all_streams_and_each_alone(policy):
    done = []
    present = np.array([[True] * 4, [True, False, True, False]])
    features = dataclasses.replace(tiny.features(2), stream_mask=present)
    label = LABEL[:2].copy()
    label[0, 1] = -1
    said = evaluate_policy(
        policy, {"decoder": {}}, features, label, answer=felt_sum, progress=lambda n, total: done.append((n, total))
    )
    assert list(zip(said.contact, said.attribute, strict=True)) == list(zip(*np.nonzero(label >= 0), strict=True))
    assert np.array_equal(said.tokens, policy.layout.ids[said.attribute])
    assert np.array_equal(said.streams, present[said.contact])
    assert np.array_equal(said.label >= 0, np.arange(4) == said.attribute[:, None])
    assert np.array_equal(said.label.max(1), label[said.contact, said.attribute])
    assert said.parsed.conclude[:, 0].tolist() == [15] * 3 + [5] * 4
    assert said.alone[:, :, 0].tolist() == [[1, 2, 4, 8]] * 3 + [[1, 0, 4, 0]] * 4
    assert (done[0], done[-1]) == ((0, 35), (35, 35))  # seven questions, by all streams and each of four
