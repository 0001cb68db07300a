"""Where data comes from: refused combinations, caches named after what made them."""

import dataclasses
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from experiments.core import numerics
from experiments.core.context import Context
from experiments.core.errors import ConfigurationError, DataError
from experiments.encoder.pretrain import StageOneDataConfig, open_touch
from experiments.study import sources
from experiments.study.sources import SourceConfig, SurveyedContacts, prepare_records, scenes_folder, survey_contacts
from experiments.study.training import open_data, require_encoder
from sensors_io.cards import replace_cards
from sensors_io.commands.label import Label
from sensors_io.importers.physiclear import PhysiclearConfig
from sensors_io.locks import RecordsBusyError
from sensors_io.records import RecordStore, RecordWriter
from sensors_io.scenes.config import SceneConfig
from sensors_io.schema import LEVELS
from tests.experiments import tiny
from tests.sensors_io import fakes
from touchr1_jax.models.pretrained import PretrainedEncoder

CHANGED = "changed since this run began, or the code that reads this input did: put a copy back, or .* --fresh"
GENERATED = SourceConfig(scenes=tiny.SCENES)


def test_records_are_taken_as_they_are(records, context):
    config = dataclasses.replace(GENERATED, data="records", data_dir=records)
    assert prepare_records(config, context) == records
    assert context.timing() == {}


@pytest.mark.long
def test_records_and_encoders_that_changed_end_a_continued_run(tmp_path, records, policy, params, context):
    copy, file = tmp_path / "copy", tmp_path / "encoder.npz"
    shutil.copytree(records, copy)
    config = dataclasses.replace(tiny.STUDY, data="records", data_dir=copy)
    card = RecordStore(copy).objects[RecordStore(copy).contacts[0].object_id]
    level = card.label_row()[list(LEVELS).index("hardness")]
    encoder = PretrainedEncoder(
        config=policy.model.tactile, sensors=tuple(s.name for s in policy.language.sensors), params=params["tactile"]
    )
    for _ in range(2):
        file.write_bytes(encoder.to_bytes())
        open_data(config, 16, context)
        require_encoder(file, context)
    table = tmp_path / "labels.csv"
    for hardness, changes in ((level, False), ((level + 1) % 3, True)):
        table.write_text(f"object_id,hardness\n{card.object_id},{hardness}\n")
        assert Label(records=copy, labels=table, annotator="ada").run() == 0
        if not changes:  # the index is another one, what it says is not
            open_data(config, 16, context)
    with pytest.raises(ConfigurationError, match=rf"copy, the records, {CHANGED}"):
        open_data(config, 16, context)
    changed = dataclasses.replace(encoder, params=jax.tree.map(jnp.negative, encoder.params))
    file.write_bytes(changed.to_bytes())
    with pytest.raises(ConfigurationError, match=rf"encoder\.npz, the encoder, {CHANGED}"):
        require_encoder(file, context)


def test_generated_scenes_are_made_once(tmp_path, cache_dir, records):
    shards = {p.name: p.stat().st_mtime_ns for p in records.glob("*.arrayrecord")}
    context = Context(tmp_path, cache_dir, Console(quiet=True))
    path = prepare_records(GENERATED, context)
    context.close()
    assert path == records
    assert {p.name: p.stat().st_mtime_ns for p in records.glob("*.arrayrecord")} == shards
    assert set(context.timing()) == {"data"}


def test_scenes_that_other_settings_compute_are_others(monkeypatch, records, cache_dir):
    """Before, whoever made them first decided the bits of every later study."""
    assert scenes_folder(cache_dir, tiny.SCENES) == records
    monkeypatch.setenv(numerics.FLAGS, "--xla_cpu_enable_fast_math=true")
    assert scenes_folder(cache_dir, tiny.SCENES) != records


def test_other_scenes_lie_elsewhere(monkeypatch, context):
    made = []
    monkeypatch.setattr(sources, "generate_records", lambda config, path, *, progress: made.append(path))
    for scenes in (tiny.SCENES, dataclasses.replace(tiny.SCENES, seed=1), SceneConfig(), tiny.SCENES):
        made_at = prepare_records(dataclasses.replace(GENERATED, scenes=scenes), context)
        assert made[-1] == made_at
    assert len(set(made)) == 3


