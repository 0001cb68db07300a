"""A scale asks for a machine; one that lacks it is told so before anything is made."""

import dataclasses
from types import SimpleNamespace

import pytest

from experiments.core import machine
from experiments.core.machine import GIB, Machine, MachineError, require_machine
from experiments.core.runner import Experiment, main
from tests.experiments.fakes import coin

ONE = Machine(accelerators=1, memory_gib=70.0)


def test_a_processor_is_no_accelerator():
    with pytest.raises(MachineError, match="needs 1 accelerator of 70 GiB, and there is none, only cpu"):
        require_machine("gpu", ONE)
    require_machine("default", None)


@pytest.mark.parametrize(("devices", "gib", "enough"), [(1, 80, True), (1, 40, False), (16, 140, True), (0, 0, False)])
def test_number_and_memory_are_held_to_the_needs(monkeypatch, devices, gib, enough):
    gpu = SimpleNamespace(platform="gpu", memory_stats=lambda: {"bytes_limit": gib * GIB})
    fake = SimpleNamespace(
        devices=lambda: [gpu] * devices, local_devices=lambda: [gpu] * devices, default_backend=lambda: "gpu"
    )
    monkeypatch.setattr(machine, "jax", fake)
    if enough:
        require_machine("gpu", ONE)
        return
    with pytest.raises(MachineError, match="scale is 'gpu'"):
        require_machine("gpu", ONE)


def test_a_run_is_refused_before_it_begins(monkeypatch, tmp_path, capsys):
    experiment = dataclasses.replace(coin.EXPERIMENT, needs={"smoke": ONE})
    monkeypatch.setattr(coin, "EXPERIMENT", experiment)
    assert main(["coin", "--scale", "smoke", "--runs-dir", str(tmp_path)], "tests.experiments.fakes") == 1
    assert "needs 1 accelerator" in "".join(capsys.readouterr())
    assert list(tmp_path.iterdir()) == []


def test_needs_are_of_scales():
    with pytest.raises(ValueError, match="must be scales"):
        Experiment(name="coin", config=coin.Config(), run=coin.run, needs={"huge": ONE})
