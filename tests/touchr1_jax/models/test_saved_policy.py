"""A policy survives its folder; folders of something else, of another version and damaged ones are named."""

import contextlib
import dataclasses
import hashlib
import json
import os
from pathlib import Path
from unittest.mock import Mock

import jax
import numpy as np
import pytest

from experiments.faults.trainings.small_study import MODEL
from tests.touchr1_jax.drawn import draw_params
from touchr1_jax.asking import load_policy
from touchr1_jax.models import adapted_folder, saved_policy
from touchr1_jax.models.qwen.safetensors import read_header, read_tensor, write_file
from touchr1_jax.models.saved_policy import PolicyError, PolicyInput, SavedPolicy, published, read_policy, save_policy
from touchr1_jax.models.touch_policy import build_policy, touch_shapes
from touchr1_jax.text.tokenizer import word_tokenizer

SENSORS = ("xense", "gelsight_mini")


@pytest.fixture(scope="module")
def saved():
    policy = build_policy(MODEL, SENSORS)
    shapes = jax.eval_shape(lambda b: policy.init(0, b), touch_shapes(MODEL, MODEL.vision.image_px, SENSORS))
    reads = PolicyInput(rejected=("SATURATED",), choose="force", view=False)
    return SavedPolicy(policy=policy, params=draw_params(shapes), reads=reads, notes={"name": "tiny", "seed": 3})


@pytest.fixture
def folder(saved, tmp_path):
    save_policy(tmp_path / "policy", saved)
    return tmp_path / "policy"


def largest_error(saved, found) -> float:
    errors = jax.tree.map(lambda a, b: float(np.abs(a - b).max() / np.abs(a).max()), saved.params, found.params)
    return max(jax.tree.leaves(errors))


@pytest.mark.long
def test_everything_survives(saved, folder):
    found = read_policy(folder)
    assert largest_error(saved, found) == 0
    assert (found.reads, found.notes, found.model) == (saved.reads, saved.notes, saved.model)
    assert found.sensors == SENSORS
    assert found.policy.language == saved.policy.language
    assert found.policy.tokenizer.pieces == saved.policy.tokenizer.pieces
    assert np.array_equal(found.policy.layout.ids, saved.policy.layout.ids)
    assert sorted(p.name for p in folder.iterdir()) == [
        "README.md", "config.json", "model.safetensors", "tokenizer.json"
    ]  # fmt: skip
    assert [p.name for p in folder.parent.iterdir()] == ["policy"]


@pytest.mark.long
@pytest.mark.parametrize(("precision", "bound"), [("float16", 2**-11), ("int8", 1 / 254)])
def test_rounding_is_at_most_half_a_step_of_the_largest_weight(saved, tmp_path, precision, bound):
    save_policy(tmp_path / "p", saved, precision=precision)
    error = largest_error(saved, read_policy(tmp_path / "p"))
    assert bound / 3 < error <= bound * 1.001


@pytest.mark.parametrize(("precision", "value"), [("float16", 7e4), ("int8", np.nan)])
def test_a_number_that_the_precision_lacks_is_named_and_nothing_is_written(saved, tmp_path, precision, value):
    params = jax.tree.map(lambda x: np.full_like(x, value) if x.ndim > 1 else x, saved.params)
    with pytest.raises(PolicyError, match=rf" reaches {value:g}: {precision} needs numbers up to"):
        save_policy(tmp_path / "p", dataclasses.replace(saved, params=params), precision=precision)
    assert not list(tmp_path.iterdir())


def test_questions_and_words_are_those_of_training_whatever_the_code_asks_today(saved, tmp_path):
    words = [p.decode() for p in saved.policy.tokenizer.pieces if p]
    older = dataclasses.replace(saved.policy, tokenizer=word_tokenizer([*words[:5], *words[5:][::-1]]))
    questions = {**saved.questions, "hardness": "which material hard"}
    save_policy(tmp_path / "p", dataclasses.replace(saved, policy=older, questions=questions))
    found = read_policy(tmp_path / "p")
    assert found.policy.tokenizer.pieces == older.tokenizer.pieces
    asked = found.policy.layout.ids[0][found.policy.layout.mask[0]]
    assert found.policy.tokenizer.decode(asked).endswith("which material hard")


