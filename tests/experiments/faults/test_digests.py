"""Digests of a run depend on the numbers of its checkpoints and of its data iterator, not on the devices used."""

import shutil

import jax.numpy as jnp
import pytest

from experiments.core.artifacts import write_json
from experiments.faults.digests import differences, digests
from touchr1_jax.training.checkpoint import Checkpoints
from touchr1_jax.training.checksums import CHECKSUMS


@pytest.fixture
def run(tmp_path):
    """A finished run with two checkpoints of these numbers."""

    def make(name: str, weight: float = 1.0, drawn: int = 3):
        directory = tmp_path / name
        with Checkpoints(directory / "checkpoints" / "sft" / "0") as checkpoints:
            for step in (12, 16):
                checkpoints.save(step, {"w": jnp.array([weight, 2.0]), "step": jnp.array(step)}, drawn)
        (directory / "metrics.jsonl").write_text("")
        write_json(directory / "results.json", {"verdict": [], "data": {}})
        return directory

    return make


def test_numbers_and_the_data_iterator_count(run):
    a = digests(run("a"))
    assert a == digests(run("b"))
    for name, change in (("c", {"weight": 1.0 + 1e-7}), ("d", {"drawn": 4})):
        assert differences(a, digests(run(name, **change))) == ("state of sft/0",)


def test_the_file_that_names_the_devices_does_not_count(run):
    whole, damaged = run("a"), run("b")
    sharding = damaged / "checkpoints" / "sft" / "0" / "12" / "state" / "_sharding"
    sharding.write_bytes(b"\x80" + sharding.read_bytes()[1:])
    assert digests(whole) == digests(damaged)


@pytest.mark.long
def test_what_a_kill_left_of_an_old_checkpoint_does_not_count_and_damage_of_another_does(run):
    whole, killed = run("a"), run("b")
    stage = killed / "checkpoints" / "sft" / "0"
    files = [path.relative_to(stage / "12") for path in (stage / "12").rglob("*") if path.is_file()]
    for lost in files:
        half = shutil.copytree(stage / "12", stage / "8")
        (half / lost).unlink()
        assert digests(whole) == digests(killed), lost
        shutil.rmtree(half)
    for unread in ("_CHECKPOINT_METADATA", "commit_success.txt", CHECKSUMS):  # a run ends as it had to without these
        (stage / "12" / unread).unlink()
        assert digests(whole) == digests(killed), unread
    shutil.rmtree(stage / "12")
    assert differences(digests(whole), digests(killed)) == ("state of sft/0",)
