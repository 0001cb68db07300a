"""A vendor's program of a Tac3D, as a socket."""

import socket
from collections.abc import Iterator

import pytest


@pytest.fixture
def vendor() -> Iterator[tuple[socket.socket, int]]:
    """A socket that sends to a free port, and that port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        sender.settimeout(5)
        sender.connect(("127.0.0.1", port))
        yield sender, port
