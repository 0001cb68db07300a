"""The server of the live view: whatever was published last, to any number of browsers.

Publishing hands over references and returns: pictures are drawn and encoded by the threads of those who watch, each
picture once for all of them.  A browser hears of every state by one stream of numbers and asks for the pictures that it
has time for: one that is slow skips some instead of falling behind, and any number of panels gets along with the six
connections that browsers open to one server.
"""

import dataclasses
import http.server
import json
import threading
import urllib.parse
from collections.abc import Mapping
from types import TracebackType
from typing import Any, ClassVar, Self

import cv2
import numpy as np

from sensors_io.viewer.page import PAGE
from sensors_io.viewer.panels import Panel

_QUALITY = 85  # of the pictures' JPEG; recordings are lossless, a view need not be
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
        return f"data: {json.dumps(tree)}\n\n".encode()

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
      host: 127.0.0.1 keeps the view on this machine; 0.0.0.0 shows it to the network, without any password.

    Raises:
      OSError: on entering, if the port is taken.
    """

    def __init__(self, *, port: int = 8765, host: str = "127.0.0.1"):
        self._wanted = (host, port)
        self._changed = threading.Condition()
        self._shown = PublishedState(0, {}, Numbers(title="touch", time_s=0.0, force_n=None, tables={}))
        self._version = 0
        self._ended = False
        self._server: http.server.ThreadingHTTPServer | None = None
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        """Address for browsers."""
        host, port = self._wanted if self._server is None else self._server.server_address[:2]
        return f"http://{host if isinstance(host, str) else host.decode()}:{port}/"

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
        self._server = http.server.ThreadingHTTPServer(self._wanted, handler)
        self._server.daemon_threads = True  # a watcher may be asleep on a dead connection
        self._thread = threading.Thread(target=self._server.serve_forever, name="live-view", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        assert self._server is not None
        assert self._thread is not None
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class _Handler(http.server.BaseHTTPRequestHandler):
    live: ClassVar[LiveView]
    protocol_version = "HTTP/1.1"  # keeps connections open: a browser asks for hundreds of pictures a second
    disable_nagle_algorithm = True  # a picture would wait 40 ms for the acknowledgement of its own header

    def do_GET(self) -> None:
        """Answer one request; the stream of numbers lasts until the browser or the view goes away."""
        path = urllib.parse.unquote(urllib.parse.urlsplit(self.path).path)
        try:
            if path == "/":
                self._whole("text/html; charset=utf-8", PAGE.encode())
            elif path == "/numbers":
                self._numbers()
            elif path.startswith("/panel/"):
                self._panel(path.removeprefix("/panel/"))
            else:
                self.send_error(404)
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True  # the browser was closed

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the terminal belongs to the session."""

    def _whole(self, kind: str, data: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
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


def _jpeg(name: str, picture: np.ndarray) -> bytes:
    ok, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not ok:
        raise ValueError(f"panel {name!r} is {picture.shape}: must be RGB uint8 [H, W, 3]; convert it")
    return data.tobytes()
