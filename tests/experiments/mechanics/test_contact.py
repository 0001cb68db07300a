"""The contact experiments, shrunk; the methods, scenes and oracles that they share."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.mechanics import contact_oracles, contact_scenes, stability_contact
from experiments.mechanics.contact_methods import METHODS, polonsky_keer, spg_plain
from experiments.mechanics.contact_scenes import displacement_error, exact, failure_suite
from sensors_io.scenes.sensors import GELSIGHT_MINI


@pytest.fixture(scope="module")
def scene():
    """A scene, the kernels of its gel, and its exact displacement."""
    scenes = contact_scenes.sample_scenes(GELSIGHT_MINI, 1, 32, 1)
    kernels = contact_scenes.gel_kernels(GELSIGHT_MINI, 32)
    return scenes, kernels, exact(zip(*scenes, strict=True), kernels)


@pytest.mark.parametrize(
    ("solve", "least", "most"),
    [
        pytest.param(spg_plain(1e-5, False), 0, 1e-4, id="plain SPG"),
        pytest.param(polonsky_keer(40), 0, 1e-4, id="Polonsky–Keer"),
        *(pytest.param(METHODS[name].solve, 0.01, 1, id=name) for name in ("Winkler", "Winkler + response", "blur")),
    ],
)
def test_error_of_each_method(scene, solve, least, most):
    scenes, kernels, true = scene
    gel = jnp.asarray(kernels.gel, jnp.float32)
    total = gel + jnp.asarray(kernels.body, jnp.float32) / scenes.modulus_mpa[0]
    found, _ = jax.jit(solve)(jnp.asarray(scenes.gap_mm[0]), scenes.force_n[0], gel, total, kernels.spacing_mm)
    assert least < displacement_error(np.asarray(found)[None], true)[0] < most


@pytest.mark.long
def test_oracles_agree_where_they_are_installed(context):
    errors = contact_oracles.oracle_errors(1, 32, 0, context)
    assert {"float64 reference (half-space)", "float64 reference (layer)"} <= set(errors)
    assert len(errors) == 2 + len(contact_oracles.installed())
    assert max(errors.values()) < 1e-3


@pytest.mark.long
def test_a_dozen_pixels_touch_at_a_millinewton():
    (case,) = (c for c in failure_suite(32) if c.name == "a dozen pixels at 1 mN")
    assert stability_contact.attempt(case).flagged is False
    assert case.force_n == 1e-3
