"""The Helmholtz–Hodge decomposition of fields whose parts are known."""

import numpy as np
import pytest

from sensors_io.fields.helmholtz import decompose

PITCH = (0.5, 0.4)
Y, X = np.mgrid[-20:21, -24:25] * np.array(PITCH[::-1])[:, None, None]
BELL = np.exp(-(X**2 + Y**2) / (2 * 2.0**2))
SPREAD = np.stack([X, Y], -1) * BELL[..., None]  # the gradient of −4 BELL
TWIST = np.stack([-Y, X], -1) * BELL[..., None]
INNER = (slice(4, -4), slice(4, -4))


def relative(field, true):
    return np.linalg.norm((field - true)[INNER]) / np.linalg.norm(true[INNER])


@pytest.mark.parametrize(("field", "part"), [(SPREAD, "gradient"), (TWIST, "rotation"), (TWIST, "shear")])
def test_spread_is_a_gradient_and_twist_is_shear(field, part):
    assert relative(getattr(decompose(field, PITCH), part), field) < 0.04


@pytest.mark.parametrize("field", [np.ones_like(SPREAD), np.stack([X, -Y], -1)], ids=["translation", "pure shear"])
def test_what_flows_through_the_border_is_harmonic(field):
    np.testing.assert_allclose(decompose(field, PITCH).harmonic, field, atol=1e-9)