@pytest.mark.parametrize(
    ("maker", "change"),
    [("generate_records", {}), ("import_catalogue", {"data": "physiclear", "data_dir": Path("videos")})],
)
def test_records_that_another_run_is_making_are_waited_for(monkeypatch, context, console, maker, change):
    busy = [RecordsBusyError("records are being written"), RecordsBusyError("records are being written")]

    def make(*args, **options):
        if busy:
            raise busy.pop()

    monkeypatch.setattr(sources, "list_physiclear", lambda source, config: None)
    monkeypatch.setattr(sources, maker, make)
    monkeypatch.setattr(sources.time, "sleep", lambda seconds: None)
    prepare_records(dataclasses.replace(GENERATED, **change), context)
    assert console.file.getvalue().count("waiting: records are being written") == 1


def test_imported_videos_are_named_by_folder_and_settings(tmp_path, context, monkeypatch):
    imported = []
    monkeypatch.setattr(sources, "list_physiclear", lambda source, config: config)
    taken = lambda listed, out, *, progress: progress(1, 2) or imported.append((out, listed))
    monkeypatch.setattr(sources, "import_catalogue", taken)
    first = dataclasses.replace(GENERATED, data="physiclear", data_dir=tmp_path / "a")
    other = dataclasses.replace(first, physiclear=PhysiclearConfig(height=60))
    elsewhere = dataclasses.replace(first, data_dir=tmp_path / "b")
    roundabout = dataclasses.replace(first, data_dir=tmp_path / "b" / ".." / "a")
    paths = [prepare_records(config, context) for config in (first, other, elsewhere, roundabout)]
    assert len(set(paths)) == 3
    assert paths[3] == paths[0]
    assert imported[:2] == [(paths[0], PhysiclearConfig()), (paths[1], PhysiclearConfig(height=60))]
    assert all(path.parent == context.cache_dir and path.name.startswith("physiclear-") for path in paths)
    monkeypatch.setenv("NVIDIA_TF32_OVERRIDE", "1")  # which OpenCV does not read
    assert prepare_records(first, context) == paths[0]
    monkeypatch.setenv("OPENCV_IPP", "disabled")
    assert prepare_records(first, context) not in paths


def test_odd_contacts_of_recordings_are_listed_before_training_and_left_out_on_request(data, tmp_path, context):
    """Of training contacts one is black for one sensor, two copies of the first, one of them of its own object."""
    store = data.store
    first, black, *_, copy = train = store.contacts_of_split("train").tolist()
    with RecordWriter(tmp_path / "odd", meta=store.meta) as writer:
        for card in store.objects.values():
            writer.write_object(card)
        untouched = dataclasses.replace(store.objects[store.contacts[0].object_id], object_id="untouched", view=None)
        writer.write_object(untouched)
        writer.write_object(dataclasses.replace(untouched, object_id="unseen", view=np.zeros((4, 4, 3), np.uint8)))
        for i in range(len(store)):
            sequences = list(store.contact(i).values())
            if i == black:
                sequences[0] = dataclasses.replace(sequences[0], frames=np.zeros_like(sequences[0].frames))
            if i == 0:  # its force stood for that of all
                sequences = [dataclasses.replace(x, force_n=None) for x in sequences]
            if i == copy:
                sequences = [dataclasses.replace(x, key=store.contacts[i]) for x in store.contact(first).values()]
            writer.write_contact(sequences)
        again = dataclasses.replace(store.contacts[first], trial=9)
        writer.write_contact([dataclasses.replace(x, key=again) for x in store.contact(first).values()])
    count = len(store) + 1
    config = StageOneDataConfig(data="records", data_dir=tmp_path / "odd")
    assert survey_contacts(config, tmp_path / "odd", context).odd == tuple(sorted((first, black, copy, count - 1)))
    opened = open_touch(dataclasses.replace(config, drop_odd=True), 2, 16, context)
    assert opened.has_force
    parts = opened.parts
    assert set(np.concatenate(list(parts.values()))) == set(range(len(store))) - {first, black, copy}
    printed = context.console.file.getvalue()
    assert f"measured force: {count - 1} of {count} contacts; the others " in printed
    assert f"picture: {len(store.objects) + 1} of {len(store.objects) + 2} objects; the others " in printed
    assert f"all pictures black: 1 of {count} contacts are trained on (option drop-odd leaves them out)" in printed

    assert f"the same recording twice: 3 of {count} contacts are left out: " in printed
    assert f"without any contact: 2 of {len(store.objects) + 2} objects, such as untouched" in printed
    assert f"picture of one colour: 1 of {len(store.objects) + 2} objects, such as unseen" in printed
    assert f"gelsight_mini: {count} of 28 × 28 at " in printed
    (hardness,) = (line for line in printed.splitlines() if line.startswith("hardness, objects of levels 0 to 2: "))
    for part, rows in (("training", train[2:-1]), ("test", store.contacts_of_split("test"))):
        levels = [store.objects[store.contacts[i].object_id].labels["hardness"] for i in rows]
        assert f"{part} {levels.count(0)}, {levels.count(1)}, {levels.count(2)}" in hardness
    assert survey_contacts(GENERATED, store.path, context) == SurveyedContacts()


