"""The stages in their parts: evidence, noise, rewards, evaluation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.policies import stages
from experiments.policies.stages import (
    Evaluated,
    Probed,
    evaluate_policy,
    gather_evidence,
    noise_bank,
    reward_of,
    reward_terms,
)
from sensors_io.schema import CLIP_ARRAYS, LEVELS
from tests.experiments import tiny
from touchr1_jax.rewards import make_rewards, total_reward
from touchr1_jax.rl.greedy import Answers
from touchr1_jax.training.evidence import ProbeConfig
from touchr1_jax.types import Parsed

WEIGHTS = {"accuracy_debiased": 0.6, "consistency": 0.3, "format": 0.1}
PROBE = ProbeConfig(folds=2, iterations=4)


@pytest.fixture(scope="module")
def probed(data):
    """Random features of every stream; sensors 0 and 1 miss one contact each, sensor 2 saw one alone, sensor 3 none."""
    n = len(data.store)
    present = np.ones((n, 4), bool)
    present[data.parts["sft"][:2], [0, 1]] = False
    present[:, 2] = np.arange(n) == data.parts["sft"][0]
    present[:, 3] = False
    streams = np.random.default_rng(0).normal(size=(n, 4, 5)).astype(np.float32)
    return Probed(streams=streams, present=present, force=np.zeros((n, 1), np.float32))


def test_evidence_of_what_was_felt_is_a_distribution_and_of_the_rest_nothing(data, probed):
    evidence = gather_evidence(data, probed, PROBE)
    sft = np.isin(np.arange(len(data.store)), data.parts["sft"])
    for a, levels in enumerate(LEVELS.values()):
        assert (evidence[:, :, a, levels:] == -np.inf).all()
        for s in (0, 1):
            felt = sft & probed.present[:, s]
            known = evidence[:, s, a, :levels]
            np.testing.assert_allclose(np.exp(known[felt]).sum(-1), 1, atol=1e-5)
            assert np.ptp(known[felt], axis=-1).min() > 0
            assert (known[~felt] == 0).all()
        assert (evidence[:, 3, a, :levels] == 0).all()  # sensor 3 was never there
        assert (evidence[:, 2, a, :levels] == 0).all()  # one object cannot be held out


def test_an_attribute_that_nobody_annotated_has_no_evidence(data, probed):
    label = np.where(np.arange(4) == 0, -1, data.label)
    evidence = gather_evidence(dataclasses.replace(data, label=label), probed, PROBE)
    assert (evidence[:, :, 0, :3] == 0).all()
    assert (evidence[data.parts["sft"][1:], 0, 1, :3] != 0).all()


class Mirror:
    """In the place of an agent: the streams that it is given, unencoded."""

    def encode_streams(self, params, pixels, push, index, mask, sensor):
        del params
        rows = [x.reshape(len(sensor), -1).astype(jnp.float32) for x in (pixels, push, index, mask)]
        return jnp.concatenate(rows, -1)[:, None]


@pytest.fixture
def bank(data, monkeypatch):
    """Draw noise from given clips; returns pixels, forces, frame indices and masks, leading [K, S, F]."""

    def draw(clip: dict[str, np.ndarray], draws: int):
        monkeypatch.setattr(stages, "clip_batches", lambda *args, **kwargs: iter([clip]))
        made = np.asarray(noise_bank(Mirror(), {}, data, seed=3, draws=draws))[:, :, 0]
        s, f, h, w = clip["frames"].shape[1:5]
        ends = np.cumsum([f * h * w * 3, f * 3, f])
        pixels, force, index, mask = np.split(made, ends, -1)
        return pixels.reshape(draws, s, f, h * w, 3), force.reshape(draws, s, f, 3), index, mask

    return draw


def touched(levels: np.ndarray, pushes: np.ndarray, contacts: int = 4) -> dict[str, np.ndarray]:
    """Clips of two sensors whose last frame is padding, white and pushed with 10⁶ N; sensor 1 misses contact 0."""
    sizes = {"P": contacts, "S": 2, "F": 3, "H": 8, "W": 8, "Hv": 4, "Wv": 4, "A": 4, "3": 3}
    shape = lambda spec: tuple(sizes[d] for d in ("P", *spec.dims))
    clip = {name: np.zeros(shape(spec), spec.dtype) for name, spec in CLIP_ARRAYS.items()}
    clip["frames"][:] = levels
    clip["force_n"][:] = pushes
    clip["frame_mask"][:, :, :2] = True
    clip["frame_mask"][0, 1] = False
    clip["frame_index"][:] = 10 * np.arange(contacts)[:, None, None] + np.arange(3)
    clip["frames"][~clip["frame_mask"]] = 255
    clip["force_n"][~clip["frame_mask"]] = 1e6
    return clip


def test_noise_of_a_constant_touch_is_that_constant_whatever_the_padding_holds(bank):
    levels = np.array([[40, 50, 60], [70, 80, 90]])[:, None, None, None, :]  # [S, 1, 1, 1, 3]
    pushes = np.array([[1.0, 2, -3], [4, 5, -6]])[:, None, :]
    pixels, force, _, _ = bank(touched(levels, pushes), 2)
    np.testing.assert_allclose(pixels, np.broadcast_to(levels[:, :, 0], pixels.shape), atol=1e-3)
    np.testing.assert_allclose(force, np.broadcast_to(pushes, force.shape), atol=1e-5)


def test_noise_has_the_mean_and_spread_of_the_recorded_frames(bank):
    stripes = np.where(np.arange(8) % 2, 120, 80)[:, None]  # mean 100, σ 20
    pushes = np.array([0.0, 4.0, 0.0])[:, None]  # frames 0 and 1 count: mean 2, σ 2
    pixels, force, _, _ = bank(touched(stripes, pushes), 400)
    np.testing.assert_allclose(pixels.mean((0, 2, 3)), 100, atol=0.5)
    np.testing.assert_allclose(pixels.std((0, 2, 3)), 20, atol=0.5)
    np.testing.assert_allclose(force.mean((0, 2)), 2, atol=0.3)
    np.testing.assert_allclose(force.std((0, 2)), 2, atol=0.3)


def test_noise_keeps_the_frame_times_of_the_contacts_and_no_frame_repeats(bank):
    clip = touched(np.where(np.arange(8) % 2, 120, 80)[:, None], np.zeros(3))
    pixels, _, index, mask = bank(clip, 6)
    rows = np.arange(6) % 4
    assert np.array_equal(index, clip["frame_index"][rows])
    assert np.array_equal(mask, clip["frame_mask"][rows])
    assert len(np.unique(pixels[..., 0, 0])) == pixels[..., 0, 0].size


@pytest.fixture(scope="module")
def said(data):
    """Made-up answers to all questions about the test contacts, right and wrong, parsed and not."""
    rng = np.random.default_rng(0)
    contact, attribute = np.nonzero(data.label[data.parts["test"]] >= 0)
    n, asked = len(contact), np.arange(4) == attribute[:, None]
    level = lambda *shape: np.where(asked if len(shape) < 3 else asked[:, None], rng.integers(-1, 3, shape), -1)
    return Evaluated(
        contact=contact,
        attribute=attribute,
        streams=rng.random((n, 4)) < 0.7,
        tokens=np.zeros((n, 0), np.int32),
        parsed=Parsed(
            perceive=level(n, 4, 4).astype(np.int32),
            compare=level(n, 4).astype(np.int32),
            conclude=level(n, 4).astype(np.int32),
            formatted=rng.random(n) < 0.7,
            truncated=np.zeros(n, bool),
            length=np.zeros(n, np.int32),
        ),
        label=np.where(asked, data.label[data.parts["test"]][contact], -1),
        alone=None,
    )


def test_the_terms_of_a_reward_sum_to_the_total(assembly, data, said):
    prior = data.prior()
    terms = reward_terms(assembly, said, WEIGHTS, prior)
    target = assembly.target(said.attribute, said.label, said.streams)
    rewards = make_rewards(prior)
    total = jax.jit(jax.vmap(lambda p, t: total_reward(rewards, WEIGHTS, p, t)[0]))(said.parsed, target)
    assert set(terms) == set(WEIGHTS)
    np.testing.assert_allclose(np.sum(list(terms.values()), 0), total, atol=1e-6)
    np.testing.assert_allclose(reward_of(assembly, said, WEIGHTS, prior), total, atol=1e-6)
    assert np.ptp(np.asarray(total)) > 0.1


def test_a_perfect_answer_earns_the_sum_of_the_weights_and_silence_the_penalty(assembly, data, said):
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
    felt = dataclasses.replace(said, streams=np.ones((n, 4), bool), parsed=perfect)
    np.testing.assert_allclose(reward_of(assembly, felt, weights, data.prior()), 1.0, atol=1e-6)
    mute = reward_terms(assembly, dataclasses.replace(felt, parsed=silent), weights, data.prior())
    material = said.attribute == 3  # consistency does not apply: the other weights grow from 0.7 to 1
    np.testing.assert_allclose(mute["exact"], np.where(material, -0.06 / 0.7, -0.06), atol=1e-6)


@pytest.fixture(scope="module")
def ask(assembly, params):
    """Evaluate some contacts in blocks of eight questions, two contacts each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "EVAL_BATCH", 8)
        yield lambda features, label: evaluate_policy(assembly, params, features, label)


