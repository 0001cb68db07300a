"""Videos of an object as contacts: no reader learns from what it reads, and plans are compared at equal numbers."""

import dataclasses

import numpy as np
import pytest
from rich.console import Console

from experiments.active import videos
from experiments.active.plans import Played
from experiments.active.videos import StoppingConfig, bank_of, controls_of, equal_videos, video_table, world_of
from experiments.core.context import Context
from experiments.recordings.descriptions import DescribedVideos
from sensors_io.touches import families
from touchr1_jax.training.exploration import NO_CHOICE

OBJECTS, VIDEOS, A = 12, 4, 3
CONFIG = StoppingConfig(videos=3, folds=3)


def described(noise: float = 0.3, informative: bool = True) -> DescribedVideos:
    """Four videos each of twelve objects, of which the last has two alone; the first number tells the first level."""
    rng = np.random.default_rng(0)
    owner = np.repeat(np.arange(OBJECTS), VIDEOS)[: OBJECTS * VIDEOS - 2]
    label = rng.integers(0, 3, (OBJECTS, A)).astype(np.int32)[owner]
    x = rng.normal(0, noise, (len(owner), len(families()))).astype(np.float32)
    if informative:
        x += label[:, :1]
    names = np.array([f"{o}_{i}.mov" for i, o in enumerate(owner)])
    return DescribedVideos(
        names=names,
        objects=np.array([f"o{o:02d}" for o in owner]),
        label=label,
        x=x,
        rating=np.full((len(x), A), np.nan),
    )


def test_objects_with_too_few_videos_are_left_out():
    world = world_of(CONFIG, described())
    assert world.x.shape == (OBJECTS - 1, CONFIG.videos, len(families()))
    assert len(np.unique(world.fold)) == CONFIG.folds


def test_labels_of_tested_objects_change_nothing_that_is_read():
    world = world_of(CONFIG, described())
    tested = np.flatnonzero(world.fold == 0)
    changed = world.label.copy()
    changed[tested] = (changed[tested] + 1) % 3
    found, other = (
        np.asarray(bank_of(w, tested, 0).tokens) for w in (world, dataclasses.replace(world, label=changed))
    )
    np.testing.assert_allclose(found, other, atol=1e-6)


def test_the_label_of_an_object_that_training_uses_does_not_change_what_is_read_of_it():
    world = world_of(CONFIG, described())
    known = int(np.flatnonzero(world.fold != 0)[0])
    changed = world.label.copy()
    changed[known] = (changed[known] + 1) % 3
    tested = np.flatnonzero(world.fold == 0)
    of_object = lambda w: np.asarray(bank_of(w, tested, 0).tokens)[known]
    direction = lambda x: x[..., A:] / np.linalg.norm(x[..., A:], axis=-1, keepdims=True)  # the scale is that of all
    found, other = (direction(of_object(w)) for w in (world, dataclasses.replace(world, label=changed)))
    np.testing.assert_allclose(found, other, atol=1e-4)


def answer(objects, questions, choices):
    """Level 0, surer with each video."""
    number = (choices != NO_CHOICE).sum(1)
    p = np.full((len(objects), 3), 0.5)
    p[:, 0] = 0.5 + number
    return np.log(p / p.sum(1, keepdims=True))


def test_controls_by_hand():
    world = world_of(CONFIG, described())
    tested = np.flatnonzero(world.fold == 0)
    config = dataclasses.replace(CONFIG, thresholds=(0.55, 0.99))
    found = controls_of(config, bank_of(world, tested, 0), tested, answer, np.random.default_rng(0))
    assert [found[f"{k} videos"].contacts.max() for k in range(4)] == [0, 1, 2, 3]
    assert (found["until 0.55"].contacts == 1).all()  # 1.5 / 2.5 after one
    assert (found["until 0.99"].contacts == 3).all()
    assert 0 < found["a random number"].contacts.mean() < 3
    np.testing.assert_array_equal(found["1 videos"].right, world.label[tested] == 0)


def test_a_plan_is_compared_with_as_many_videos_for_all():
    def plan(right, number):
        shape = np.ones((4, A))
        choices = np.where(np.arange(2) < number, np.arange(2), NO_CHOICE)
        return Played(right * shape, number * shape, 0 * shape, np.broadcast_to(choices, (4, A, 2)))

    played = {"0 videos": plan(0.2, 0), "1 videos": plan(0.4, 1), "2 videos": plan(0.8, 2), "a": plan(0.5, 1)}
    assert equal_videos(played, played["a"], 2).mean == pytest.approx(10)
    assert equal_videos(played, played["2 videos"], 2).mean == pytest.approx(0)
    table = video_table(world_of(StoppingConfig(videos=2, folds=3), described()), played)
    assert len(table.rows) == 4


@pytest.mark.slow  # compiles a warm start and a step
def test_a_fold_is_played_by_policies_and_controls(monkeypatch, tmp_path):
    config = dataclasses.replace(
        CONFIG,
        prices=(0.01,),
        thresholds=(0.6,),
        steps=2,
        warm=dataclasses.replace(CONFIG.warm, steps=4),
        grpo=dataclasses.replace(CONFIG.grpo, prompts=6, group=4, micro_prompts=6),
    )
    monkeypatch.setattr(videos, "describe_source", lambda *_: described())
    context = Context(tmp_path, tmp_path / "cache", Console(quiet=True))
    table, picture = videos.stopping(config, tmp_path, context)
    context.close()
    plans = [row[0] for row in table.rows]
    assert {"chosen at 0.01", "until 0.6", "a random number", "0 videos", "3 videos"} <= set(plans)
    assert picture.content
