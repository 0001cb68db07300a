"""A saved policy asks for contacts until it concludes, and a folder gives back what was saved."""

import dataclasses
import json
import os
import shutil
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from experiments.active.arms import played_once
from experiments.active.saved import is_explorer, read_explorer, require_published, save_explorer
from experiments.core.runs import labelled
from tests.experiments.active.explorers import explorer, frames, touching
from touchr1_jax.models.saved_policy import PolicyError


@pytest.fixture(scope="module")
def asking():
    return touching()


@pytest.mark.long
def test_it_asks_for_each_contact_once_and_concludes(asking):
    one, question = asking
    requested = []

    def give(choice):
        requested.append(choice)
        return frames(choice)

    found = one.ask(question, give)
    assert 1 <= len(found.choices) <= one.budget
    assert requested == list(dict.fromkeys(found.choices))
    assert found.probabilities.sum() == pytest.approx(1)


@pytest.mark.long
def test_what_is_observed_changes_the_answer_and_nothing_observed_does_not(asking):
    one, question = asking
    seen = [one.ask(question, lambda choice, s=s: frames(s)).probabilities for s in range(3)]
    assert not np.allclose(seen[0], seen[1])
    unseen = [one.ask(question, lambda choice: None) for _ in range(2)]
    assert unseen[0].choices == unseen[1].choices
    np.testing.assert_array_equal(unseen[0].probabilities, unseen[1].probabilities)


@pytest.mark.long
def test_a_folder_gives_back_the_policy(asking, tmp_path):
    one, question = asking
    save_explorer(tmp_path / "policy", one)
    save_explorer(tmp_path / "policy", one)  # over itself
    assert is_explorer(tmp_path / "policy")
    again = read_explorer(tmp_path / "policy").ask(question, frames)
    found = one.ask(question, frames)
    assert again.choices == found.choices
    np.testing.assert_allclose(again.probabilities, found.probabilities, rtol=1e-5)


@pytest.fixture(scope="module")
def drawn():
    return explorer(0)


@pytest.mark.long
@pytest.mark.parametrize("damage", ["byte", "config", "gone", "another"])
def test_an_unfinished_run_publishes_a_damaged_policy_again(drawn, tmp_path, damage):
    """Before, it ended with a policy that nothing could read, or with that of another seed, and did not say so."""
    publish = lambda: save_explorer(folder, drawn, labelled(tmp_path, "policies/chosen/0"))
    folder, printed, stages = tmp_path / "policies" / "chosen" / "0", list[str](), {"played/chosen/0": 1}
    once = lambda stage, compute: stages[stage]
    context = SimpleNamespace(directory=tmp_path, print=printed.append, done=stages.__contains__, once=once)
    publish()
    assert played_once("chosen", 0, pytest.fail, context) == 1
    if damage == "gone":
        shutil.rmtree(folder)
    elif damage == "another":
        save_explorer(folder, drawn, labelled(tmp_path, "policies/chosen/1"))
    else:
        path = folder / ("config.json" if damage == "config" else "model.safetensors")
        path.write_bytes(path.read_bytes()[:-9])
    assert played_once("chosen", 0, publish, context) == 1
    (line,) = printed
    assert str(folder) in line
    assert "it is made again" in line
    require_published(tmp_path, "chosen", 0)


@pytest.mark.parametrize("damage", ["byte", "missing", "version"])
def test_a_damaged_folder_is_named(drawn, tmp_path, damage):
    folder = tmp_path / "policy"
    save_explorer(folder, drawn)
    if damage == "byte":
        content = bytearray((folder / "model.safetensors").read_bytes())
        content[-5] ^= 1
        (folder / "model.safetensors").write_bytes(content)
    elif damage == "missing":
        (folder / "model.safetensors").unlink()
    else:
        fields = json.loads((folder / "config.json").read_text())
        del fields["crc32"]
        (folder / "config.json").write_text(json.dumps(fields | {"version": 99}))
    with pytest.raises(PolicyError, match=str(folder)):
        read_explorer(folder)


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda one: {"scale": 0.0}, "scale is 0.0 and budget 2"),
        (lambda one: {"budget": 0}, "budget 0: must be"),
        (lambda one: {"params": jax.tree.map(lambda x: x * np.nan, one.params)}, "not finite: its training diverged"),
        (lambda one: {"params": jax.tree.map(lambda x: x[:-1], one.params)}, "of another shape"),
        (lambda one: {"contacts": dataclasses.replace(one.contacts, forces_n=(1.0, 2.0))}, "of another shape"),
        (lambda one: {"encoder": dataclasses.replace(one.encoder, width=16)}, "of another shape"),
    ],
)
def test_parameters_that_answer_nothing_are_refused(drawn, tmp_path, change, message):
    save_explorer(tmp_path / "policy", dataclasses.replace(drawn, **change(drawn)))
    with pytest.raises(PolicyError, match=message):
        read_explorer(tmp_path / "policy")


def test_other_folders_are_no_explorers(tmp_path):
    assert not is_explorer(tmp_path)
    for text in ("[]", "[" * 200_000):
        (tmp_path / "config.json").write_text(text)
        assert not is_explorer(tmp_path)
    (tmp_path / "config.json").unlink()
    os.mkfifo(tmp_path / "config.json")
    assert not is_explorer(tmp_path)
    with pytest.raises(PolicyError, match="a pipe"):
        read_explorer(tmp_path)
