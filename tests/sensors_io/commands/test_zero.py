"""`zero`: the sensor is asked to, its force before and after is shown, and one that cannot is named."""

import contextlib
import time

import numpy as np
import pytest

from sensors_io import __main__ as cli
from sensors_io.devices.base import Identity, Sample
from sensors_io.devices.errors import DeviceDataError
from sensors_io.devices.tac3d import Tac3dConfig


class Drifted(contextlib.AbstractContextManager):
    """A sensor that reads 0.4 N untouched until it has taken its zero, obeyed after 50 ms."""

    identity = Identity(sensor="tac3d")

    def __init__(self):
        self.zeroed_s = float("inf")

    def __exit__(self, *error):
        return None

    def take_zero(self):
        self.zeroed_s = time.monotonic() + 0.05

    def read(self, timeout_s):
        time.sleep(0.001)
        force = 0.0 if time.monotonic() > self.zeroed_s else -0.4
        return Sample(host_time_ns=time.monotonic_ns(), arrays={"force_n": np.array([0, 0, force], np.float32)})


def test_a_drifted_sensor_reads_zero_afterwards(monkeypatch, capsys):
    monkeypatch.setattr(Tac3dConfig, "open", lambda self: Drifted())
    assert cli.main(["zero", "--seconds", "0.05", "tac3d", "+", "tac3d"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "tac3d" in line]
    assert len(rows) == 2
    assert all("+0.000 +0.000 -0.400" in row and row.count("+0.000 +0.000 +0.000") == 1 for row in rows)


@pytest.mark.parametrize(("broken", "status"), [(7, 0), (1_000_000, 1)])
def test_broken_messages_are_left_out_unless_all_are_broken(monkeypatch, capsys, broken, status):
    class Noisy(Drifted):
        left = broken

        def read(self, timeout_s):
            if self.left:
                Noisy.left -= 1
                raise DeviceDataError("2 bytes: its header alone has 8")
            return super().read(timeout_s)

    monkeypatch.setattr(Tac3dConfig, "open", lambda self: Noisy())
    monkeypatch.setattr("sensors_io.commands.zero._TIMEOUT_S", 0.1)
    assert cli.main(["zero", "--seconds", "0.05", "tac3d"]) == status
    said = capsys.readouterr()
    assert "2 bytes" in said.err if status else "7 broken samples of tac3d were left out" in said.out


def test_a_message_without_force_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(Tac3dConfig, "open", lambda self: Drifted())
    monkeypatch.setattr(Drifted, "read", lambda self, timeout_s: Sample(host_time_ns=0, arrays={}))
    assert cli.main(["zero", "tac3d"]) == 1
    assert "tac3d sent a sample without force" in capsys.readouterr().err