LABEL = np.array([[0, 1, 2, 8], [2, 1, 0, 0], [1, 1, 1, 4]], np.int32)


def test_padding_the_last_block_changes_nothing(assembly, ask):
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
    return Answers(tokens=batch.ids, parsed=parsed)


def test_every_labelled_question_is_asked_with_all_streams_and_each_alone(assembly, monkeypatch):
    monkeypatch.setattr(stages, "answer_program", lambda assembly: felt_sum)
    present = np.array([[True] * 4, [True, False, True, False]])
    features = dataclasses.replace(tiny.features(2), stream_mask=present)
    label = LABEL[:2].copy()
    label[0, 1] = -1
    said = evaluate_policy(assembly, {"decoder": {}}, features, label)
    assert list(zip(said.contact, said.attribute, strict=True)) == list(zip(*np.nonzero(label >= 0), strict=True))
    assert np.array_equal(said.tokens, assembly.layout.ids[said.attribute])
    assert np.array_equal(said.streams, present[said.contact])
    assert np.array_equal(said.label >= 0, np.arange(4) == said.attribute[:, None])
    assert np.array_equal(said.label.max(1), label[said.contact, said.attribute])
    assert said.parsed.conclude[:, 0].tolist() == [15] * 3 + [5] * 4
    assert said.alone[:, :, 0].tolist() == [[1, 2, 4, 8]] * 3 + [[1, 0, 4, 0]] * 4


def test_a_policy_that_feels_nothing_is_not_asked_stream_by_stream(assembly, monkeypatch):
    monkeypatch.setattr(stages, "answer_program", lambda assembly: felt_sum)
    features = dataclasses.replace(tiny.features(1), stream_mask=np.zeros((1, 4), bool))
    assert evaluate_policy(assembly, {"decoder": {}}, features, LABEL[:1]).alone is None


def test_the_answers_are_what_the_metrics_read(said):
    reward = np.arange(len(said.contact), dtype=float)
    answers = said.answers(reward)
    assert answers.reward is reward
    assert np.array_equal(answers.conclude, said.parsed.conclude)
    assert np.array_equal(answers.perceive, said.parsed.perceive)
    assert np.array_equal(answers.label, said.label)
