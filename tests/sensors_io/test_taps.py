"""Taps of a force sensor and a camera, a known time apart."""

import numpy as np
import pytest

from sensors_io.taps import Signal, TapError, tap_offset
from tests.sensors_io.checks import refused

MS = 1_000_000


def taps(shift_s, rate_hz, seed=0, count=6):
    """A signal with `count` taps at irregular times, seen `shift_s` late at some rate, with noise of 1 % of a tap."""
    at = np.cumsum([1.0, 1.3, 0.9, 1.7, 1.1, 1.45][:count]) + shift_s
    time = np.arange(0, 10, 1 / rate_hz)
    rise = 0.02  # s
    value = sum(np.clip((time - t) / rise, 0, 1) * np.exp(-np.clip(time - t - rise, 0, None) / 0.05) for t in at)
    value = value + 0.01 * np.random.default_rng(seed).standard_normal(len(time))
    return Signal(time_ns=np.round(time * 1e9).astype(np.int64), value=value)


@pytest.mark.parametrize("shift", [-0.2, 0.0, 0.037])
def test_taps_tell_the_offset_of_two_clocks(shift):
    found = tap_offset(taps(0.0, 1000), taps(shift, 120, seed=1))
    assert found.taps == 6
    assert found.seconds == pytest.approx(shift, abs=0.003)
    assert found.spread_s < 0.005


def test_too_few_taps_and_bad_signals_are_refused():
    refused(TapError, "signal b shows 2 taps", lambda: tap_offset(taps(0, 1000), taps(0, 1000, count=2)))
    quiet = Signal(time_ns=np.arange(1000) * MS, value=np.random.default_rng(0).standard_normal(1000))
    refused(TapError, "signal a shows 0 taps", lambda: tap_offset(quiet, taps(0, 1000)))
    refused(ValueError, "does not increase", Signal, time_ns=np.zeros(4, np.int64), value=np.zeros(4))
    refused(ValueError, "must be two", Signal, time_ns=np.arange(4), value=np.zeros(5))
