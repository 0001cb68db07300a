"""Generated scenes become records once, and an interrupted generation goes on."""

import pytest

from sensors_io import generate
from sensors_io.records import IncompleteRecordsError, RecordsExistError, RecordStore
from sensors_io.scenes import SceneConfig
from tests.sensors_io import fakes


@pytest.fixture
def asked(monkeypatch):
    """Fake scenes, and the start of every generation."""
    starts = []

    def contacts(config, start=0):
        starts.append(start)
        return ([fakes.sequence(i, "xense"), fakes.sequence(i, "tac3d")] for i in range(start, config.contact_count))

    monkeypatch.setattr(generate, "object_cards", lambda config: [fakes.card(n) for n in range(config.objects)])
    monkeypatch.setattr(generate, "contacts", contacts)
    monkeypatch.setattr(generate, "CONTACTS_PER_SHARD", 2)
    return starts


CONFIG = SceneConfig(objects=5, sites=1)


def test_all_contacts_are_written_once(tmp_path, asked):
    seen = []
    generate.generate_records(CONFIG, tmp_path, progress=lambda *now: seen.append(now))
    store = RecordStore(tmp_path)
    assert [key.object_id for key in store.contacts] == [f"object_{n}" for n in range(5)]
    assert store.meta.notes["config"]["objects"] == 5
    assert seen == [(n, 5) for n in range(6)]
    generate.generate_records(CONFIG, tmp_path)
    assert asked == [0, 5]
    assert len(RecordStore(tmp_path)) == 5


def test_an_interrupted_generation_goes_on(tmp_path, asked):
    def stop(done, total):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate.generate_records(CONFIG, tmp_path, progress=stop)
    with pytest.raises(IncompleteRecordsError):
        RecordStore(tmp_path)
    generate.generate_records(CONFIG, tmp_path)
    assert asked == [0, 3]
    assert [key.object_id for key in RecordStore(tmp_path).contacts] == [f"object_{n}" for n in range(5)]


def test_another_config_does_not_mix_in(tmp_path, asked):
    generate.generate_records(CONFIG, tmp_path)
    with pytest.raises(RecordsExistError, match="was made by config"):
        generate.generate_records(SceneConfig(objects=5, sites=1, seed=1), tmp_path)
