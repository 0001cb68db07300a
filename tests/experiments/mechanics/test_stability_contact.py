"""The failure suite, shrunk: nothing breaks in silence."""

import dataclasses

import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.mechanics import stability_contact
from experiments.mechanics.contact_failures import suite
from tests.experiments.shrunk import run_shrunk

TINY = dataclasses.replace(stability_contact.SMOKE, scenes=12, forces_n=(0.01, 1.0), roughness=(2.0,))


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    home = tmp_path_factory.mktemp("runs")
    return run_shrunk(stability_contact, TINY, home)


@pytest.mark.slow
def test_every_requirement_is_kept(directory):
    results = read_json(directory / "results.json")
    assert {r["name"]: r["measured"] for r in results["requirements"] if not r["met"]} == {}
    assert results["data"]["good scenes"] >= 10


@pytest.mark.slow
def test_every_case_is_reported_and_the_maps_are_drawn(directory):
    results = read_json(directory / "results.json")
    assert [row[0] for row in results["tables"][0]["rows"]] == [case.name for case in suite(TINY.grid)]
    assert {p.name for p in (directory / "plots").iterdir()} >= {"stability_roughness.svg", "stability_thickness.svg"}


def test_a_dozen_pixels_touch_at_a_millinewton():
    (case,) = (c for c in suite(32) if c.name == "a dozen pixels at 1 mN")
    assert stability_contact.attempt(case).flagged is False
    assert case.force_n == 1e-3


@pytest.mark.parametrize("grid", [32, 64])
def test_cases_are_finite_and_named_once(grid):
    cases = suite(grid)
    assert len({c.name for c in cases}) == len(cases)
    assert all(np.all(np.isfinite(c.gap_mm)) for c in cases)


@pytest.mark.slow
def test_adhesion_is_flagged_where_it_counts(directory):
    (table,) = (t for t in read_json(directory / "results.json")["tables"] if t["title"].startswith("Adhesion"))
    assert len(table["rows"]) == 12
    for _, flagged, counts, ratio in table["rows"]:
        assert 0.7 * flagged < counts <= flagged  # a bonded gel sticks less than a half-space
        assert ratio == pytest.approx(counts / flagged)
