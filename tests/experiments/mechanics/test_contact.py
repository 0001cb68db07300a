"""The contact experiments, shrunk; the methods, scenes and oracles that they share."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.mechanics import contact_oracles, contact_scenes, pareto_contact, stability_contact
from experiments.mechanics.contact_methods import (
    blur,
    contact_methods,
    polonsky_keer,
    spg_plain,
    winkler_and_response,
    winkler_only,
)
from experiments.mechanics.contact_scenes import displacement_error, exact, failure_suite, slope_error
from sensors_io.scenes.sensors import GELSIGHT_MINI
from tests.experiments.shrunk import run_shrunk

PARETO = pareto_contact.ParetoContactConfig(
    scenes=3, grid=32, ladder=(24, 32), ladder_scenes=2, rounds=2, oracle_scenes=1
)
STABILITY = dataclasses.replace(stability_contact.SMOKE, scenes=12, forces_n=(0.01, 1.0), roughness=(2.0,))


@pytest.fixture(scope="module")
def pareto(tmp_path_factory):
    home = tmp_path_factory.mktemp("runs")
    return read_json(run_shrunk(pareto_contact, PARETO, home) / "results.json")


def test_every_method_has_a_finite_row(pareto):
    rows = pareto["tables"][0]["rows"]
    assert [row[0] for row in rows] == [m.name for m in contact_methods()]
    assert all(np.isfinite(cell) for row in rows for cell in row[1:])


def test_accuracy_is_kept(pareto):
    met = {r["name"]: r["met"] for r in pareto["requirements"] if "time" not in r["name"]}
    assert met
    assert all(met.values()), met


def test_convolutions_are_counted(pareto):
    rows = {row[0]: row[3] for row in pareto["tables"][0]["rows"]}
    assert rows["Winkler"] == 0
    assert rows["PK-25"] == 51
    assert rows["nested 1e-3"] < rows["plain 1e-3"]


def test_same_seed_same_scene_on_every_grid():
    coarse, fine = (contact_scenes.sample_scenes(GELSIGHT_MINI, 2, n, 0) for n in (32, 96))
    np.testing.assert_array_equal(coarse.force_n, fine.force_n)
    middle = fine.gap_mm[:, 1::3, 1::3] - coarse.gap_mm  # coarse centres lie on fine ones
    np.testing.assert_allclose(middle - middle.mean((1, 2), keepdims=True), 0, atol=1e-4)


@pytest.mark.parametrize(
    ("solve", "least", "most"),
    [
        pytest.param(spg_plain(1e-5, False), 0, 1e-4, id="plain SPG"),
        pytest.param(polonsky_keer(40), 0, 1e-4, id="Polonsky–Keer"),
        pytest.param(winkler_only, 0.01, 1, id="Winkler"),
        pytest.param(winkler_and_response, 0.01, 1, id="Winkler + response"),
        pytest.param(blur, 0.01, 1, id="blur"),
    ],
)
def test_error_of_each_method(solve, least, most):
    scenes, kernels = (
        contact_scenes.sample_scenes(GELSIGHT_MINI, 1, 32, 1),
        contact_scenes.gel_kernels(GELSIGHT_MINI, 32),
    )
    gel = jnp.asarray(kernels.gel, jnp.float32)
    total = gel + jnp.asarray(kernels.body, jnp.float32) / scenes.modulus_mpa[0]
    found, _ = jax.jit(solve)(jnp.asarray(scenes.gap_mm[0]), scenes.force_n[0], gel, total, kernels.spacing_mm)
    true = exact(zip(*scenes, strict=True), kernels)
    assert least < displacement_error(np.asarray(found)[None], true)[0] < most


def test_errors_are_relative():
    x = np.linspace(0, 1, 8)
    field = (x[None] * x[:, None])[None]
    assert displacement_error(1.1 * field, field) == pytest.approx(0.1)
    assert slope_error(field + 5, field) == pytest.approx(0, abs=1e-12)


def test_oracles_agree_where_they_are_installed(context):
    errors = contact_oracles.oracle_errors(1, 32, 0, context)
    assert {"float64 reference (half-space)", "float64 reference (layer)"} <= set(errors)
    assert len(errors) == 2 + len(contact_oracles.installed())
    assert max(errors.values()) < 1e-3


@pytest.fixture(scope="module")
def stability(tmp_path_factory):
    return run_shrunk(stability_contact, STABILITY, tmp_path_factory.mktemp("runs"))


@pytest.mark.slow
def test_no_failure_goes_unflagged(stability):
    results = read_json(stability / "results.json")
    assert {r["name"]: r["measured"] for r in results["requirements"] if not r["met"]} == {}
    assert results["data"]["good scenes"] >= 10
    assert [row[0] for row in results["tables"][0]["rows"]] == [case.name for case in failure_suite(STABILITY.grid)]
    assert {p.name for p in (stability / "plots").iterdir()} == {"stability_roughness.svg", "stability_thickness.svg"}


@pytest.mark.slow
def test_adhesion_is_flagged_where_it_matters(stability):
    (table,) = (t for t in read_json(stability / "results.json")["tables"] if t["title"].startswith("Adhesion"))
    assert len(table["rows"]) == 12
    for _, flagged, matters, ratio in table["rows"]:
        assert 0.7 * flagged < matters <= flagged  # a bonded gel sticks less than a half-space
        assert ratio == pytest.approx(matters / flagged)


def test_a_dozen_pixels_touch_at_a_millinewton():
    (case,) = (c for c in failure_suite(32) if c.name == "a dozen pixels at 1 mN")
    assert stability_contact.attempt(case).flagged is False
    assert case.force_n == 1e-3


@pytest.mark.parametrize("grid", [32, 64])
def test_cases_are_finite_and_named_once(grid):
    cases = failure_suite(grid)
    assert len({c.name for c in cases}) == len(cases)
    assert all(np.all(np.isfinite(c.gap_mm)) for c in cases)