def test_a_policy_is_replaced_and_nothing_else_is(saved, folder):
    save_policy(folder, dataclasses.replace(saved, notes={"name": "second"}))
    assert read_policy(folder).notes == {"name": "second"}
    (folder.parent / "thesis").mkdir()
    (folder.parent / "thesis" / "text").write_text("x")
    os.mkfifo(folder.parent / "thesis" / "config.json")  # is not waited for
    with pytest.raises(PolicyError, match="exists and is no policy"):
        save_policy(folder.parent / "thesis", saved)
    assert (folder.parent / "thesis" / "text").read_text() == "x"


@pytest.mark.parametrize("name", [".git", "notes.txt"])
def test_what_lies_beside_a_policy_is_not_lost_with_it(saved, folder, name):
    """A clone of a repository of the hub, for example."""
    (folder / name).mkdir()
    before = read_policy(folder).notes
    with pytest.raises(PolicyError, match=f"it also holds {name}, which would be lost; move it away, or choose"):
        save_policy(folder, dataclasses.replace(saved, notes={"name": "second"}))
    assert (folder / name).is_dir()
    assert read_policy(folder).notes == before


def test_a_folder_of_other_parts_or_a_file_is_not_replaced(tmp_path):
    (tmp_path / "text").write_text("x")
    for path, said in ((tmp_path, "it also holds text"), (tmp_path / "text", "a file; move it away")):
        with pytest.raises(PolicyError, match=said), published(path, ("config.json",)):
            pass
    assert (tmp_path / "text").read_text() == "x"


def test_links_in_a_circle_are_an_error_of_the_system(tmp_path):
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    with pytest.raises(OSError, match=r"'.*/a'"), published(tmp_path / "a"):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]


class Killed(BaseException):
    """The process is gone: nothing that it would still do to its files happens."""


def replaced_until(folder, step, monkeypatch, exchange):
    """Replace a folder in a process that is killed before one of its steps on the disk; the steps that it did."""
    done = []

    def counted(act, cannot):
        def run(*args, **options):
            if len(done) == step or "killed" in done:
                done.append("killed")
                raise Killed
            done.append(act.__name__)
            return False if cannot else act(*args, **options)

        return run

    with monkeypatch.context() as disk:
        disk.setattr(saved_policy, "exchanged", counted(saved_policy.exchanged, not exchange))
        for place, name in ((Path, "rename"), (Path, "mkdir"), (saved_policy.shutil, "rmtree")):
            disk.setattr(place, name, counted(getattr(place, name), False))
        with contextlib.suppress(Killed), published(folder, ("config.json",)) as unfinished:
            (unfinished / "config.json").write_text("new")
    return done


@pytest.mark.parametrize("exchange", [True, False])
def test_a_kill_at_any_point_leaves_the_old_folder_or_the_new_one(tmp_path, monkeypatch, exchange):
    """Where folders cannot be exchanged, the old one may be next to its place, and the error says where."""
    seen, step = [], 0
    while not seen or seen[-1] is not None:
        folder = tmp_path / str(step) / "policy"
        folder.mkdir(parents=True)
        (folder / "config.json").write_text("old")
        done = replaced_until(folder, step, monkeypatch, exchange)
        step += 1
        if folder.exists():
            seen.append((folder / "config.json").read_text())
        else:
            with pytest.raises(PolicyError, match=r"a killed process left .*/\.policy\.\d+\.old: rename it to policy"):
                read_policy(folder)
            seen.append("named")
        if "killed" not in done:
            seen.append(None)
    kinds = list(dict.fromkeys(seen))
    assert kinds == (["old", "new", None] if exchange else ["old", "named", "new", None])
    assert [path.name for path in folder.parent.iterdir()] == ["policy"]


def edit(folder, **changes):
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | changes))


