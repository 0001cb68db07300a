"""The parts of a data set, and what is counted over them."""

import dataclasses

import numpy as np
import pytest

from experiments.study.dataset import PARTS, open_dataset, split_parts
from sensors_io.cards import replace_cards
from sensors_io.pipeline import ClipConfig
from sensors_io.records import RecordStore
from sensors_io.schema import SENSORS
from tests.sensors_io import fakes


def test_no_object_is_in_two_parts_and_no_contact_is_lost(data):
    objects = {part: set(data.object_ids[rows]) for part, rows in data.parts.items()}
    assert tuple(data.parts) == PARTS
    assert sum(map(len, objects.values())) == len(set.union(*objects.values())) == 16
    assert sorted(np.concatenate(list(data.parts.values()))) == list(range(len(data.store)))


def test_a_share_of_the_training_objects_is_kept_for_grpo_with_all_their_contacts(data, tmp_path):
    train = data.store.contacts_of_split("train")
    assert len(data.parts["grpo"]) == round(0.35 * len(train))
    assert set(data.parts["sft"]) | set(data.parts["grpo"]) == set(train)
    again = split_parts(data.store, 0.35)
    assert all(np.array_equal(again[part], data.parts[part]) for part in PARTS)
    store = RecordStore(fakes.write(tmp_path, contacts=16))  # two trials of each object
    parts = split_parts(store, 0.5)
    ids = {part: {store.contacts[i].object_id for i in rows} for part, rows in parts.items()}
    assert len(parts["grpo"]) == 4
    assert not ids["sft"] & ids["grpo"]
    shared = split_parts(store, None)
    np.testing.assert_array_equal(shared["grpo"], store.contacts_of_split("train"))
    np.testing.assert_array_equal(shared["sft"], shared["grpo"])


@pytest.mark.parametrize(
    ("contacts", "share", "part"), [(8, 0.0, "grpo"), (8, 1.0, "sft"), (4, 0.5, "val"), (6, 0.5, "test")]
)
def test_an_empty_part_is_refused(tmp_path, contacts, share, part):
    store = RecordStore(fakes.write(tmp_path, contacts))  # objects 0 and 1 train, 2 validate, 3 tests
    with pytest.raises(ValueError, match=f"part '{part}' .*more objects, another grpo_share .now {share}"):
        split_parts(store, share)


def test_records_without_labels_name_the_command_that_labels(tmp_path):
    path = fakes.write(tmp_path, contacts=8)
    cards = RecordStore(path).objects.values()
    replace_cards(path, [dataclasses.replace(card, labels={}) for card in cards])
    store = RecordStore(path)
    with pytest.raises(ValueError, match=r"none of the .* objects has a label: .* sensors_io label"):
        split_parts(store, 0.5)


def test_the_prior_is_that_of_training_labels_alone(data):
    label = np.array([[0, 2, -1, 8], [0, 1, -1, 8], [1, -1, -1, 0], [2, 2, 0, 1]], np.int32)
    parts = {"sft": np.array([0, 1]), "grpo": np.array([2]), "val": np.array([3]), "test": np.array([3])}
    prior = dataclasses.replace(data, label=label, parts=parts).prior()
    hand = np.zeros((4, 9))
    hand[0, :2] = 2 / 3, 1 / 3
    hand[1, 1:3] = 1 / 2, 1 / 2
    hand[2, :3] = 1 / 3  # annotated in validation alone: nobody knows
    hand[3, [0, 8]] = 1 / 3, 2 / 3
    assert prior.dtype == np.float32
    np.testing.assert_allclose(prior, hand, atol=1e-7)


def test_a_sensor_that_no_training_contact_has_is_named(tmp_path):
    """Objects 0 and 1 train; a policy has never seen what it is asked about by the second sensor."""
    with fakes.RecordWriter(tmp_path, meta=fakes.META) as writer:
        for n in range(4):
            writer.write_object(fakes.card(n))
            writer.write_contact([fakes.sequence(n, sensor) for sensor in SENSORS[: 2 if n == 3 else 1]])
    data = open_dataset(tmp_path, ClipConfig(), None)
    assert list(data.unlearned_sensors()) == ["xense: in 1 of 1 contacts of test, in none of training"]


def test_records_are_opened_with_their_own_sensors_labels_and_forces(tmp_path):
    path = fakes.write(tmp_path / "forces", contacts=8, sensors=SENSORS[:2])
    data = open_dataset(path, ClipConfig(sensors=SENSORS[:1]), 0.5)
    assert data.clip.sensors == data.store.meta.sensors
    assert data.label.tolist()[4:6] == [[2, 0, 1, 2]] * 2
    assert data.object_ids.tolist()[:3] == ["object_0", "object_0", "object_1"]
    assert data.has_force
    assert not data.visual_lies.any()  # unknown of recordings
    with fakes.RecordWriter(tmp_path / "bare", meta=fakes.META) as writer:
        for n in range(4):
            writer.write_object(fakes.card(n))
            writer.write_contact([fakes.sequence(n, force_n=None)])
    assert not open_dataset(tmp_path / "bare", ClipConfig(), 0.5).has_force
