"""Generated scenes become records once, and an interrupted generation goes on."""

import json
import os
import signal
import subprocess
import sys

import pytest

from sensors_io import generate
from sensors_io.codec import encode_sequence
from sensors_io.locks import write_lock
from sensors_io.records import RecordStore
from sensors_io.scenes.config import SceneConfig
from tests.sensors_io import fakes


def test_all_contacts_are_written_once(tmp_path, monkeypatch):
    asked, seen, config = [], [], SceneConfig(objects=5, sites=1)

    def contacts(config, start, stop):
        asked.append(start)
        return ([fakes.sequence(i, "xense"), fakes.sequence(i, "tac3d")] for i in range(start, stop))

    monkeypatch.setattr(generate, "object_cards", lambda config: [fakes.card(n) for n in range(config.objects)])
    monkeypatch.setattr(generate, "contacts", contacts)
    generate.generate_records(config, tmp_path, progress=lambda *now: seen.append(now))
    store = RecordStore(tmp_path)
    assert [key.object_id for key in store.contacts] == [f"object_{n}" for n in range(5)]
    assert store.meta.notes["config"]["objects"] == 5
    assert seen == [(0, 5), (5, 5)]
    with write_lock(tmp_path):  # of a process that uses the same complete records
        generate.generate_records(config, tmp_path, progress=lambda *now: seen.append(now))
    assert seen[-2:] == [(5, 5), (5, 5)]
    assert asked == [0]


_CHILD = """
import dataclasses, json, os, pathlib, signal, sys, types
from tests.sensors_io import fakes

@dataclasses.dataclass(frozen=True)
class SceneConfig:
    contact_count: int = 7
    frame_count: int = 8

cards, config, protocol = (types.ModuleType(f"sensors_io.scenes.{name}") for name in ("cards", "config", "protocol"))
config.SceneConfig, config.config_hash = SceneConfig, str
cards.object_cards = lambda config: [fakes.card(n) for n in range(config.contact_count)]
protocol.contacts = lambda config, start, stop: (
    [fakes.sequence(i, "xense"), fakes.sequence(i, "tac3d")] for i in range(start, stop)
)
for module in (cards, config, protocol):  # without JAX, which takes seconds to import
    sys.modules[module.__name__] = module
from sensors_io import generate, index, shards

seen = 0

def die(at):
    global seen
    seen += at == place
    if seen == count:
        os.kill(os.getpid(), signal.SIGKILL)

def killing(owner, name, before, after):
    method = getattr(owner, name)
    def call(*args, **kwargs):
        die(before)
        result = method(*args, **kwargs)
        die(after)
        return result
    setattr(owner, name, call)

killing(shards.ShardWriter, "write", "before write", "after write")
killing(shards.ShardWriter, "publish", "before publish", "after publish")
killing(index.Index, "write", "before index", "after index")
killing(os, "fsync", "before sync", "after sync")
for line in sys.stdin:
    child = os.fork()
    if not child:
        out, place, count = json.loads(line)
        generate.generate_records(SceneConfig(), pathlib.Path(out), records_per_shard=64)
        os._exit(0)
    print(os.waitpid(child, 0)[1], flush=True)
"""
"""Generates in one fork after the other, each killed at a given place."""


@pytest.fixture
def generated():
    """How a generation into a folder ends that is killed when it comes to a place for the nth time."""
    command = [sys.executable, "-c", _CHILD]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:

        def ends(out, place="nowhere", count=1):
            print(json.dumps([str(out), place, count]), file=process.stdin, flush=True)
            return os.waitstatus_to_exitcode(int(process.stdout.readline()))

        yield ends
        process.stdin.close()


@pytest.mark.long
def test_kill_9_at_five_places_changes_no_byte(tmp_path, generated):
    """Inside a shard, before and after it is published, inside the index, after it: the files come out the same."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert generated(whole) == 0
    places = [("after write", 10), ("before publish", 2), ("after publish", 2), ("before sync", 4), ("after index", 1)]
    for place, count in places:
        assert generated(killed, place, count) == -signal.SIGKILL, place
        assert not (killed / "index.json").exists() or not RecordStore(killed, allow_incomplete=True).complete
    assert generated(killed) == 0
    assert RecordStore(killed).contacts == RecordStore(whole).contacts
    for i in range(len(RecordStore(whole))):
        for sensor, sequence in RecordStore(whole).contact(i).items():
            assert encode_sequence(RecordStore(killed).contact(i)[sensor]) == encode_sequence(sequence)
    names = sorted(f.name for f in whole.glob("contacts-*"))
    assert names == sorted(f.name for f in killed.glob("contacts-*"))
    for name in names:
        assert (killed / name).read_bytes() == (whole / name).read_bytes()