DAMAGE = {
    "no such folder": lambda f: f.rename(f.with_name("away")),
    "holds no config.json": lambda f: (f / "config.json").unlink(),
    "config.json is damaged": lambda f: (f / "config.json").write_text("{"),
    r"config.json is damaged \(maximum recursion": lambda f: (f / "config.json").write_text("[" * 100_000),
    "model_type in config.json is 'qwen2_5_vl': must be 'touchr1-policy'": lambda f: edit(f, model_type="qwen2_5_vl"),
    "version is 2: this code reads 1; update": lambda f: edit(f, version=2),
    "config.json was changed": lambda f: edit(f, sensors=["tac3d", "xense"]),
    "tokenizer.json is missing or damaged": lambda f: (f / "tokenizer.json").unlink(),
    "model.safetensors is missing or damaged": lambda f: flip(f / "model.safetensors"),
}


def sign(folder, change):
    """Change the config as another version would, with a checksum that holds."""
    config = json.loads((folder / "config.json").read_text())
    config.pop("checksum")
    change(config)
    digest = hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()
    (folder / "config.json").write_text(json.dumps(config | {"checksum": digest}))


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.pop("files"),
        lambda c: c["files"].pop("model.safetensors"),
        lambda c: c.update(files=[]),
        lambda c: c.pop("notes"),
        lambda c: c.update(notes=3),
        lambda c: c.update(sensors=["xense", 4]),
        lambda c: c["model"].update(frames="four"),
        lambda c: c["model"].pop("decoder"),
        lambda c: c["model"]["tactile"].update(width=10**400),
        lambda c: c.update(language=[]),
        lambda c: c.update(questions=None),
        lambda c: c["model"].update(frames=10**9),
        lambda c: c["model"]["vision"].update(image_px=2**20),
        lambda c: c["input"].update(rejected=[3]),
        lambda c: c["input"].update(rejected="SATURATED"),
        lambda c: c["input"].update(force="no"),
        lambda c: c["language"]["attributes"][0].update(levels=[]),
    ],
)
def test_a_config_of_another_version_is_named(folder, change):
    sign(folder, change)
    with pytest.raises(PolicyError, match=r"its config does not fit this version .*save it anew"):
        read_policy(folder)


def test_parameters_that_are_not_finite_are_refused(saved, tmp_path):
    leaves, tree = jax.tree.flatten(saved.params)
    diverged = jax.tree.unflatten(tree, [np.asarray(leaves[0]) * np.nan, *leaves[1:]])
    save_policy(tmp_path / "p", dataclasses.replace(saved, params=diverged))
    with pytest.raises(PolicyError, match="hold numbers that are not finite: its training diverged"):
        read_policy(tmp_path / "p")


def test_whole_numbers_are_no_weights_without_their_steps(saved, tmp_path):
    save_policy(tmp_path / "p", saved, precision="int8")
    weights = tmp_path / "p" / "model.safetensors"
    tensors = {name: read_tensor(entry) for name, entry in read_header(weights).items()}
    write_file(weights, {name: x for name, x in tensors.items() if not name.endswith(":step")})
    digest = hashlib.sha256(weights.read_bytes()).hexdigest()
    sign(tmp_path / "p", lambda c: c["files"].update({weights.name: digest}))
    with pytest.raises(PolicyError, match=r"model\.safetensors does not fit this version .*:step"):
        read_policy(tmp_path / "p")


@pytest.mark.parametrize(
    "change",
    [
        lambda ids: ids.update(firm=ids["soft"]),
        lambda ids: ids.update(firm=len(ids) + 7),
        lambda ids: ids.update(firm=-1),
        lambda ids: ids.update(firm=ids["firm"] + 0.5),
        lambda ids: ids.update(zip(list(ids)[:2], range(1, -1, -1), strict=True)),
    ],
)
def test_ids_that_name_no_order_of_words_are_refused(folder, change):
    """Sorted, they would name words; which ones, the parameters would not know."""
    path = folder / "tokenizer.json"
    tokenizer = json.loads(path.read_text())
    change(tokenizer["model"]["vocab"])
    path.write_text(json.dumps(tokenizer))
    sign(folder, lambda c: c["files"].update({path.name: hashlib.sha256(path.read_bytes()).hexdigest()}))
    with pytest.raises(PolicyError, match=r"ids of the words in tokenizer\.json must be 0, 1, 2 …"):
        read_policy(folder)


