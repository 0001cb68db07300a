"""`python -m experiments new`: what is written, and that nothing is where something is wrong."""

import ast
import os
import shutil
from pathlib import Path

import pytest

from experiments.core.new import DICTIONARY, EXAMPLES, NewError, with_entry, write_new
from experiments.core.runner import main

ROOT = Path(__file__).resolve().parents[3]
SOURCE = (ROOT / DICTIONARY).read_text(encoding="utf-8")


@pytest.fixture
def checkout(tmp_path):
    """As much of a checkout as is written to."""
    for path in (DICTIONARY, EXAMPLES):
        (tmp_path / path).parent.mkdir(parents=True)
        shutil.copy(ROOT / path, tmp_path / path)
    (tmp_path / "experiments" / "grpo").mkdir(parents=True)
    return tmp_path


def contents(root: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["aaa", "brevity", "zzz"])
def test_the_dictionary_gains_two_lines_in_order(name):
    before, after = SOURCE.splitlines(), with_entry(SOURCE, name).splitlines()
    added = [line for line in after if line not in before]
    assert added == [f"from touchr1_jax.rewards.{name} import {name}", f'        "{name}": Reward({name}),']
    assert [line for line in after if line not in added] == before
    imports = [line for line in after if line.startswith("from touchr1_jax.rewards.")]
    assert imports == sorted(imports, key=lambda line: line.split()[1])
    assert after.index(added[1]) < after.index("    }")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (SOURCE, "has a reward of that name"),
        ("rewards = {}\n", "add the lines by hand"),
        (SOURCE.replace("return {", "return dict() or {"), "must return one dictionary"),
    ],
)
def test_a_dictionary_of_another_form_is_refused(source, message):
    with pytest.raises(NewError, match=message):
        with_entry(source, "accuracy")


def test_an_experiment_alone(checkout, capsys):
    assert main(["new", "more_format", "--root", str(checkout)]) == 0
    assert "made     experiments/paper/more_format.py" in capsys.readouterr().out
    tree = ast.parse((checkout / "experiments" / "paper" / "more_format.py").read_text())
    assert (ast.get_docstring(tree) or "").splitlines()[0].endswith("?")
    assert (checkout / DICTIONARY).read_text() == SOURCE


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Brevity", "must be a lower-case Python name"),
        ("class", "must be a lower-case Python name"),
        ("ablation_ordinal", "it is taken"),
        ("compare", "it is taken"),
        ("grpo", "it is taken"),
        ("accuracy", "has a reward of that name"),
        ("mine", r"mine.py exists: nothing is overwritten"),
    ],
)
def test_a_name_that_cannot_be_is_refused_and_nothing_written(checkout, capsys, name, message):
    (checkout / "touchr1_jax/rewards/mine.py").write_text("mine")
    before = contents(checkout)
    assert main(["new", name, "--reward", "--root", str(checkout)]) == 1
    assert message in capsys.readouterr().err
    assert contents(checkout) == before


def test_what_was_written_is_taken_back_when_a_file_cannot_be(checkout):
    before = contents(checkout)
    rewards = checkout / DICTIONARY.parent
    (rewards / f".{DICTIONARY.name}.{os.getpid()}").mkdir()  # where its new content would be written
    with pytest.raises(OSError, match=DICTIONARY.name):
        write_new(checkout, "brevity", reward=True, taken=())
    assert contents(checkout) == before


def test_outside_a_checkout_nothing_is_written(tmp_path, capsys):
    assert main(["new", "brevity", "--reward", "--root", str(tmp_path)]) == 1
    assert "must be a checkout of the project" in capsys.readouterr().err
    assert not contents(tmp_path)
