"""The contact experiments, shrunk; the methods, scenes and oracles that they share."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.mechanics import contact_oracles, contact_scenes, pareto_contact, stability_contact
from experiments.mechanics.contact_methods import METHODS, polonsky_keer, spg_plain
from experiments.mechanics.contact_scenes import displacement_error, exact, failure_suite, slope_error
from sensors_io.scenes.sensors import GELSIGHT_MINI
from tests.experiments.shrunk import run_shrunk

PARETO = pareto_contact.ParetoContactConfig(
    scenes=3, grid=32, ladder=(24, 32), ladder_scenes=2, rounds=2, oracle_scenes=1
)
STABILITY = dataclasses.replace(stability_contact.SMOKE, scenes=12, forces_n=(0.01, 1.0), roughness=(2.0,))


def test_pareto_contact(tmp_path):
    results = read_json(run_shrunk(pareto_contact, PARETO, tmp_path) / "results.json")
    rows = {row[0]: row[1:] for row in results["tables"][0]["rows"]}
    assert list(rows) == list(METHODS)
    assert all(np.isfinite(cell) for row in rows.values() for cell in row)
    convolutions = {name: row[2] for name, row in rows.items()}
    assert convolutions["Winkler"] == 0
    assert convolutions["PK-25"] == 51
    assert convolutions["nested 1e-3"] < convolutions["plain 1e-3"]
    met = {r["name"]: r["met"] for r in results["requirements"] if "time" not in r["name"]}
    assert met
    assert all(met.values()), met


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
        *(pytest.param(METHODS[name].solve, 0.01, 1, id=name) for name in ("Winkler", "Winkler + response", "blur")),
    ],
)
def test_error_of_each_method(solve, least, most):
    scenes = contact_scenes.sample_scenes(GELSIGHT_MINI, 1, 32, 1)
    kernels = contact_scenes.gel_kernels(GELSIGHT_MINI, 32)
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


@pytest.mark.slow
def test_stability_contact(tmp_path):
    directory = run_shrunk(stability_contact, STABILITY, tmp_path)
    results = read_json(directory / "results.json")
    assert {r["name"]: r["measured"] for r in results["requirements"] if not r["met"]} == {}
    assert results["data"]["good scenes"] >= 10
    suite, adhesive = (table["rows"] for table in results["tables"])
    assert [row[0] for row in suite] == [case.name for case in failure_suite(STABILITY.grid)]
    assert {p.name for p in (directory / "plots").iterdir()} == {"stability_roughness.svg", "stability_thickness.svg"}
    assert len(adhesive) == 12
    for _, flagged, matters, ratio in adhesive:
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