def test_a_card_tells_the_questions_of_the_language_alone(saved, tmp_path):
    more = dataclasses.replace(saved, questions={**saved.questions, "colour": "what colour is it"})
    save_policy(tmp_path / "p", more)
    card = (tmp_path / "p" / "README.md").read_text()
    assert "how hard is it? (soft, firm, hard)" in card
    assert "colour" not in card


def flip(path):
    content = bytearray(path.read_bytes())
    content[-9] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("message", DAMAGE)
def test_what_is_no_policy_is_named(folder, message):
    DAMAGE[message](folder)
    with pytest.raises(PolicyError, match=message):
        load_policy(folder)


@pytest.mark.parametrize("name", ["", 0, [], False, "n" * 5000])
def test_a_name_of_nothing_is_no_policy(name):
    with pytest.raises(PolicyError, match=r"policy is '.*': (no such folder; must be|cannot be read)"):
        load_policy(name)


def test_a_link_to_a_policy_stays_a_link(saved, folder):
    link = folder.with_name("link")
    link.symlink_to(folder.name)
    save_policy(link, dataclasses.replace(saved, notes={"name": "second"}))
    assert link.is_symlink()
    assert read_policy(folder).notes == {"name": "second"}
    assert sorted(p.name for p in folder.parent.iterdir()) == ["link", "policy"]


def test_a_folder_may_have_any_name(saved, tmp_path, monkeypatch):
    save_policy(tmp_path / "p\udcff", saved)
    assert read_policy(tmp_path / "p\udcff").notes == saved.notes
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    save_policy(Path(), saved)
    assert read_policy(tmp_path / "here").notes == saved.notes


def test_a_policy_that_cannot_be_replaced_stays(saved, folder, monkeypatch):
    before, rename = {p.name: p.read_bytes() for p in folder.iterdir()}, Path.rename

    def fails(self, target):
        if Path(target) == folder and not self.name.endswith(".old"):
            raise OSError("no rename")
        return rename(self, target)

    monkeypatch.setattr(saved_policy, "exchanged", lambda a, b: False)
    monkeypatch.setattr(Path, "rename", fails)
    with pytest.raises(OSError, match="no rename"):
        save_policy(folder, saved, precision="int8")
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before
    assert [p.name for p in folder.parent.iterdir()] == ["policy"]


@pytest.mark.parametrize("notices", [True, False])
def test_a_policy_that_is_replaced_while_it_is_read_is_read_again(tmp_path, monkeypatch, notices):
    def put(name):
        with published(tmp_path / "policy", ("config.json",)) as unfinished:
            (unfinished / "config.json").write_text(name)

    def read(folder):
        config = (folder / "config.json").read_text()
        if config == "old":
            put("new")
        parameters = (folder / "config.json").read_text()
        if notices and parameters != config:
            raise PolicyError("model.safetensors is missing or damaged; copy the folder again")
        return config, parameters

    monkeypatch.setattr(adapted_folder, "read_policy", read)
    put("old")
    assert adapted_folder.read_saved(tmp_path / "policy") == ("new", "new")
    monkeypatch.setattr(adapted_folder, "read_policy", Mock(side_effect=PolicyError("damaged")))
    with pytest.raises(PolicyError, match="damaged"):
        adapted_folder.read_saved(tmp_path / "policy")


def test_two_who_publish_one_new_folder_at_once_leave_that_of_the_later(tmp_path, monkeypatch):
    folder, exists, left = tmp_path / "policy", Path.exists, [1, 2]

    def while_looked_for(path):
        found = exists(path)
        if path == folder and left and left.pop() == 1:  # between the last look and the renaming
            folder.mkdir()
            (folder / "who").write_text("the faster one")
        return found

    with published(folder, ["who"]) as mine:
        (mine / "who").write_text("the slower one")
        monkeypatch.setattr(Path, "exists", while_looked_for)
    assert (folder / "who").read_text() == "the slower one"
    assert [path.name for path in tmp_path.iterdir()] == ["policy"]
