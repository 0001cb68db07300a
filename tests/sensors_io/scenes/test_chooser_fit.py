"""The fit of the chooser's law, and its margins."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.scenes import chooser_fit as fit
from sensors_io.scenes.chooser_law import MENU, Survey
from sensors_io.scenes.chooser_survey import FEATURES


def test_the_least_margins_keep_enough():
    errors, predicted = np.full((100, 1), 0.2), np.full((100, 1), 0.1)
    found = fit.promised(fit.start(), predicted, errors, [0.1])
    assert found.margin == pytest.approx(1.5, rel=0.03)  # past it nothing is promised any more
    assert found.doubt == pytest.approx(1.5, rel=0.03)


def test_an_unfit_law_is_refused():
    with pytest.raises(ValueError, match="the law does not fit"):
        fit.promised(fit.start(), np.full((9, 1), 1e-6), np.ones((9, 1)), [0.1])


@pytest.mark.long
def test_the_fit_finds_the_law_that_made_the_errors():
    rng = np.random.default_rng(1)
    features = np.concatenate([np.ones((80, 1)), rng.normal(0, 0.5, (80, len(FEATURES) - 1))], 1)
    lengths = {"radius_mm": 3.0, "slope_share": 0.0, "window_mm": 18.0, "thickness_mm": 4.0}
    seen = Survey(
        features=jnp.asarray(features, jnp.float32), **{name: jnp.full(80, value) for name, value in lengths.items()}
    )
    truth = fit.start()
    truth = dataclasses.replace(truth, grid=truth.grid + 0.1, rate=truth.rate - 0.05)
    exact = fit.predict(truth, seen, MENU)
    found = fit.predict(fit.fit(seen, exact, MENU), seen, MENU)
    counts = (exact > fit.RANGE[0]) & (exact < fit.RANGE[1])
    assert np.quantile(np.abs(np.log(found / exact))[counts], 0.95) < 0.1
