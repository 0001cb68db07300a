"""Clocks and counters against known truth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sensors_io.clock import NS_PER_S
from sensors_io.sync import ClockMap, IndexGaps, PeriodGaps

MS = 1_000_000


def test_the_least_delayed_sample_sets_the_clock():
    """Delays 5, 0, 7, 3 ms: from the second on every stamp is exact."""
    clock = ClockMap(window_s=10)
    device = [0, 10 * MS, 20 * MS, 30 * MS]
    delay = [5 * MS, 0, 7 * MS, 3 * MS]
    mapped = [clock.to_host_ns(d, d + 1000 * MS + late) for d, late in zip(device, delay, strict=True)]
    assert mapped == [1005 * MS, 1010 * MS, 1020 * MS, 1030 * MS]


@pytest.mark.parametrize("skew", [-5e-5, 5e-5])
def test_a_skewed_clock_is_followed_within_skew_times_window(skew):
    """An hour at 50 ppm, where the minimum of all differences would be 180 ms off."""
    clock, rng = ClockMap(window_s=10), np.random.default_rng(0)
    true = np.arange(0, 3600 * 25) * 40 * MS
    arrival = np.maximum.accumulate(true + (rng.exponential(3, len(true)) * MS).astype(np.int64))
    device = np.round(true * (1 + skew)).astype(np.int64)
    mapped = np.array([clock.to_host_ns(int(d), int(h)) for d, h in zip(device, arrival, strict=True)])
    assert np.all(mapped <= arrival)
    late = (mapped - true)[1000:]
    assert np.abs(late).max() <= 0.5 * MS + 3 * MS / 50  # the least of 250 exponential delays


def test_a_restarted_device_clock_starts_anew():
    clock = ClockMap()
    clock.to_host_ns(10_000 * MS, 0)
    assert clock.to_host_ns(5 * MS, 20 * MS) == 20 * MS
    assert clock.restarts == 1


@pytest.mark.parametrize("rate", [0.0, 0.5, 0.9])
def test_a_clock_that_stands_still_or_runs_slow_is_left_for_the_arrival(rate):
    """At .9 the least of ten seconds is left behind by a quarter of a second within 2.5 s."""
    clock = ClockMap()
    arrival = np.arange(0, 20 * NS_PER_S, 33 * MS)
    mapped = [clock.to_host_ns(int(rate * h), int(h)) for h in arrival]
    assert clock.slow
    assert np.array_equal(mapped[len(mapped) // 4 :], arrival[len(mapped) // 4 :])
    assert clock.to_host_ns(-1, 21 * NS_PER_S) == 21 * NS_PER_S
    assert not clock.slow  # the clock has restarted


@pytest.mark.parametrize("anew_s", [0.0, 0.7])
def test_a_clock_that_stands_still_for_some_samples_is_left_for_the_arrival_at_once(anew_s):
    """It goes on where it would be, or `anew_s` behind."""
    clock, arrival = ClockMap(), np.arange(0, 3 * NS_PER_S, 33 * MS)
    device = arrival - np.where(arrival > 2 * NS_PER_S, round(anew_s * NS_PER_S), 0)
    device[30:50] = device[30]
    assert np.array_equal([clock.to_host_ns(int(d), int(h)) for d, h in zip(device, arrival, strict=True)], arrival)


@pytest.mark.parametrize(("rate", "slow"), [(0.972, False), (0.965, True)])
def test_a_clock_is_slow_that_falls_behind_by_more_than_3_percent(rate, slow):
    clock = ClockMap()
    for arrival in range(0, 20 * NS_PER_S, 33 * MS):
        clock.to_host_ns(round(rate * arrival), arrival)
    assert clock.slow == slow


@pytest.mark.parametrize("stall_s", [0.3, 1.0, 4.0])
def test_samples_that_a_stall_held_up_are_no_slow_clock(stall_s):
    clock = ClockMap()
    device = np.arange(0, 20 * NS_PER_S, 33 * MS)
    for begin in range(20):
        held = (device >= (5 + begin / 20) * NS_PER_S) & (device < (5 + begin / 20 + stall_s) * NS_PER_S)
        arrival = np.where(held, device[held].max(), device)
        mapped = [clock.to_host_ns(int(d), int(h)) for d, h in zip(device, arrival, strict=True)]
        assert not clock.slow
        assert np.abs(mapped - device).max() == 0


@pytest.mark.parametrize("late_s", [0.4, 2.0])
def test_a_link_that_is_late_for_some_seconds_or_a_late_sample_before_a_pause_is_no_slow_clock(late_s):
    device = np.arange(0, 20 * NS_PER_S, 33 * MS)
    for begin in np.arange(5, 6, 0.05):
        clock, first = ClockMap(), round(begin * NS_PER_S)
        delays = np.where((device >= first) & (device < first + 3 * NS_PER_S), round(late_s * NS_PER_S), 0)
        arrival = np.maximum.accumulate(device + delays)
        mapped = [clock.to_host_ns(int(d), int(h)) for d, h in zip(device, arrival, strict=True)]
        assert np.count_nonzero(mapped - device) <= 62  # the seconds in which the link falls behind and catches up
        clock, late = ClockMap(), device[device < first]
        for d in late:
            clock.to_host_ns(int(d), int(d) + (round(late_s * NS_PER_S) if d == late[-1] else 0))
        clock.to_host_ns(int(late[-1]) + 4 * NS_PER_S, int(late[-1]) + 4 * NS_PER_S)
        assert not clock.slow


@pytest.mark.parametrize("late_s", [0.3, 0.6, 2.0])
def test_times_never_run_backward_where_a_link_gets_slower_and_recovers(late_s):
    device = np.arange(0, 30 * NS_PER_S, 33 * MS)
    for begin in np.arange(5, 6, 0.05):
        delays = late_s * np.interp(device / NS_PER_S, begin + np.array([0, 4, 9, 11]), [0, 1, 1, 0])
        arrival = np.maximum.accumulate(device + (delays * NS_PER_S).astype(int))
        clock = ClockMap()
        mapped = [clock.to_host_ns(int(d), int(h)) for d, h in zip(device, arrival, strict=True)]
        assert np.diff(mapped).min() >= 0
        assert not clock.slow


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans()), min_size=1, max_size=60))
def test_drops_and_duplicates_of_a_counter_are_all_found(plan):
    """Each entry: how many are dropped before a sample, and whether it comes twice."""
    gaps, index, missing, duplicates = IndexGaps(), 250, 0, 0
    gaps.step(index)
    for dropped, twice in plan:
        index += dropped + 1
        for _ in range(1 + twice):
            step = gaps.step(index)
            missing += step.missing
            duplicates += step.duplicate
    assert missing == sum(dropped for dropped, _ in plan)
    assert duplicates == sum(twice for _, twice in plan)


def test_a_late_sample_is_told_from_a_duplicate_and_a_restart():
    gaps = IndexGaps()
    steps = [gaps.step(i) for i in (5000, 5001, 5004, 5002, 5002, 5005, 7)]
    assert [s.missing for s in steps] == [0, 0, 2, 0, 0, 0, 0]
    assert steps[3].late
    assert steps[4].duplicate
    assert steps[6].restarted
    assert not any(s.restarted for s in steps[:6])
    assert gaps.step(5, reopened=True).restarted


def test_periods_count_what_is_missing_and_take_back_what_was_late():
    gaps = PeriodGaps(10 * MS)
    times = [0, 10, 20, 50, 60, 76, 80, 90, 70]  # two lost before 50; 70 comes 6 ms late; in the end 20 ms back
    assert [gaps.step(t * MS).missing for t in times] == [0, 0, 0, 2, 0, 1, -1, 0, -1]


def test_a_sample_that_comes_early_takes_back_no_loss_that_was_not_counted():
    gaps = PeriodGaps(10 * MS)
    times = [0, 10, 14, 30, 40, 40, 40, 70, 80]  # 20 comes early, 50 and 60 with 40
    assert [gaps.step(t * MS).missing for t in times] == [0] * 9
    assert not gaps.fast


@pytest.mark.parametrize(("share", "followed"), [(0.92, 0.95), (1.02, 1.02), (1.08, 1.05)])
def test_a_period_is_followed_to_5_percent(share, followed):
    gaps = PeriodGaps(10 * MS)
    assert not any(gaps.step(round(k * share * 10 * MS)).missing for k in range(200))
    assert gaps._period_ns == pytest.approx(followed * 10 * MS, rel=1e-3)
