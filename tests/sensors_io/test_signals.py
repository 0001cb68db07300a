"""Signals that end a program do what Ctrl-C does; one that is ignored stays so; a second one ends it at once."""

import gc
import os
import signal
import subprocess
import sys
import time

import pytest

from sensors_io.__main__ import main
from sensors_io.commands.choices import stop_on_interrupt
from sensors_io.signals import ENDING, Ended, end_as_interrupted, leave_interrupted, say

ALL = (signal.SIGINT, *ENDING)


@pytest.fixture(autouse=True)
def handlers(monkeypatch):
    """Handlers of a program that was just started, and afterwards those of the tests."""
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    before = {number: signal.getsignal(number) for number in (*ALL, signal.SIGALRM)}
    for number in ALL:
        signal.signal(number, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_unwinds_the_program_as_ctrl_c_does(number, capsys):
    end_as_interrupted()
    with pytest.raises(KeyboardInterrupt) as stopped:
        signal.raise_signal(number)
    assert leave_interrupted(stopped.value, "run it again") == 128 + number
    assert capsys.readouterr().err == "run it again\n"
    assert {signal.getsignal(n) for n in ALL} == {signal.SIG_DFL}


@pytest.mark.parametrize("number", ALL)
def test_a_signal_within_a_callback_of_the_garbage_collector_is_not_lost(number):
    """Python only reports what is raised there, and goes on; JAX has such a callback."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    end_as_interrupted()

    def strike(phase, info):
        gc.callbacks.remove(strike)
        signal.raise_signal(number)

    def collect():
        gc.collect()
        time.sleep(5)

    gc.callbacks.append(strike)
    with pytest.raises(KeyboardInterrupt) as stopped:
        collect()
    assert leave_interrupted(stopped.value, "") == 128 + number


@pytest.mark.parametrize("number", ALL)
def test_a_signal_while_an_extension_loads_is_no_import_error(number):
    """pybind11 turns what is raised then into an ImportError."""
    code = f"""
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from sensors_io.signals import end_as_interrupted
end_as_interrupted()
print("printed before")
try:
    signal.raise_signal({number})
except BaseException as error:
    raise ImportError("initialization failed") from error
"""
    env = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=env)
    assert (ended.returncode, ended.stderr) == (128 + number, "interrupted: run the same command again\n")
    assert ended.stdout == "printed before\n"


@pytest.mark.parametrize("number", ALL)
def test_a_signal_while_an_extension_loads_comes_once_it_is_loaded(number):
    """Extensions by nanobind abort the process at what is raised then."""
    code = f"""
import enum, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)
from sensors_io.signals import end_as_interrupted
end_as_interrupted()
make, struck = enum.EnumType.__call__, []
def strike(*args, **names):
    if sys._getframe(1).f_code.co_name == "_call_with_frames_removed" and not struck:  # by the extension itself
        struck.append(signal.raise_signal({number}))
    return make(*args, **names)
enum.EnumType.__call__ = strike
import jaxlib.xla_client
print("loaded", len(struck), flush=True)
time.sleep(9)
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (128 + number, "interrupted: run the same command again\n")


def test_a_signal_that_is_ignored_stays_so():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    end_as_interrupted()
    signal.raise_signal(signal.SIGHUP)
    with stop_on_interrupt() as stop:
        signal.raise_signal(signal.SIGHUP)
    assert not stop.is_set()
    assert leave_interrupted(KeyboardInterrupt(), "") == 128 + signal.SIGINT
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


@pytest.mark.parametrize("number", ALL)
def test_devices_end_in_order_at_the_first_signal_and_at_once_at_the_second(number):
    with stop_on_interrupt() as stop:
        signal.raise_signal(number)
        assert stop.is_set()
        with pytest.raises(Ended):
            signal.raise_signal(number)


@pytest.mark.parametrize("lost", [OSError, ValueError])
def test_words_that_nobody_reads_raise_nothing(monkeypatch, lost):
    class Gone:
        def write(self, text):
            raise lost

    for stream in (None, Gone()):
        monkeypatch.setattr("sys.stderr", stream)
        say("x")


def test_help_that_cannot_be_printed_is_one_line(monkeypatch, capsys):
    def full(*args, **options):
        raise OSError("No space left on device")

    monkeypatch.setattr("sensors_io.commands.console.OUT.print", full)
    assert main(["--help"]) == 1
    assert capsys.readouterr().err.startswith(
        "OSError: No space left on device: let standard output and standard error"
    )


@pytest.mark.parametrize(("command", "status"), [("list --help", 0), ("list --helpx", 2)])
def test_without_streams_nothing_is_raised_and_no_file_takes_their_numbers(tmp_path, command, status):
    line = f"exec {sys.executable} -m sensors_io {command} >&-"
    ended = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False)
    assert (ended.returncode, "Traceback" in ended.stderr) == (status, False)
    code = "from sensors_io.commands.console import print_in_any_encoding as p; p(); print(open('x', 'w').fileno())"
    line = f'exec {sys.executable} -c "{code}" <&- 2>&-'
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    ended = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False, cwd=tmp_path, env=env)
    assert int(ended.stdout) > 2