def test_a_picture_of_one_colour_has_no_other_pixel():
    picture = np.tile(np.uint8([1, 2, 3]), (4, 5, 1))
    assert sources._is_even(picture)
    assert not sources._is_even(None)
    picture[3, 4, 2] = 4
    assert not sources._is_even(picture)


def test_recordings_that_differ_in_a_time_or_a_view_are_others(data, tmp_path, context):
    """The root of their index is the same: a trained encoder would be taken from the cache for the others too."""
    store = data.store

    def content_of(name, sequence=lambda x: x, card=lambda x: x):
        with RecordWriter(tmp_path / name, meta=store.meta) as writer:
            for each in store.objects.values():
                writer.write_object(card(each))
            for i in range(len(store)):
                writer.write_contact([sequence(x) for x in store.contact(i).values()])
        return survey_contacts(StageOneDataConfig(data="records", data_dir=tmp_path), tmp_path / name, context).content

    later = lambda x: dataclasses.replace(x, host_time_ns=x.host_time_ns + (np.arange(len(x)) == len(x) - 1))
    darker = lambda x: dataclasses.replace(x, view=x.view // 2)
    same, again, *others = (
        content_of("one"),
        content_of("two"),
        content_of("three", later),
        content_of("4", card=darker),
    )
    assert same == again
    assert len({same, *others}) == 3
    one, two = (dataclasses.replace(data, content=content) for content in (same, others[0]))
    assert one.digest() != two.digest()


def test_records_of_a_sensor_that_answers_cannot_name_are_refused(tmp_path, context):
    meta = dataclasses.replace(fakes.META, sensors=("digit",))
    with RecordWriter(tmp_path / "digit", meta=meta) as writer:
        for n in range(4):
            writer.write_object(fakes.card(n))
            writer.write_contact([dataclasses.replace(fakes.sequence(n), sensor="digit")])
    config = dataclasses.replace(tiny.STUDY, data="records", data_dir=tmp_path / "digit")
    with pytest.raises(DataError, match="digit holds records of digit: answers name gelsight_mini, xense"):
        open_data(config, 32, context)


@pytest.mark.parametrize("kept", [(), ("material",)])
@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_a_part_without_labels_is_refused_before_training(tmp_path, records, context, split, kept):
    """Before, a run trained to its end and then found nothing to ask, or nothing to score, about its test contacts."""
    shutil.copytree(records, tmp_path / "copy")
    cards = RecordStore(records).objects.values()
    left = lambda card: {name: level for name, level in card.labels.items() if name in kept}
    bare = [dataclasses.replace(card, labels=left(card)) if card.split == split else card for card in cards]
    replace_cards(tmp_path / "copy", bare)
    config = dataclasses.replace(tiny.STUDY, data="records", data_dir=tmp_path / "copy")
    part = "sft" if split == "train" else split
    with pytest.raises(
        DataError, match=f"part '{part}' of .*copy holds no object with a label of hardness, .*: every part"
    ):
        open_data(config, 16, context)


def test_one_object_alone_is_no_test_part(tmp_path, records, context):
    """Before, a run trained to its end and then had no interval over objects."""
    shutil.copytree(records, tmp_path / "copy")
    cards = list(RecordStore(records).objects.values())
    first = next(card.object_id for card in cards if card.split == "test")
    other = lambda card: card.split == "test" and card.object_id != first
    replace_cards(tmp_path / "copy", [dataclasses.replace(card, labels={}) if other(card) else card for card in cards])
    config = dataclasses.replace(tiny.STUDY, data="records", data_dir=tmp_path / "copy")
    with pytest.raises(DataError, match=f"part 'test' of .*copy holds '{first}' alone with a label of hardness"):
        open_data(config, 16, context)
