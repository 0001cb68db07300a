"""The nine tasks of VTV150K: a perfect predictor is right, one without knowledge is at chance, exactly; the report."""

from types import SimpleNamespace

import numpy as np
import pytest

from experiments.bench import vtv150k
from experiments.mechanics.identify_motions import MotionData
from sensors_io.schema import SENSORS
from touchr1_jax.bench.averages import VTV, vtv_average
from touchr1_jax.bench.vtv import (
    ASSIGNMENTS,
    ATTRIBUTES,
    CHANCE,
    VTVTasks,
    averaged,
    draw_tasks,
    prior_log_probs,
    score,
)

N = 60
LABEL = np.random.default_rng(3).integers(0, 3, (N, 4))


@pytest.fixture(scope="module")
def tasks():
    return draw_tasks(LABEL, 240, seed=1)


def certain(label: np.ndarray) -> np.ndarray:
    return np.log(np.where(label[..., None] == np.arange(3), 0.98, 0.01))


def test_the_true_levels_are_always_right(tasks):
    assert {name: s.mean() for name, s in score(tasks, certain(LABEL)).items()} == dict.fromkeys(VTV, 100)


def test_the_prior_is_at_chance_exactly(tasks):
    blind = score(tasks, prior_log_probs(LABEL))
    for task in ("sfd", "soi", "osc", "tsa"):
        assert blind[task].mean() == pytest.approx(CHANCE[task])
    for a, name in enumerate(ATTRIBUTES):
        assert blind[name].mean() == pytest.approx(100 * np.bincount(LABEL[:, a]).max() / N)


def test_questions_are_about_different_levels(tasks):
    first, second = (LABEL[tasks.pairs[:, i], tasks.pair_of] for i in (0, 1))
    assert (first != second).all()
    assert np.array_equal(tasks.pairs[::2], tasks.pairs[1::2, ::-1])
    three = LABEL[tasks.threes, tasks.three_of[:, None]]
    assert np.array_equal(np.sort(three, 1), np.tile([0, 1, 2], (240, 1)))
    for a in range(4):
        assert set(tasks.most[tasks.three_of == a]) == {True, False}
    assert all(len(np.unique(levels, axis=0)) == 3 for levels in LABEL[tasks.names])


@pytest.mark.parametrize("k", range(len(ASSIGNMENTS)))
def test_recordings_are_matched_to_names(k):
    label = np.array([[0, 0, 0, 0], [1, 1, 1, 1], [2, 2, 2, 2]])
    one = np.zeros((1, 2), int)
    tasks = VTVTasks(
        label=label, pairs=one, pair_of=one[0, :1], threes=np.zeros((1, 3), int), three_of=one[0, :1],
        most=np.array([True]), names=np.array([[0, 1, 2]]), shown=np.array([k]), fits=one, scenario=one[0, :1],
    )  # fmt: skip
    assert score(tasks, certain(label))["osc"].mean() == 100


@pytest.mark.parametrize(
    ("label", "count", "message"),
    [
        (LABEL, 100, "multiple of 24"),
        (np.zeros((9, 4), int), 24, "lacks levels"),
        (np.where(np.arange(4) == 2, -1, LABEL), 24, r"label\[0\] is \[.*-1.*\]: must be ≥ 0"),
    ],
)
def test_questions_that_cannot_be_drawn(label, count, message):
    with pytest.raises(ValueError, match=message):
        draw_tasks(label, count, seed=0)


def test_the_average_is_that_of_the_tasks_and_has_an_interval(tasks):
    perfect, blind = (averaged(score(tasks, x), np.arange(N)) for x in (certain(LABEL), prior_log_probs(LABEL)))
    span = blind["average"]
    assert span.mean == pytest.approx(vtv_average({task: blind[task].mean for task in VTV}))
    assert span.low < span.mean < span.high
    assert perfect["average"].low == 100


def motion_data(objects: list[int], levels: list[int], shift: float) -> MotionData:
    n = len(objects)
    return MotionData(
        touch=tuple(np.full((n, 2), s + shift) + np.arange(n)[:, None] for s in range(len(SENSORS))),
        force=np.zeros((n, len(SENSORS), 3)),
        shape=np.zeros((n, 2)),
        levels={name: np.array(levels) for name in ATTRIBUTES},
        objects=np.array(objects),
    )


def test_features_of_one_objects_motions_are_joined():
    made = vtv150k.together([motion_data([2, 4], [1, 0], shift) for shift in (0.0, 100.0)])
    assert made.objects.tolist() == [2, 4]
    assert made.label.tolist() == [[1] * 4, [0] * 4]
    assert made.features[SENSORS[0]].tolist() == [[0, 0, 100, 100], [1, 1, 101, 101]]
    assert made.features[vtv150k.FORCE].shape == (2, 2 * 3 * len(SENSORS))


def test_one_contact_of_each_motion_with_every_object_that_has_both():
    made = [("b", "hold"), ("a", "slide_x"), ("c", "hold"), ("b", "slide_x"), ("b", "slide_x"), ("a", "hold")]
    scenes = SimpleNamespace(contacts=[SimpleNamespace(object_id=name, motion=motion) for name, motion in made])
    assert vtv150k.one_each(scenes) == {"slide_x": [1, 3], "hold": [5, 0]}
    with pytest.raises(ValueError, match="no object has a contact of each"):
        vtv150k.one_each(SimpleNamespace(contacts=scenes.contacts[:2]))
