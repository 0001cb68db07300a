"""Unloading: the loop has the area it should, energy is never created, the virgin curve stays as it was."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sensors_io.layer import Layer
from sensors_io.scenes import history, properties
from tests.sensors_io.checks import refused

GEL = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=4.0)
RAMP = np.linspace(0, 5, 4001)
THERE_AND_BACK = np.concatenate([RAMP, RAMP[::-1]])

paths = st.lists(st.floats(0, 10), min_size=1, max_size=12)
losses = st.floats(0, 0.9)


def _depth(elastic_force: np.ndarray, exponent: float = 1.5) -> np.ndarray:
    """Any virgin curve will do: F = δ^exponent."""
    return elastic_force ** (1 / exponent)


def test_by_hand() -> None:
    force = np.array([0.0, 1.0, 2.0, 1.8, 1.5, 0.75, 0.9, 1.2, 3.0, 0.0])
    expected = [0.0, 1.0, 2.0, 2.0, 2.0, 1.0, 1.0, 1.2, 3.0, 0.0]
    np.testing.assert_allclose(history.elastic_force(force, 0.25), expected)


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.3])
@pytest.mark.parametrize(("loss", "level"), [(0.0, 2), (0.05, 2), (0.4, 1), (0.7, 0)])
def test_a_full_loop_loses_its_share_for_any_virgin_curve(exponent: float, loss: float, level: int) -> None:
    """So elasticity can be read from load against unload."""
    depth = _depth(history.elastic_force(THERE_AND_BACK, loss), exponent)
    share = history.returned_share(THERE_AND_BACK, depth)
    assert share == pytest.approx(1 - loss, abs=2e-3)
    assert properties.ELASTICITY.level(1 - loss) == properties.ELASTICITY.level(share) == level


@settings(max_examples=60, deadline=None)
@given(corners=paths, loss=losses)
def test_no_path_gains_energy(corners: list[float], loss: float) -> None:
    at = [0.0, *corners, 0.0]  # by straight lines
    force = np.interp(np.linspace(0, len(at) - 1, 200 * (len(at) - 1) + 1), np.arange(len(at)), at)
    elastic = history.elastic_force(force, loss)
    if force.max() > 1e-3:  # below it rounding is all the work there is
        assert history.returned_share(force, _depth(elastic)) <= 1 - loss + 1e-2
    assert np.all(elastic >= force)
    assert elastic[0] == elastic[-1] == 0


def test_losses_mix_by_stored_energy_and_a_hard_object_stores_nothing() -> None:
    loss = history.Loss(gel=0.05, body=0.45)
    assert [loss.of_contact(share) for share in (0.0, 1.0, 0.25)] == pytest.approx([0.05, 0.45, 0.15])
    soft, hard = (Layer(modulus_mpa=e, poisson=0.4, thickness_mm=20.0) for e in (0.3, 300.0))
    assert history.body_share(GEL, hard, 4.0) < 0.003
    assert history.body_share(GEL, soft, 4.0) > 0.5


@pytest.mark.parametrize(("modulus", "radius", "stored"), [(0.3, 3.11, 0.735), (1.0, 5.13, 0.575), (5.0, 4.62, 0.195)])
def test_the_share_of_energy_is_that_of_the_contact(modulus: float, radius: float, stored: float) -> None:
    """`stored` is Σ p u_body / Σ p u of spheres (R = 8 mm; 1, 10 and 10 N) on 3 mm of gel, solved on 64² pixels."""
    gel = Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=3.0)
    body = Layer(modulus_mpa=modulus, poisson=0.4, thickness_mm=20.0)
    assert history.body_share(gel, body, radius) == pytest.approx(stored, abs=0.07)


def test_impossible_input_is_refused() -> None:
    refused(ValueError, r"loss is 1\.0: must lie in", history.elastic_force, RAMP, 1.0)
    refused(ValueError, r"force_n is -1\.0: must be ≥ 0", lambda: history.elastic_force(np.array([0.0, -1.0]), 0.1))
    refused(ValueError, r"body is 1\.2", history.Loss, gel=0.1, body=1.2)
    refused(ValueError, r"body_share is 1\.5", lambda: history.Loss(gel=0.1, body=0.2).of_contact(1.5))
    refused(ValueError, "must do work", lambda: history.returned_share(np.zeros(3), np.zeros(3)))
