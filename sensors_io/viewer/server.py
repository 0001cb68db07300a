"""The server of the live view: whatever was published last, to any number of browsers."""

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

_QUALITY = 85  # of the pictures' JPEG; recordings are lossless, a view need not be
_BOUNDARY = "frame"
_WAIT_S = 1.0  # how long a stream that has nothing new waits before it looks whether the view has ended


@dataclasses.dataclass(frozen=True, kw_only=True)
class Numbers:
    """What stands beside the pictures.

    Args:
      title: of the page.
      time_s: of the sample.
      force_n: [3], `None` where none is measured.
      numbers: names and values to be listed, as text.
      alarm: what is wrong; empty if nothing is.
    """

    title: str
    time_s: float
    force_n: tuple[float, float, float] | None
    numbers: Mapping[str, str]
    alarm: str = ""


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
        self._version = 0
        self._pictures: dict[str, np.ndarray] = {}
        self._numbers: dict[str, Any] = {}
        self._ended = False
        self._server: http.server.ThreadingHTTPServer | None = None
        self._thread: threading.Thread | None = None

    @property
    def address(self) -> str:
        """Where browsers find it."""
        host, port = self._wanted if self._server is None else self._server.server_address[:2]
        return f"http://{host if isinstance(host, str) else host.decode()}:{port}/"

    def publish(self, pictures: Mapping[str, np.ndarray], numbers: Numbers) -> None:
        """Show these pictures (RGB uint8 [H, W, 3] by name) and numbers from now on; watchers encode them."""
        with self._changed:
            self._pictures = dict(pictures)
            self._numbers = dataclasses.asdict(numbers) | {"panels": list(pictures)}
            self._version += 1
            self._changed.notify_all()

    def wait(self, seen: int) -> tuple[int, dict[str, np.ndarray], dict[str, Any]] | None:
        """What was published after version `seen`, with its version; `None` when the view has ended."""
        with self._changed:
            while self._version == seen and not self._ended:
                self._changed.wait(_WAIT_S)
            return None if self._ended else (self._version, self._pictures, self._numbers)

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

    def do_GET(self) -> None:
        """Answer one request; streams last until the browser or the view goes away."""
        path = urllib.parse.unquote(self.path)
        try:
            if path == "/":
                self._begin("text/html; charset=utf-8")
                self.wfile.write(PAGE.encode())
            elif path == "/numbers":
                self._begin("text/event-stream")
                self._stream(self._event)
            elif path.startswith("/panel/"):
                self._begin(f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
                self._stream(lambda pictures, _: self._picture(pictures, path.removeprefix("/panel/")))
            else:
                self.send_error(404)
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True  # the browser was closed

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the terminal belongs to the session."""

    def _begin(self, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()

    def _stream(self, encode: Any) -> None:
        version = 0
        while (news := self.live.wait(version)) is not None:
            version, pictures, numbers = news
            if data := encode(pictures, numbers):
                self.wfile.write(data)
                self.wfile.flush()

    @staticmethod
    def _event(pictures: Mapping[str, np.ndarray], numbers: Mapping[str, Any]) -> bytes:
        return f"data: {json.dumps(numbers)}\n\n".encode()

    @staticmethod
    def _picture(pictures: Mapping[str, np.ndarray], name: str) -> bytes:
        if name not in pictures:
            return b""
        ok, data = cv2.imencode(
            ".jpg", cv2.cvtColor(pictures[name], cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        )
        if not ok:
            raise ValueError(f"panel {name!r} is {pictures[name].shape}: must be RGB uint8 [H, W, 3]; convert it")
        head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
        return head.encode() + data.tobytes() + b"\r\n"
