"""The command asks for one touch after the other, and takes recordings of a person or of a generated object."""

import io
import re

import cv2
import numpy as np
import pytest

from experiments.active.saved import save_explorer
from experiments.ask.command import run_asking
from experiments.ask.exploring import explorer_folder, request, unseen_object
from experiments.core.artifacts import write_json
from experiments.core.errors import DataError
from experiments.core.runs import labelled
from tests.experiments.active.explorers import CONTACTS, explorer, touching
from touchr1_jax.models.saved_policy import PolicyError
from touchr1_jax.text.turns import QUESTIONS_OF_TOUCH


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Folder of an explorer that touches, and the question for which it does."""
    one, question = touching()
    folder = tmp_path_factory.mktemp("policy") / "chosen"
    save_explorer(folder, one)
    return str(folder), f"{list(QUESTIONS_OF_TOUCH.values())[question]}?"


def test_a_policy_of_another_seed_is_not_taken_for_a_run_s_own(tmp_path):
    about = {"experiment": "x", "scale": "", "command": "", "config": {}, "git": {"commit": "", "dirty": False}}
    write_json(tmp_path / "config.json", about)
    own = labelled(tmp_path, "policies/rl/0")
    for seed in ("0", "1"):
        save_explorer(tmp_path / "policies" / "rl" / seed, explorer(0), own)
    assert explorer_folder(f"{tmp_path}/rl/0", tmp_path) == tmp_path / "policies" / "rl" / "0"
    with pytest.raises(PolicyError, match=r"it is of policies/rl/0 \w{8}, must be of policies/rl/1 "):
        explorer_folder(f"{tmp_path}/rl/1", tmp_path)


def ask(saved, home, *arguments):
    folder, question = saved
    return run_asking(["ask", folder, *arguments, "--question", question, "--cache-dir", str(home)])


@pytest.mark.long
def test_a_person_answers_with_pictures(saved, tmp_path, monkeypatch, capsys):
    pictures = tmp_path / "press"
    pictures.mkdir()
    for i in range(12):
        image = np.random.default_rng(i).integers(0, 255, (48, 64, 3)).astype(np.uint8)
        cv2.imwrite(str(pictures / f"{i}.png"), image)
    monkeypatch.setattr("sys.stdin", io.StringIO(f"{tmp_path / 'missing.mp4'}\n" + f"{pictures}\n" * 5))
    assert ask(saved, tmp_path) == 0
    said = capsys.readouterr().out
    assert "with the gelsight_mini, 2 N" in said
    assert "missing.mp4" in said
    assert "no such file" in said
    assert "after " in said.splitlines()[-1]


@pytest.mark.long
def test_contacts_that_cannot_be_made_are_not_observed(saved, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", io.StringIO("\n" * 9))
    assert ask(saved, tmp_path) == 0
    assert re.search(r"%.*after (\d) touch.*; \1 of them could not be made", capsys.readouterr().out.splitlines()[-1])


@pytest.mark.long
@pytest.mark.parametrize("said", [b"", b"\xff\xfe\n"])
def test_answers_that_end_are_no_answer(saved, tmp_path, monkeypatch, capsys, said):
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(said), encoding="utf-8"))
    assert ask(saved, tmp_path) == 1
    assert "the answers ended before the policy concluded" in capsys.readouterr().err


@pytest.mark.slow  # generates contacts
def test_a_generated_object_answers_by_itself(saved, tmp_path, capsys):
    assert ask(saved, tmp_path, "generated:3") == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("now ")
    assert "truth" in said[-1]


@pytest.mark.long
@pytest.mark.parametrize(
    "arguments", [("generated:3", "generated:4"), ("press.mp4",), ("generated:soft",), ("--json",)]
)
def test_what_it_cannot_take_is_named(saved, tmp_path, capsys, arguments):
    assert ask(saved, tmp_path, *arguments) == 1
    assert "a policy that chooses its touches" in capsys.readouterr().err


def test_requests_are_words_for_a_person():
    assert request(("tac3d", "slide_x", 10.0)) == "slide it along x with the tac3d, 10 N"


def test_generated_objects_are_none_of_training():
    one = unseen_object(CONTACTS, "generated:3")
    assert (one.objects, one.seed) == (1, 1_000_003)
    with pytest.raises(DataError, match="generated:NUMBER"):
        unseen_object(CONTACTS, "generated:-1")
