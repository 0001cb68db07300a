"""Ridge regression of force: recovers a linear law, reports an error that is honest, refuses what it cannot fit."""

import numpy as np
import pytest

from sensors_io.fields.total_force import ForceFitError, fit
from tests.sensors_io.checks import refused

RNG = np.random.default_rng(0)
LAW = RNG.normal(0, 1, (60, 3))
FIELDS = RNG.normal(0, 0.1, (200, 10, 6))
FORCE = FIELDS.reshape(200, 60) @ LAW + [1, 2, -5]


def test_a_linear_law_is_found():
    model = fit(FIELDS, FORCE)
    assert model.held_out_rmse.max() < 1e-3
    new = RNG.normal(0, 0.1, (5, 10, 6))
    np.testing.assert_allclose(model.predict(new), new.reshape(5, 60) @ LAW + [1, 2, -5], atol=1e-2)


def test_a_node_that_never_moves_changes_nothing():
    still = np.concatenate([FIELDS, np.ones((200, 1, 6))], 1)
    np.testing.assert_allclose(fit(still, FORCE).predict(still[:5]), fit(FIELDS, FORCE).predict(FIELDS[:5]), atol=1e-6)


def test_the_reported_error_is_that_on_new_frames():
    noisy = FORCE + RNG.normal(0, 0.2, FORCE.shape)
    model = fit(FIELDS, noisy)
    new = RNG.normal(0, 0.1, (400, 10, 6))
    error = model.predict(new) - new.reshape(400, 60) @ LAW - [1, 2, -5]
    achieved = np.sqrt(0.2**2 + (error**2).mean(0))
    np.testing.assert_allclose(model.held_out_rmse, achieved, rtol=0.3)


def test_a_contact_that_changes_is_told_by_the_held_out_error():
    """The second half obeys another law: blocks that straddle no contact would have hidden it."""
    changed = FORCE.copy()
    changed[100:] = FIELDS[100:].reshape(100, 60) @ LAW[::-1]
    assert fit(FIELDS, changed).held_out_rmse.min() > 0.5


@pytest.mark.parametrize(("frames", "same"), [(slice(0, 43), True), (slice(43, 44), False)])
def test_a_block_is_predicted_without_itself_and_without_the_gap_behind_it(frames, same):
    """The first 40 frames and the three behind them choose neither weights nor penalty of their prediction."""
    noisy = FORCE + np.random.default_rng(1).normal(0, 0.2, FORCE.shape)
    changed = noisy.copy()
    changed[frames] += 30
    first, second = (fit(FIELDS, force).held_out[:40] for force in (noisy, changed))
    assert np.array_equal(first, second) == same


def test_the_penalty_is_chosen_without_the_gap_around_a_block():
    """Noise whose three frames on either side of a border are the same: only those inside the gap can be predicted."""
    rng = np.random.default_rng(2)
    fields, force = rng.normal(0, 0.1, (50, 200)), rng.normal(0, 1, (50, 3))
    for border in (10, 20, 30, 40):
        for x in (fields, force):
            x[border : border + 3] = x[border - 3 : border][::-1]
    assert fit(fields, force).penalty > 0.03 > 0.01 > fit(fields, force, gap_frames=0).penalty


def test_what_cannot_be_fitted_is_refused():
    refused(ForceFitError, "one per frame", fit, FIELDS, FORCE[:10], blocks=5)
    refused(ForceFitError, "blocks is 2", fit, FIELDS, FORCE, blocks=2)
    refused(ForceFitError, "record more", fit, FIELDS[:30], FORCE[:30], blocks=5)
    refused(ForceFitError, "drop incomplete", fit, FIELDS, np.full_like(FORCE, np.nan), blocks=5)
    refused(ForceFitError, "press while recording", fit, FIELDS, 0 * FORCE + [1, 2, 3], blocks=5)
    refused(ForceFitError, "press while recording", fit, 0 * FIELDS + FIELDS[0], FORCE, blocks=5)
