"""The VTV protocol, shrunk: motions of a few objects, every source answers, the paper's rows stand beside."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.bench import vtv150k
from experiments.bench.vtv import ATTRIBUTES
from experiments.core.artifacts import read_json
from experiments.mechanics.identify_motions import MotionData
from sensors_io.schema import SENSORS
from tests.experiments.shrunk import run_shrunk
from touchr1_jax.training.evidence import ProbeConfig

TINY = dataclasses.replace(vtv150k.EXPERIMENT.scales["smoke"], probe=ProbeConfig(folds=3, iterations=4), questions=24)


def moved(objects: list[int], levels: list[int], shift: float) -> MotionData:
    n = len(objects)
    return MotionData(
        touch=tuple(np.full((n, 2), s + shift) + np.arange(n)[:, None] for s in range(len(SENSORS))),
        force=np.zeros((n, len(SENSORS), 3)),
        shape=np.zeros((n, 2)),
        levels={name: np.array(levels) for name in ATTRIBUTES},
        objects=np.array(objects),
    )


def test_contacts_of_one_object_stand_side_by_side():
    made = vtv150k.together([moved([2, 4], [1, 0], 0.0), moved([2, 4], [1, 0], 100.0)])
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


def test_half_an_interval_by_hand():
    assert vtv150k.half_width(50.0, 96) == pytest.approx(10.0, abs=0.01)


@pytest.mark.slow
def test_every_source_stands_beside_the_paper(tmp_path):
    results = read_json(run_shrunk(vtv150k, TINY, tmp_path) / "results.json")
    table, tasks, differs = results["tables"]
    names = [row[0] for row in table["rows"]]
    assert names[:2] == [vtv150k.FUSED, vtv150k.WITH_FORCE]
    assert names[-1] == "Touch-R1 (paper)"
    assert all(0 <= value <= 100 for row in table["rows"] for value in row[1:11])
    assert len(tasks["rows"]) == 9
    assert len(differs["rows"]) == 6
    assert "lie below guessing" in results["verdict"][1]
