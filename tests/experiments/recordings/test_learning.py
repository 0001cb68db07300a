"""A policy that learns, says what it learned, and is the same when it is read back."""

import dataclasses

import jax
import numpy as np
import pytest
from rich.console import Console

from experiments.core.context import Context
from experiments.recordings.descriptions import Described
from experiments.recordings.descriptors import families
from experiments.recordings.evidence import EvidenceConfig
from experiments.recordings.learning import Background, LearnConfig, learn, load, save, say
from experiments.recordings.policy import COMBINATIONS, LENGTH, PolicyShape, assemble_policy
from experiments.recordings.scenes import Scenes, sense
from experiments.recordings.training import (
    Lesson,
    ReinforceConfig,
    TuneConfig,
    disturb,
    number,
    reading_lesson,
    reinforce,
)
from sensors_io.importers.keep import ImportSourceError
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.rl.config import GRPOConfig
from touchr1_jax.training.optimizer import OptimizerConfig

SHAPE = PolicyShape(
    tokens=1, width=16, decoder=DecoderConfig(vocab_size=0, hidden_size=32, num_layers=1, num_heads=1, head_dim=32)
)
FAST = OptimizerConfig(learning_rate=1e-5, lr_scale=1000.0)
CONFIG = LearnConfig(
    members=1,
    shape=SHAPE,
    evidence=EvidenceConfig(folds=4),
    reading=TuneConfig(steps=150, batch_size=32, drop=0.0, noise=0.0, optimizer=FAST),
    tune=TuneConfig(steps=0),
)


def worlds(objects=12, videos=2, seed=0):
    """Videos whose description holds their levels, and scenes that obey the same law."""
    rng = np.random.default_rng(seed)
    width = len(families())
    law = rng.standard_normal((3, width))
    level = np.repeat(np.array([[i % 3, (i // 3) % 3, (i // 2) % 3] for i in range(objects)]), videos, axis=0)
    feel = lambda y: (y @ law + 0.1 * rng.standard_normal((len(y), width))).astype(np.float32)
    names = np.array([f"o{i}_{k}" for i in range(objects) for k in range(videos)])
    made = rng.integers(0, 3, (60, 3))
    target = np.concatenate([np.eye(3)[made[:, a]] for a in range(3)] + [np.eye(9)[made[:, 0]]], 1)
    described = Described(
        names=names,
        objects=np.array([name.split("_")[0] for name in names]),
        label=level.astype(np.int32),
        x=feel(level),
        skipped=(),
    )
    return described, Background(scenes=Scenes(x=feel(made), target=target), unlabelled=feel(made)[:5])


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    videos, background = worlds()
    home = tmp_path_factory.mktemp("run")
    context = Context(home, home / "cache", Console(quiet=True))
    learned, course = learn(CONFIG, videos, background, 0, context)
    context.close()
    return videos, learned, course


def test_it_says_what_its_evidence_says(trained):
    videos, learned, course = trained
    assert course["loss"].shape == (1, 0)
    said = say(learned, videos)
    np.testing.assert_allclose(np.exp(said.log_prob).sum(1), 1, rtol=1e-4)
    assert (said.conclude == videos.label).mean() > 0.6


def test_a_policy_read_back_says_the_same(trained, tmp_path):
    videos, learned, _ = trained
    save(tmp_path / "policy.npz", learned)
    again = load(tmp_path / "policy.npz", CONFIG)
    some = videos.rows(np.arange(5))
    np.testing.assert_array_equal(say(again, some).log_prob, say(learned, videos).log_prob[:5])
    with pytest.raises(ImportSourceError, match="another `learn`"):
        load(tmp_path / "policy.npz", dataclasses.replace(CONFIG, components=3))
    with pytest.raises(ImportSourceError, match="no such file"):
        load(tmp_path / "other.npz", CONFIG)


def test_levels_and_names_of_the_videos_asked_about_change_nothing(trained):
    videos, learned, _ = trained
    hidden = dataclasses.replace(videos, label=np.full_like(videos.label, -1), objects=videos.names)
    np.testing.assert_array_equal(say(learned, hidden).log_prob, say(learned, videos).log_prob)


def test_every_answer_fits_and_parses():
    policy = assemble_policy(SHAPE)
    assert policy.answers.shape == (27, 27, LENGTH)
    parsed = jax.vmap(policy.parser)(policy.answers[5])
    np.testing.assert_array_equal(parsed.conclude, COMBINATIONS)
    assert (np.asarray(parsed.perceive)[:, 0] == COMBINATIONS[5]).all()
    assert bool(parsed.formatted.all())
    np.testing.assert_array_equal(number(COMBINATIONS), np.arange(27))


def test_made_up_evidence_is_concluded_from_as_often_as_it_says():
    lesson = reading_lesson(2, 3, 6000, 0)
    assert lesson.x.shape == (6000, 2 * 9 + 3)
    log = np.asarray(lesson.x[:, :18]).reshape(-1, 2, 3, 3)
    np.testing.assert_allclose(log.sum(-1), 0, atol=1e-4)
    p = np.exp(log) / np.exp(log).sum(-1, keepdims=True)
    np.testing.assert_array_equal(p.mean(1).argmax(-1), lesson.percept)
    said = np.eye(3)[np.asarray(lesson.label)]
    cube = p.mean(1) ** 3
    sharp = (cube / cube.sum(-1, keepdims=True))[..., 2]
    assert abs(said[..., 2][sharp > 0.7].mean() - sharp[sharp > 0.7].mean()) < 0.03


def test_scenes_are_sensed_in_the_order_of_their_law():
    videos, background = worlds()
    said = sense(background.scenes, videos.x, videos.x, EvidenceConfig())
    assert said.shape == (24, 18)
    assert np.corrcoef(said[:, :3] @ np.arange(3), videos.label[:, 0])[0, 1] > 0.8


def test_disturbed_inputs_keep_their_mean():
    x = np.ones((4000, 2), np.float32)
    y = np.asarray(disturb(jax.random.key(0), x, TuneConfig(drop=0.5, noise=0.1)))
    assert abs(y.mean() - 1) < 0.05
    assert abs((y == 0).mean() - 0.5) < 0.03


def test_an_encoder_that_reads_nothing_is_refused():
    with pytest.raises(ValueError, match="components is 0"):
        LearnConfig(components=0, read_evidence=False)


@pytest.mark.slow
def test_grpo_moves_the_decoder_alone(trained):
    videos, learned, _ = trained
    policy = assemble_policy(SHAPE)
    params = jax.tree.map(lambda x: x[0], learned.params)
    x = np.zeros((len(videos.names), learned.params["encoder"]["in"]["kernel"].shape[1]), np.float32)
    levels = np.asarray(videos.label)
    lesson = Lesson(x=x, percept=levels, label=levels, weight=np.ones(len(x), np.float32))
    grpo = dataclasses.replace(GRPOConfig.paper(), prompts=4, micro_prompts=4, group=4, length=LENGTH, lr_scale=300.0)
    tuned, log = reinforce(policy, ReinforceConfig(steps=2, grpo=grpo), params, lesson, 0)
    assert len(log) == 2
    assert all(np.isfinite(row["reward"]) for row in log)
    jax.tree.map(np.testing.assert_array_equal, tuned["encoder"], params["encoder"])
    moved = jax.tree.map(lambda a, b: bool((np.asarray(a) != np.asarray(b)).any()), tuned["decoder"], params["decoder"])
    assert any(jax.tree.leaves(moved))
