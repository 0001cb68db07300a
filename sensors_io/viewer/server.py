"""The server of the live view: whatever was published last, to any number of browsers.

Publishing hands over references and returns: pictures are drawn and encoded by the threads of those who watch, each
picture once for all of them.  A browser hears of every state by one stream of numbers and asks for the pictures that it
has time for: one that is slow skips some instead of falling behind, and any number of panels gets along with the six
connections that browsers open to one server.
"""

import contextlib
import dataclasses
import errno
import http.server
import ipaddress
import json
import math
import secrets
import socket
import sys
import threading
import urllib.parse
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import cv2
import numpy as np

from sensors_io.viewer.page import PAGE
from sensors_io.viewer.panels import Panel

_QUALITY = 85  # of the pictures' JPEG; recordings are lossless, a view need not be
_CONNECTIONS = 64
"""Open at once: ten browsers with their six, and what is half open; more get an error and are closed at once."""
_FULL = f"{_CONNECTIONS} connections are open, and no more are served: close other tabs of this page, and load it again"
_SILENT_S = 10.0  # a connection that sends or takes nothing for so long is closed
_WAIT_S = 1.0  # how long a stream that has nothing new waits before it looks whether the view has ended


@dataclasses.dataclass(frozen=True, kw_only=True)
class Numbers:
    """Numbers shown next to the pictures.

    Args:
      title: of the page.
      time_s: of the sample.
      force_n: [3], `None` where none is measured.
      tables: names and values to be listed, as text, by heading.
      captions: below the pictures, by panel.
      alarm: what is wrong; empty if nothing is.
      prompt: to the hand, while something is recorded.
    """

    title: str
    time_s: float
    force_n: tuple[float, float, float] | None
    tables: Mapping[str, Mapping[str, str]]
    captions: Mapping[str, str] = dataclasses.field(default_factory=dict)
    alarm: str = ""
    prompt: str = ""


class PublishedState:
    """One published state; each picture is drawn and encoded once, when it is first asked for."""

    def __init__(self, version: int, panels: Mapping[str, Panel], numbers: Numbers):
        self.version = version
        self._panels = panels
        self._numbers = numbers
        self._encoded: dict[str, bytes] = {}
        self._lock = threading.Lock()

    def event(self) -> bytes:
        """The numbers as a server-sent event."""
        tree = dataclasses.asdict(self._numbers) | {"panels": list(self._panels), "version": self.version}
        return f"data: {json.dumps(_finite(tree), allow_nan=False)}\n\n".encode()

    def picture(self, name: str) -> bytes:
        """A panel as JPEG.

        Raises:
          KeyError: there is no such panel.
        """
        with self._lock:
            if name not in self._encoded:
                self._encoded[name] = _jpeg(name, self._panels[name]())
            return self._encoded[name]


