import hypothesis
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from touchr1_jax import masked

X = np.array([[1.0, 2.0, 4.0], [np.nan, 5.0, np.inf]], np.float32)
MASK = np.array([[True, True, False], [False, True, False]])
STATISTICS = {
    "count": masked.count,
    "total": masked.total,
    "mean": masked.mean,
    "var": masked.var,
    "std": masked.std,
    "maximum": lambda x, mask, axis=None: masked.maximum(x, mask, axis, empty=-7.0),
    "minimum": lambda x, mask, axis=None: masked.minimum(x, mask, axis, empty=7.0),
}


@pytest.mark.parametrize(
    ("name", "everything", "rows"),
    [
        ("count", 3, [2, 1]),
        ("total", 8, [3, 5]),
        ("mean", 8 / 3, [1.5, 5]),
        ("var", 26 / 9, [0.25, 0]),
        ("std", np.sqrt(26 / 9), [0.5, 0]),
        ("maximum", 5, [2, 5]),
        ("minimum", 1, [1, 5]),
    ],
)
def test_hand_values(name, everything, rows):
    assert STATISTICS[name](X, MASK) == pytest.approx(everything)
    np.testing.assert_allclose(STATISTICS[name](X, MASK, axis=1), rows, rtol=1e-6)


@pytest.mark.parametrize("name", STATISTICS)
@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(
    x=hnp.arrays(np.float32, (3, 4), elements=st.floats(-100, 100, width=32)), mask=hnp.arrays(bool, (3, 4))
)
def test_nothing_but_the_selected_counts(name, x, mask):
    """Equal to plain NumPy on the selected elements, with NaN in all others."""
    numpy = {
        "count": len,
        "total": np.sum,
        "mean": np.mean,
        "var": np.var,
        "std": np.std,
        "maximum": np.max,
        "minimum": np.min,
    }[name]
    empty = {"maximum": -7.0, "minimum": 7.0}.get(name, 0.0)
    got = np.asarray(STATISTICS[name](np.where(mask, x, np.nan), mask))
    want = numpy(x[mask].astype(np.float64)) if mask.any() else empty
    np.testing.assert_allclose(got, want, rtol=2e-3, atol=2e-3)


def test_masks_broadcast():
    x = jnp.arange(12.0).reshape(3, 4)
    rows = jnp.array([True, False, True])[:, None]
    np.testing.assert_allclose(masked.mean(x, rows), np.arange(12.0).reshape(3, 4)[[0, 2]].mean())
    np.testing.assert_allclose(masked.mean(x, rows, 0), [4, 5, 6, 7])
    assert masked.mean(x, rows, 0, keepdims=True).shape == (1, 4)
    assert masked.mean(jnp.ones(4), jnp.ones((3, 1), bool), 1).tolist() == [1, 1, 1]


def test_booleans_and_integers():
    assert masked.mean(jnp.array([True, True, False]), jnp.array([True, True, True])) == pytest.approx(2 / 3)
    assert masked.mean(jnp.array([1, 2, 9]), jnp.array([True, True, False])) == 1.5
    assert masked.maximum(jnp.array([1, 2, 9]), jnp.array([True, True, False]), empty=0.0) == 2


@pytest.mark.parametrize("name", [n for n in STATISTICS if n != "count"])
@pytest.mark.parametrize("mask", [MASK, np.zeros((2, 3), bool)], ids=["some", "none"])
@pytest.mark.parametrize("x", [X, np.where(np.isfinite(X), 3.0, X)], ids=["varied", "constant"])
def test_gradients_are_finite_and_miss_what_is_not_selected(name, mask, x):
    gradient = jax.grad(lambda x: jnp.sum(STATISTICS[name](x, mask) * jnp.arange(1.0, 4)))(jnp.asarray(x))
    assert np.all(np.isfinite(gradient))
    assert np.all(np.asarray(gradient)[~mask] == 0)
