"""What a checkpoint comes to: its numbers and its data iterator, whoever held them and whatever lies beside."""

import jax.numpy as jnp
import orbax.checkpoint as ocp
import pytest

from experiments.core.artifacts import write_json
from experiments.faults.digests import digests


@pytest.fixture
def run(tmp_path):
    """A finished run by the numbers of its one checkpoint."""

    def make(name: str, weight: float = 1.0, drawn: bytes = b"3"):
        directory = tmp_path / name
        step = directory / "checkpoints" / "sft" / "0" / "12"
        with ocp.StandardCheckpointer() as checkpointer:
            checkpointer.save(step / "state", {"w": jnp.array([weight, 2.0]), "step": jnp.array(12)})
        (step / "data").mkdir()
        (step / "data" / "metadata").write_bytes(drawn)
        (directory / "metrics.jsonl").write_text("")
        write_json(directory / "results.json", {"verdict": [], "data": {}})
        return directory

    return make


STATE = "state of sft/0"


def test_numbers_and_the_data_iterator_count(run):
    a = digests(run("a"))[STATE]
    assert a == digests(run("b"))[STATE]
    assert a != digests(run("c", weight=1.0 + 1e-7))[STATE]
    assert a != digests(run("d", drawn=b"4"))[STATE]


def test_a_damaged_note_of_who_held_the_arrays_does_not(run):
    whole, damaged = run("a"), run("b")
    note = damaged / "checkpoints" / "sft" / "0" / "12" / "state" / "_sharding"
    note.write_bytes(b"\x80" + note.read_bytes()[1:])
    assert digests(whole) == digests(damaged)
