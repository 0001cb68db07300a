"""Records at a URL are those that were pushed: through a bounded cache, over failures, and never half-written."""

import errno
import hashlib
import os
import pathlib
import threading

import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from sensors_io import remote
from sensors_io.__main__ import main
from sensors_io.contents import put_rest_pictures, rest_pictures
from sensors_io.records import CorruptRecordsError, RecordsError, RecordStore, RecordWriter
from sensors_io.remote import Mirror, StoreError, place
from tests.sensors_io import fakes
from tests.sensors_io.checks import refused

URL = "memory://bucket/records"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of its own, an empty store, and no waiting."""
    monkeypatch.setenv(remote.CACHE, str(tmp_path / "cache"))
    monkeypatch.setattr(remote.time, "sleep", lambda wait_s: None)
    store = fsspec.filesystem("memory")
    store.store.clear()
    yield tmp_path / "cache"
    store.store.clear()
    store.pseudo_dirs[1:] = []  # folders, but for the root


@pytest.fixture
def records(tmp_path):
    return fakes.write(tmp_path / "records", 7, per_shard=2)


def same(left: RecordStore, right: RecordStore) -> bool:
    for i in range(len(left)):
        for sensor, sequence in left.contact(i).items():
            np.testing.assert_array_equal(sequence.flags, right.contact(i)[sensor].flags)
            np.testing.assert_array_equal(sequence.depth_mm, right.contact(i)[sensor].depth_mm)
    return left.contacts == right.contacts and list(left.objects) == list(right.objects)


def test_records_at_a_url_are_those_that_were_pushed(records, cache):
    assert main(["push", str(records), URL]) == 0
    there = RecordStore(URL)
    assert same(RecordStore(records), there)
    assert str(there.path) == URL
    assert RecordStore(pathlib.Path(URL)).digest == there.digest == RecordStore(records).digest  # as an option's value


def test_gels_at_rest_are_pushed_too(records):
    """Sequences name them, and `check` and `extract` read them."""
    put_rest_pictures(records, {"rest.png": b"a picture"})
    assert main(["push", str(records), URL]) == 0
    assert rest_pictures(Mirror(URL)) == {"rest.png": b"a picture"}


def test_a_second_push_sends_what_is_new(records, monkeypatch):
    find = MemoryFileSystem.find

    def tagged(self, path, **options):
        of = lambda name: f'"{hashlib.md5(self.cat_file(name)).hexdigest()}"'
        return {name: {**about, "ETag": of(name)} for name, about in find(self, path, **options).items()}

    monkeypatch.setattr(MemoryFileSystem, "find", tagged)
    assert main(["push", str(records), URL]) == 0
    before = {name: bytes(file.getvalue()) for name, file in fsspec.filesystem("memory").store.items()}
    with RecordWriter(records, meta=fakes.META, resume=True) as writer:
        writer.write_object(fakes.card(9))
        writer.write_contact([fakes.sequence(9)])
    assert (
        Mirror(URL).publish(records, [*RecordStore(records).files, "index.json"]) < sum(map(len, before.values())) / 2
    )
    after = {name: bytes(file.getvalue()) for name, file in fsspec.filesystem("memory").store.items()}
    assert all(after[name] == data for name, data in before.items() if name.endswith(".arrayrecord"))
    assert same(RecordStore(records), RecordStore(URL))


def test_a_copy_has_the_files_of_folders_and_of_a_single_file_nothing(tmp_path):
    fsspec.filesystem("memory").pipe("/bucket/tree/a/b", b"1")
    Mirror("memory://bucket/tree").copy(tmp_path)
    assert (tmp_path / "a" / "b").read_bytes() == b"1"
    assert Mirror("memory://bucket/tree/a/b").files() == {}


@pytest.mark.parametrize("shards", [3, 0.1])
def test_the_cache_keeps_within_its_bound_and_removes_its_own_copies_alone(records, cache, monkeypatch, shards):
    """Files of the user, folders and downloads of other processes stay, however old and large they are."""
    assert main(["push", str(records), URL]) == 0
    (cache / "photos").mkdir(parents=True)
    others = [cache / "thesis.tex", cache / "photos" / "gel.png", cache / f".{'0' * 24}-index.json.tmp"]
    for path in others:
        path.write_bytes(bytes(10**5))
        os.utime(path, (1, 1))
    largest = max(path.stat().st_size for path in records.glob("contacts-*.arrayrecord"))
    monkeypatch.setenv(remote.CACHE_GB, f"{shards * largest / 1e9:.9f}")
    monkeypatch.setattr("sensors_io.shards._OPEN", 1)
    store = RecordStore(URL)
    for i in [*range(7), *range(7)]:
        assert store.contact(i)["xense"].key == store.contacts[i]
        own = [path for path in cache.iterdir() if path.is_file() and path not in others]
        assert sum(path.stat().st_size for path in own) <= max(shards, 1) * largest
    assert all(path.stat().st_size == 10**5 for path in others)


def test_a_copy_that_another_process_removes_is_made_again(records, cache, monkeypatch):
    assert main(["push", str(records), URL]) == 0
    removed, touch = [], os.utime

    def late(path, *times):
        if not removed:
            removed.append(pathlib.Path(path).unlink())
        touch(path, *times)

    monkeypatch.setattr(remote.os, "utime", late)
    assert Mirror(URL).fetch("index.json").read_bytes() == (records / "index.json").read_bytes()
    assert removed


def test_a_cache_that_cannot_be_written_is_named_and_no_credentials(records, tmp_path, monkeypatch):
    assert main(["push", str(records), URL]) == 0

    def denied(path, *args, **kwargs):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setenv(remote.CACHE, str(tmp_path / "locked"))
    monkeypatch.setattr(pathlib.Path, "mkdir", denied)
    refused(StoreError, "locked cannot be written .* set TOUCHR1_CACHE", lambda: Mirror(URL).fetch("index.json"))


def test_what_was_replaced_at_the_url_is_read_anew(records, tmp_path):
    assert main(["push", str(records), URL]) == 0
    assert len(RecordStore(URL)) == 7
    fsspec.filesystem("memory").rm("/bucket/records", recursive=True)
    assert main(["push", str(fakes.write(tmp_path / "other", 3)), URL]) == 0
    assert len(RecordStore(URL)) == 3
    assert same(RecordStore(tmp_path / "other"), RecordStore(URL))


class Failing:
    """A store of which a call in `every` fails, or all do."""

    def __init__(self, store, every, error):
        self._store, self._every, self._error, self.calls = store, every, error, 0

    def __getattr__(self, name):
        method = getattr(self._store, name)

        def call(*args, **kwargs):
            self.calls += 1
            if self.calls % self._every == 0:
                raise self._error
            return method(*args, **kwargs)

        return call


@pytest.fixture
def failing(monkeypatch):
    def fail(every, error):
        found = fsspec.filesystem
        monkeypatch.setattr(remote.fsspec, "filesystem", lambda *a, **k: Failing(found(*a, **k), every, error))

    return fail


def test_failures_that_pass_change_nothing(records, failing, caplog):
    failing(3, OSError("SlowDown"))
    assert main(["push", str(records), URL]) == 0
    assert same(RecordStore(records), RecordStore(URL))
    assert {line.partition(": ")[2] for line in caplog.messages} == {"OSError: SlowDown; trying again in 0.1 s"}


def test_shards_are_copied_ahead_in_the_order_of_reading(records, monkeypatch):
    """Of a data set that the cache holds; of another, what fits."""
    assert main(["push", str(records), URL]) == 0
    asked: list[str] = []
    fetch = Mirror.fetch
    monkeypatch.setattr(Mirror, "fetch", lambda self, name, size=None: asked.append(name) or fetch(self, name, size))
    monkeypatch.setattr(remote, "_AHEAD", 1)
    whole, store = ["contacts-00003.arrayrecord", "contacts-00000.arrayrecord"], RecordStore(URL)
    for most_gb, expected in (("50", whole), ("1e-9", [])):
        monkeypatch.setenv(remote.CACHE_GB, most_gb)
        store = RecordStore(URL)
        asked.clear()
        store.fetch_ahead([6, 0, 1])
        join()
        assert asked == expected
    RecordStore(records).fetch_ahead([6])  # on this machine there is nothing to copy


def join() -> None:
    for thread in set(threading.enumerate()) - {threading.current_thread()}:
        if thread.name.endswith("(work)"):
            thread.join()


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            OSError("SlowDown"),
            "OSError: SlowDown, 6 times: wait until the store answers and has room, and run the same command again",
        ),
        (
            OSError(errno.ENOSPC, "No space left on device"),
            "finds no room .*No space left on device.: free some space in the cache",
        ),
        (PermissionError("Forbidden"), "is refused .Forbidden.: correct the credentials"),
        (FileNotFoundError("NoSuchBucket"), "is not there .NoSuchBucket.: correct the URL, or make the bucket"),
        (
            type("NoCredentialsError", (Exception,), {})("none found"),
            "is refused .none found.: set the credentials of this store",
        ),
    ],
    ids=["fails", "full", "refuses", "bucket", "credentials"],
)
def test_a_store_that_fails_is_named(records, failing, error, message):
    failing(1, error)
    refused(StoreError, message, lambda: RecordStore(URL))
    refused(StoreError, message, lambda: Mirror(URL).publish(records, ["index.json"]))


def test_an_interrupted_push_shows_nothing_and_goes_on(records, monkeypatch, capsys):
    put = Mirror.publish

    def publish(self, folder, names):
        put(self, folder, names[:2])
        raise KeyboardInterrupt

    monkeypatch.setattr(Mirror, "publish", publish)
    assert main(["push", str(records), URL]) == 130
    refused(StoreError, f"{URL}/index.json is not there .*correct the URL", lambda: RecordStore(URL))
    monkeypatch.setattr(Mirror, "publish", put)
    assert main(["push", str(records), URL]) == 0
    assert same(RecordStore(records), RecordStore(URL))


def test_damage_at_the_url_is_named(records):
    assert main(["push", str(records), URL]) == 0
    store = fsspec.filesystem("memory")
    store.pipe_file("/bucket/records/contacts-00001.arrayrecord", b"short")
    refused(StoreError, "contacts-00001.arrayrecord has 5 bytes where .* upload it again", RecordStore(URL).contact, 2)
    store.rm_file("/bucket/records/contacts-00001.arrayrecord")
    refused(StoreError, "contacts-00001.arrayrecord is not there", RecordStore(URL).contact, 2)
    store.pipe_file("/bucket/records/index.contacts", b"\0" * (records / "index.contacts").stat().st_size)
    refused(CorruptRecordsError, "its checksum does not hold", lambda: RecordStore(URL))


def test_records_are_not_written_to_a_url(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for path in (URL, pathlib.Path(URL)):
        refused(RecordsError, "is a URL: records are written to a folder, then `push`", fakes.write, path)
    assert not list(tmp_path.glob("memory*"))


@pytest.mark.parametrize(
    ("cache", "size", "url", "message"),
    [
        ("c", "1", "nowhere://x", r"nowhere://x cannot be opened .*pip install 'touchr1-jax\[cloud\]'"),
        *(("c", "1", url, f"{url} cannot be opened") for url in ("reference://x", "dir://x")),
        *(("c", n, URL, f"CACHE_GB is '{n}': must be a number of gigabytes") for n in ("much", "nan", "inf", "-1")),
        ("~nobody-of-that-name/x", "1", URL, "TOUCHR1_CACHE is '~nobody-of-that-name/x'"),
    ],
)
def test_what_cannot_be_a_store_or_its_cache_is_named(monkeypatch, cache, size, url, message):
    monkeypatch.setenv(remote.CACHE, cache)
    monkeypatch.setenv(remote.CACHE_GB, size)
    refused(StoreError, message, lambda: Mirror(url))


@pytest.mark.parametrize("path", ["a/b:c", "/a"])
def test_a_path_is_no_url(path):
    assert place(path) == pathlib.Path(path)


def test_records_at_a_url_cannot_be_pushed(capsys):
    assert main(["push", "memory://a/b", "memory://c/d"]) == 1
    assert "must be a folder on this machine" in capsys.readouterr().err


def test_a_path_of_this_machine_begins_at_its_root(records, tmp_path, monkeypatch):
    """Whatever folder the command runs in, and with one slash, which a path makes of three."""
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    url = f"file://{tmp_path}/pushed"
    assert main(["push", str(records), url]) == 0
    assert (tmp_path / "pushed" / "index.json").is_file()
    assert not list((tmp_path / "elsewhere").iterdir())
    assert len(RecordStore(f"file:{tmp_path}/pushed")) == len(RecordStore(records))
