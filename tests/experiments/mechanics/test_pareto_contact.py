"""The measurement of the contact ladder, shrunk, and the methods that it compares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.artifacts import read_json
from experiments.mechanics import contact_checks, pareto_contact
from experiments.mechanics import oracles as contact_oracles
from experiments.mechanics.contact_methods import blur, polonsky_keer, spg_plain, winkler_and_response, winkler_only
from experiments.mechanics.contact_scenes import displacement_error, exact, gel_kernels, sample, slope_error
from sensors_io.scenes.sensors import GELSIGHT_MINI
from tests.experiments.shrunk import run_shrunk

TINY = pareto_contact.ParetoContactConfig(
    scenes=3, grid=32, ladder=(24, 32), ladder_scenes=2, rounds=2, oracle_scenes=1
)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    home = tmp_path_factory.mktemp("runs")
    return read_json(run_shrunk(pareto_contact, TINY, home) / "results.json")


def test_every_tier_has_a_row(results):
    tiers = results["tables"][0]["rows"]
    assert [row[0] for row in tiers] == [m.name for m in pareto_contact.methods()]
    assert all(np.isfinite(cell) for row in tiers for cell in row[1:])


def test_accuracy_is_kept(results):
    met = {r["name"]: r["met"] for r in results["requirements"] if "time" not in r["name"]}
    assert met
    assert all(met.values()), met


def test_convolutions_are_counted(results):
    rows = {row[0]: row[3] for row in results["tables"][0]["rows"]}
    assert rows["Winkler"] == 0
    assert rows["PK-25"] == 51
    assert rows["nested 1e-3"] < rows["plain 1e-3"]


def test_same_seed_same_scene_on_every_grid():
    coarse, fine = (sample(GELSIGHT_MINI, 2, n, 0) for n in (32, 96))
    np.testing.assert_array_equal(coarse.force_n, fine.force_n)
    middle = fine.gap_mm[:, 1::3, 1::3] - coarse.gap_mm  # coarse centres lie on fine ones
    np.testing.assert_allclose(middle - middle.mean((1, 2), keepdims=True), 0, atol=1e-4)


@pytest.mark.parametrize("solve", [spg_plain(1e-5, False), polonsky_keer(40)], ids=["plain", "Polonsky-Keer"])
def test_baselines_reach_the_reference(solve):
    scenes, kernels = sample(GELSIGHT_MINI, 1, 32, 1), gel_kernels(GELSIGHT_MINI, 32)
    gel = jnp.asarray(kernels.gel, jnp.float32)
    total = gel + jnp.asarray(kernels.body, jnp.float32) / scenes.modulus_mpa[0]
    found, _ = jax.jit(solve)(jnp.asarray(scenes.gap_mm[0]), scenes.force_n[0], gel, total, kernels.spacing_mm)
    assert displacement_error(np.asarray(found)[None], exact(scenes, kernels))[0] < 1e-4


@pytest.mark.parametrize("solve", [winkler_only, winkler_and_response, blur])
def test_cheap_tiers_give_something_near(solve):
    scenes, kernels = sample(GELSIGHT_MINI, 1, 32, 1), gel_kernels(GELSIGHT_MINI, 32)
    gel = jnp.asarray(kernels.gel, jnp.float32)
    total = gel + jnp.asarray(kernels.body, jnp.float32) / scenes.modulus_mpa[0]
    found, _ = jax.jit(solve)(jnp.asarray(scenes.gap_mm[0]), scenes.force_n[0], gel, total, kernels.spacing_mm)
    assert 0.01 < displacement_error(np.asarray(found)[None], exact(scenes, kernels))[0] < 1


def test_errors_are_relative():
    x = np.linspace(0, 1, 8)
    field = (x[None] * x[:, None])[None]
    assert displacement_error(1.1 * field, field) == pytest.approx(0.1)
    assert slope_error(field + 5, field) == pytest.approx(0, abs=1e-12)


def test_oracles_agree_where_they_are_installed():
    errors = contact_checks.against_oracles(range(1), 32, 0)
    assert {"float64 reference (half-space)", "float64 reference (layer)"} <= set(errors)
    assert len(errors) == 2 + len(contact_oracles.installed())
    assert max(errors.values()) < 1e-3
