"""Signals: at once where nothing is lost by it, after the step inside a loop, for good the second time."""

import contextlib
import gc
import signal
import time

import pytest

from experiments.core.stopping import AGAIN_S, SIGNALS, Stopped, Stopping


@pytest.fixture(autouse=True)
def handlers():
    """The handlers that the test began with, which are there again after each block; nohup would ignore SIGHUP."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    before = [signal.getsignal(n) for n in SIGNALS]
    yield before
    assert [signal.getsignal(n) for n in SIGNALS] == before


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_raises_at_once(number):
    with pytest.raises(Stopped, match=number.name) as stop, Stopping().listening():
        signal.raise_signal(number)
    assert stop.value.number == number


def load_extension(signalled: bool) -> None:
    """Raise as pybind11 does when an extension cannot be loaded, maybe for a signal."""
    try:
        if signalled:
            signal.raise_signal(signal.SIGTERM)
    except Stopped as stopped:
        raise ImportError("initialization failed") from stopped
    raise ImportError("no module")


@pytest.mark.parametrize(("signalled", "raised"), [(True, Stopped), (False, ImportError)])
def test_a_signal_while_an_extension_loads_is_no_import_error(signalled, raised):
    with pytest.raises(raised), Stopping().listening():
        load_extension(signalled)


def test_a_signal_waits_until_an_extension_is_loaded(monkeypatch):
    """The loader, a function here, is not interrupted; the signal comes again afterwards."""
    loaded = []

    def load():
        signal.raise_signal(signal.SIGTERM)
        time.sleep(3 * AGAIN_S)
        loaded.append(True)

    def load_and_wait():
        load()
        time.sleep(1)

    monkeypatch.setattr("sensors_io.signals._LOADING", {load.__code__})
    with pytest.raises(Stopped), Stopping().listening():
        load_and_wait()
    assert loaded


def test_a_closed_terminal_stops_no_run_that_nohup_started():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Stopping().listening():
            signal.raise_signal(signal.SIGHUP)
        with contextlib.suppress(Stopped), Stopping().listening():
            signal.raise_signal(signal.SIGTERM)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


def patiently(inside) -> None:
    """Run a function in a patient block, in which a SIGTERM comes first."""
    stopping = Stopping()
    with stopping.listening(), stopping.patient() as asked:
        assert not asked()
        signal.raise_signal(signal.SIGTERM)
        assert asked()
        inside()


def test_a_patient_block_ends_before_the_stop_which_is_announced(capfd):
    """A second signal would end the process: no handler is left."""
    done = []
    with pytest.raises(Stopped, match="SIGTERM"):
        patiently(lambda: done.extend(signal.getsignal(n) for n in SIGNALS))
    assert done == [signal.SIG_DFL] * 3
    assert "stopping once this step is done and saved" in capfd.readouterr().err
    with pytest.raises(ZeroDivisionError):
        patiently(lambda: 1 / 0)


def test_all_processes_leave_where_one_was_asked():
    """Another process was asked before the second look; this one never was."""
    others, seen = iter([False, True]), []

    def agreed(here: bool) -> bool:
        seen.append(here)
        return next(others)

    def train() -> None:
        with Stopping().patient(agreed) as asked:
            assert not asked()
            assert asked()
            assert asked()  # known by now: nobody is asked again

    with pytest.raises(Stopped, match="SIGTERM"):
        train()
    assert seen == [False, False]


def test_a_signal_after_the_last_step_is_agreed_on_as_well():
    seen, stopping = [], Stopping()
    agreed = lambda here: bool(seen.append(here)) or here
    with pytest.raises(Stopped, match="SIGTERM"), stopping.listening(), stopping.patient(agreed):
        signal.raise_signal(signal.SIGTERM)
    assert seen == [True]


@pytest.mark.parametrize("twice", [False, True])
def test_a_stop_that_the_garbage_collector_swallows_is_raised_again(twice):
    """Its callbacks, and `__del__`, cannot raise: Python would report the stop, and the run would go on."""
    struck = []

    def strike(phase, info):
        if phase == "stop" and not struck:
            struck.append(info)
            with contextlib.suppress(*[Stopped] * twice):
                signal.raise_signal(signal.SIGTERM)
            time.sleep(1.0)  # the stop comes again while it is within

    def work(seconds):
        gc.collect()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.01)

    gc.callbacks.append(strike)
    try:
        with pytest.raises(Stopped, match="SIGTERM"), Stopping().listening():
            work(10.0)
    finally:
        gc.callbacks.remove(strike)
    assert struck


def test_cleaning_up_after_a_stop_is_not_disturbed():
    closed = []

    def train() -> None:
        with Stopping().listening():
            try:
                signal.raise_signal(signal.SIGTERM)
            finally:
                time.sleep(5 * AGAIN_S)
                closed.append(True)

    with pytest.raises(Stopped, match="SIGTERM"):
        train()
    assert closed == [True]


def test_other_errors_that_cannot_be_raised_are_reported_as_before(monkeypatch):
    reported = []
    monkeypatch.setattr("sys.unraisablehook", lambda lost: reported.append(lost.exc_value))

    class Broken:
        def __del__(self):
            raise OSError("the disk is gone")

    with Stopping().listening():
        broken = Broken()
        del broken
    assert [str(x) for x in reported] == ["the disk is gone"]
