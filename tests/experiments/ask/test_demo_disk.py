"""The page of the demo, and a video for which there is no room: every request gets an answer."""

import errno
import socket
import tempfile
import tracemalloc
import urllib.error
import urllib.parse
import urllib.request
from types import SimpleNamespace

import pytest

from experiments.ask import demo


@pytest.fixture
def address(monkeypatch):
    """A server whose policy answers with the size of what it was asked about."""
    monkeypatch.setattr(demo.Demo, "answer", lambda self, source, sensor="": f"{source.stat().st_size} bytes")
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


def test_who_is_refused_sees_the_end_of_the_answer_at_once(address):
    """Though nothing more comes, and the connection could still carry something."""
    split = urllib.parse.urlsplit(address)
    with socket.create_connection((split.hostname, split.port), timeout=2) as connection:
        connection.sendall(b"POST /video HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n")
        assert b"".join(iter(lambda: connection.recv(65_536), b"")).startswith(b"HTTP/1.0 413 ")


def test_videos_that_come_are_not_in_memory(address):
    """Many clients at once would fill it."""
    split = urllib.parse.urlsplit(address)
    head = b"POST /video HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n"
    tracemalloc.start()
    clients = [socket.create_connection((split.hostname, split.port), timeout=10) for _ in range(4)]
    for client in clients:
        client.sendall(head % (2**24 + 1))
        client.sendall(bytes(2**24))
    assert tracemalloc.get_traced_memory()[1] < 4 * 2**23
    tracemalloc.stop()
    for client in clients:
        client.sendall(b"x")
        assert client.makefile("rb").read().endswith(b"\r\n%d bytes" % (2**24 + 1))
        client.close()


def test_a_video_that_is_cut_off_is_told_so(address):
    split = urllib.parse.urlsplit(address)
    with socket.create_connection((split.hostname, split.port), timeout=2) as connection:
        connection.sendall(b"POST /video HTTP/1.1\r\nHost: localhost\r\nContent-Length: 30\r\n\r\nabc")
        connection.shutdown(socket.SHUT_WR)
        answer = b"".join(iter(lambda: connection.recv(65_536), b""))
    assert answer.startswith(b"HTTP/1.0 400 ")
    assert answer.endswith(b"the video was cut off, 3 bytes of 30; send it again")