class LiveView:
    """Serves a page with live pictures and numbers, as a context manager.

    Args:
      port: of the server; 0 takes a free one, see `address`.
      host: 127.0.0.1 keeps the view on this machine; any other shows it to the network, to those who know the token in
        `address`.

    Raises:
      OSError: on entering, if the port is taken.
    """

    def __init__(self, *, port: int = 8765, host: str = "127.0.0.1"):
        self._wanted = (host, port)
        self._token = "" if is_loopback(host) else secrets.token_urlsafe(16)
        self._changed = threading.Condition()
        self._shown = PublishedState(0, {}, Numbers(title="touch", time_s=0.0, force_n=None, tables={}))
        self._version = 0
        self._ended = False
        self._server: http.server.ThreadingHTTPServer | None = None
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        """Address for browsers, with the token if one is needed."""
        host = self._wanted[0]
        shown = f"[{host}]" if ":" in host else host
        return f"http://{shown}:{self._port}/" + (f"?token={self._token}" if self._token else "")

    @property
    def _port(self) -> int:
        return int((self._wanted if self._server is None else self._server.server_address)[1])

    @property
    def cookie(self) -> str:
        """Name of the cookie by which a browser shows the token again: it has one jar for all ports of a machine."""
        return f"token-{self._port}"

    @property
    def set_cookie(self) -> str:
        """The cookie, for a browser that was admitted; empty where none is needed."""
        return f"{self.cookie}={self._token}; HttpOnly; SameSite=Strict" if self._token else ""

    def admits(self, host: str, token: str) -> bool:
        """True if a request may be answered: it names this machine, so that no other page can ask, or has the token."""
        if self._token:
            return secrets.compare_digest(token.encode(), self._token.encode())
        return names_this_machine(host)

    def publish(self, panels: Mapping[str, Panel], numbers: Numbers) -> None:
        """Show these panels and numbers from now on; returns at once, and nothing is drawn that nobody watches."""
        with self._changed:
            self._version += 1
            self._shown = PublishedState(self._version, dict(panels), numbers)
            self._changed.notify_all()

    @property
    def shown(self) -> PublishedState:
        """The last published state."""
        with self._changed:
            return self._shown

    def wait(self, seen: int) -> PublishedState | None:
        """The state published after version `seen`; `None` when the view has ended."""
        with self._changed:
            while self._version == seen and not self._ended:
                self._changed.wait(_WAIT_S)
            return None if self._ended else self._shown

    def __enter__(self) -> Self:
        handler = type("Handler", (_Handler,), {"live": self})
        self._server = LimitedServer(self._wanted, handler)
        self._server.daemon_threads = True  # a watcher may be asleep on a dead connection
        self._thread = threading.Thread(target=self._server.serve_forever, name="live-view", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        assert self._server is not None
        assert self._thread is not None
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class LimitedServer(http.server.ThreadingHTTPServer):
    """A thread for each connection, of which there are so many at most.

    Args:
      address: host and port to serve at.
      handler: of requests.

    Raises:
      OSError: the port is taken, or may not be.
    """

    request_queue_size = _CONNECTIONS

    def __init__(self, address: tuple[str, int], handler: type[http.server.BaseHTTPRequestHandler]):
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        try:
            super().__init__(address, handler)
        except OSError as error:
            reason = f"{error.strerror}: {address[0]}:{address[1]}; name another --port, or 0 for a free one"
            if error.errno == errno.EADDRNOTAVAIL or isinstance(error, socket.gaierror):
                reason = f"{error.strerror}: {address[0]}; must be an address of this machine, such as 127.0.0.1 or ::1"
            raise OSError(error.errno, reason) from error
        self._free = threading.Semaphore(_CONNECTIONS)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Refuse a connection too many instead of giving it a thread."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
            return
        kept = f"Content-Type: text/plain; charset=utf-8\r\nContent-Length: {len(_FULL)}\r\nConnection: close"
        with contextlib.suppress(OSError):
            request.sendall(f"HTTP/1.1 503 Service Unavailable\r\n{kept}\r\n\r\n{_FULL}".encode())
        self.shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a connection that the other side broke off."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve one connection to its end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()


class _Handler(http.server.BaseHTTPRequestHandler):
    live: ClassVar[LiveView]
    timeout = _SILENT_S
    protocol_version = "HTTP/1.1"  # keeps connections open: a browser asks for hundreds of pictures a second
    disable_nagle_algorithm = True  # a picture would wait 40 ms for the acknowledgement of its own header

    def do_GET(self) -> None:
        """Answer one request; the stream of numbers lasts until the browser or the view goes away."""
        split = split_target(self.path)
        path = urllib.parse.unquote(split.path)
        token = urllib.parse.parse_qs(split.query).get("token", [self._cookie()])[0]
        if not self.live.admits(self.headers.get("Host", ""), token):
            self.send_error(403, "open the address that the program printed")
        elif path == "/":
            self._whole("text/html; charset=utf-8", PAGE.encode(), self.live.set_cookie)
        elif path == "/numbers":
            self._numbers()
        elif path.startswith("/panel/"):
            self._panel(path.removeprefix("/panel/"))
        else:
            self.send_error(404)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the terminal belongs to the session."""

    def _cookie(self) -> str:
        """The token that the page was opened with, among cookies of whatever else this machine serves."""
        pairs = (pair.strip().partition("=") for pair in self.headers.get("Cookie", "").split(";"))
        return next((value for name, _, value in pairs if name == self.live.cookie), "")

    def _whole(self, kind: str, data: bytes, cookie: str = "") -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        if cookie:
            self.send_header("Set-Cookie", cookie)
        self.end_headers()
        self.wfile.write(data)

    def _panel(self, name: str) -> None:
        try:
            data = self.live.shown.picture(name)
        except KeyError:
            self.send_error(404, "no such panel")
        else:
            self._whole("image/jpeg", data)

    def _numbers(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Cache-Control", "no-store")
        self.send_header("Connection", "close")
        self.end_headers()
        version = 0
        while (shown := self.live.wait(version)) is not None:
            version = shown.version
            self.wfile.write(shown.event())
            self.wfile.flush()


def names_this_machine(host: str) -> bool:
    """True if the `Host` of a request names this machine, so that no page of another name can ask through a browser."""
    return is_loopback(split_target(f"//{host}").hostname or "")


def split_target(target: str) -> urllib.parse.SplitResult:
    """The parts of an address; those of an empty one, which is nowhere, where it is none."""
    try:
        return urllib.parse.urlsplit(target)
    except ValueError:
        return urllib.parse.urlsplit("")


def is_loopback(host: str) -> bool:
    """True of the names and addresses by which a machine reaches itself alone."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _finite(tree: Any) -> Any:
    """The tree with `None` for numbers that JSON does not know."""
    if isinstance(tree, float):
        return tree if math.isfinite(tree) else None
    if isinstance(tree, dict):
        return {name: _finite(value) for name, value in tree.items()}
    return [_finite(value) for value in tree] if isinstance(tree, list | tuple) else tree


def _jpeg(name: str, picture: np.ndarray) -> bytes:
    ok, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not ok:
        raise ValueError(f"panel {name!r} is {picture.shape}: must be RGB uint8 [H, W, 3]; convert it")
    return data.tobytes()
