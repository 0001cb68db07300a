"""The page of the demo, and a video for which there is no room: every request gets an answer."""

import errno
import tempfile
import urllib.error
import urllib.request
from types import SimpleNamespace

import pytest

from experiments.ask import demo


@pytest.fixture
def address(monkeypatch):
    """A server whose policy answers with the size of what it was asked about."""
    monkeypatch.setattr(demo.Demo, "answer", lambda self, source, sensor="": f"{len(source.read_bytes())} bytes")
    with demo.demo_server(SimpleNamespace(), 0) as address:
        yield address


def post(address, body):
    try:
        with urllib.request.urlopen(f"{address}video?name=press.mp4", data=body, timeout=10) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_a_video_that_finds_no_room_is_answered(address, monkeypatch):
    assert post(address, b"abc") == (200, "3 bytes")

    def full(*args, **options):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(tempfile, "TemporaryDirectory", full)
        status, said = post(address, b"abc")
    assert status == 507
    assert said == (
        "the video could not be kept ([Errno 28] No space left on device): free some space in TMPDIR of the program"
    )
    assert post(address, b"abcd") == (200, "4 bytes")


def test_who_sends_too_large_a_video_is_told(address, monkeypatch):
    """The answer must not be lost with a connection that is closed while the video still comes."""
    monkeypatch.setattr(demo, "MOST_BYTES", 2**20)
    assert post(address, bytes(2**24)) == (413, "a video of at most 1 MB is expected")
    assert post(address, b"abc") == (200, "3 bytes")
