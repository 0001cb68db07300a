"""A policy that learns, answers by what it learned, resumes, and is the same when it is read back."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from experiments.core.context import Context
from experiments.core.loops import stage_hooks
from experiments.core.metric_log import read_metrics
from experiments.recordings.descriptions import AuxiliaryData, DescribedVideos
from experiments.recordings.learning import LearnConfig, answer_log_probs, learn, load, save
from experiments.recordings.level_probes import BY_ATTRIBUTE, LevelProbeConfig, ProbedVideos
from sensors_io.importers.keep import ImportSourceError
from sensors_io.touches import families
from touchr1_jax.models.description_policy import COMBINATIONS, LENGTH, PolicyShape, choose, description_policy
from touchr1_jax.models.lm import DecoderConfig
from touchr1_jax.training.description_tuning import TuneConfig, number, reading_lesson, tune
from touchr1_jax.training.optimizer import OptimizerConfig

SHAPE = PolicyShape(
    tokens=1, width=16, decoder=DecoderConfig(vocab_size=0, hidden_size=32, num_layers=1, num_heads=1, head_dim=32)
)
FAST = OptimizerConfig(learning_rate=1e-5, lr_scale=1000.0)
CONFIG = LearnConfig(
    members=1,
    shape=SHAPE,
    evidence=LevelProbeConfig(folds=4),
    reading=TuneConfig(
        steps=400, batch_size=64, drop=0.0, noise=0.0, optimizer=dataclasses.replace(FAST, lr_scale=400.0)
    ),
    tune=TuneConfig(steps=0),
)


def worlds(objects=12, videos=2, seed=0):
    """Videos whose description is a noisy linear function of their levels, and scenes that obey the same law."""
    rng = np.random.default_rng(seed)
    law = rng.standard_normal((3, len(families())))
    level = np.repeat(np.array([[i % 3, (i // 3) % 3, (i // 2) % 3] for i in range(objects)]), videos, axis=0)
    described = lambda y: (y @ law + 0.1 * rng.standard_normal((len(y), law.shape[1]))).astype(np.float32)
    names = np.array([f"o{i}_{k}" for i in range(objects) for k in range(videos)])
    made = rng.integers(0, 3, (60, 3))
    target = np.concatenate([np.eye(3)[made[:, a]] for a in range(3)] + [np.eye(9)[made[:, 0]], made], 1)
    kinds = np.array(["levels"] * 9 + ["material"] * 9 + ["physics"] * 3)
    owners = np.array([name.split("_")[0] for name in names])
    real = DescribedVideos(
        names=names, objects=owners, label=level.astype(np.int32), x=described(level), rating=5.0 * level
    )
    x = described(made)
    return real, AuxiliaryData(scene_x=x[None], scene_target=target[None], kinds=kinds, unlabelled=described(made)[:5])


def test_each_attribute_is_read_by_its_own_families():
    videos, auxiliary = worlds()
    read = lambda config: ProbedVideos(videos, auxiliary, videos, config).evidence()
    found = read(LevelProbeConfig())
    for a, own in enumerate(BY_ATTRIBUTE):
        alone = read(LevelProbeConfig(families=own, by_attribute=()))
        np.testing.assert_array_equal(found[:, a], alone[:, a])
        assert (found != alone).any()


def run_context(home):
    return Context(home, home / "cache", Console(quiet=True))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    videos, auxiliary = worlds()
    context = run_context(tmp_path_factory.mktemp("run"))
    learned = learn(CONFIG, videos, auxiliary, 0, context, "policy")
    context.close()
    return videos, learned


@pytest.mark.long
def test_answers_follow_the_evidence(trained):
    videos, learned = trained
    found = answer_log_probs(learned, videos)
    np.testing.assert_allclose(np.exp(found).sum(1), 1, rtol=1e-4)
    assert (choose(found) == videos.label).mean() > 0.6


@pytest.mark.long
def test_a_policy_read_back_answers_the_same(trained, tmp_path):
    videos, learned = trained
    save(tmp_path / "policy.npz", learned)
    again = load(tmp_path / "policy.npz", CONFIG)
    some = videos.rows(np.arange(5))
    np.testing.assert_array_equal(answer_log_probs(again, some), answer_log_probs(learned, some))
    with pytest.raises(ImportSourceError, match="another `learn`"):
        load(tmp_path / "policy.npz", dataclasses.replace(CONFIG, members=3))
    with pytest.raises(ImportSourceError, match="no such file"):
        load(tmp_path / "other.npz", CONFIG)


@pytest.mark.long
def test_training_resumes_from_its_checkpoint(tmp_path):
    """A finished stage is not trained again, and its log is not written twice."""
    policy, lesson, config = description_policy(SHAPE), reading_lesson(1, 64, 0), TuneConfig(steps=3, optimizer=FAST)
    params = policy.fresh(jax.random.key(0), lesson.x.shape[-1])
    runs = []
    for _ in range(2):
        context = run_context(tmp_path)
        with stage_hooks(context, "fold/0", config.steps) as hooks:
            runs.append(tune(policy, config, [params] * 2, [lesson] * 2, [0, 1], hooks))
        context.close()
    jax.tree.map(np.testing.assert_array_equal, *runs)
    first, second = (jax.tree.leaves(member) for member in runs[0])
    assert any((a != b).any() for a, b in zip(first, second, strict=True))
    assert [line["step"] for line in read_metrics(tmp_path)] == [0, 1, 2]


@pytest.mark.long
def test_every_answer_fits_and_parses():
    policy = description_policy(SHAPE)
    assert policy.answers.shape == (27, 27, LENGTH)
    parsed = jax.vmap(policy.parser)(policy.answers[5])
    np.testing.assert_array_equal(parsed.conclude, COMBINATIONS)
    assert (np.asarray(parsed.perceive)[:, 0] == COMBINATIONS[5]).all()
    assert bool(parsed.formatted.all())
    np.testing.assert_array_equal(number(jnp.asarray(COMBINATIONS)), np.arange(27))


def test_conclusions_from_made_up_evidence_follow_the_mean_of_the_touches_that_exist():
    lesson = reading_lesson(2, 600, 0)
    assert lesson.x.shape == (600, 2, 9)
    log = np.asarray(lesson.x).reshape(-1, 2, 3, 3)
    missing = np.isnan(log).any((2, 3))
    assert 200 < missing[:, 1].sum() < 400
    assert not missing[:, 0].any()
    p = np.exp(log) / np.exp(log).sum(-1, keepdims=True)
    mean = np.nanmean(p, 1)
    np.testing.assert_array_equal(mean.argmax(-1), lesson.percept)
    np.testing.assert_allclose(lesson.target, mean**3 / (mean**3).sum(-1, keepdims=True), atol=5e-3)


@pytest.mark.long
def test_a_touch_that_does_not_exist_changes_nothing():
    policy = description_policy(dataclasses.replace(SHAPE, contacts=3))
    params = jax.tree.map(lambda x: x[None], policy.fresh(jax.random.key(0), 9))
    x = np.random.default_rng(0).standard_normal((2, 3, 9)).astype(np.float32)
    one, two = x.copy(), x.copy()
    one[:, 2], two[:, 1:] = np.nan, np.nan
    found = [np.asarray(policy.posterior(params, jnp.asarray(rows))) for rows in (x, one, two)]
    assert all(np.isfinite(rows).all() for rows in found)
    assert not np.allclose(found[0], found[1])
    features = policy.features(jax.tree.map(lambda leaf: leaf[0], params), jnp.asarray(two))
    assert (features.touch_time[:, 0, 1:] == -1).all()


@pytest.mark.long
def test_several_touches_of_an_object_are_one_question(trained, tmp_path):
    videos, learned = trained
    config = dataclasses.replace(CONFIG, shape=dataclasses.replace(SHAPE, contacts=2), tune=TuneConfig(steps=2))
    context = run_context(tmp_path)
    several = learn(config, videos, learned.auxiliary, 0, context, "policy")
    context.close()
    found = answer_log_probs(several, videos, [np.array([0, 1]), np.array([2])])
    assert found.shape == (2, 27)
