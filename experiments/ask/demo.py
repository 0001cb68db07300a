"""A page in the browser where one touches an object, or drops a video, and sees what a policy answers."""

import contextlib
import http.server
import re
import socket
import tempfile
import threading
import urllib.parse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

from experiments.ask.answers import ask_policy
from experiments.ask.inputs import GENERATED, read_touch
from experiments.ask.page import answered_part
from experiments.core.errors import DataError
from experiments.core.report import ENVIRONMENT
from sensors_io.errors import UserError
from sensors_io.viewer.server import LimitedServer, names_this_machine, split_target
from touchr1_jax.asking import AskablePolicy
from touchr1_jax.text.plain_questions import QuestionError

MOST_BYTES = 200 * 2**20
"""Size of a video that is taken."""

PART_BYTES = 2**20
"""So much of a video is in memory while it comes."""

SILENT_S = 30.0
"""A connection that sends nothing for so long is closed."""


class Demo:
    """A policy and the questions that the page asks of it, one at a time."""

    def __init__(self, policy: AskablePolicy) -> None:
        self.policy = policy
        self._lock = threading.Lock()

    def page(self) -> str:
        """The page before anything was asked."""
        saved = self.policy.saved
        values = {"attributes": self.policy.attributes, "sensors": saved.sensors}
        return ENVIRONMENT.get_template("demo.jinja").render(policy=saved.notes.get("name", self.policy.name), **values)

    def answer(self, source: str | Path, sensor: str = "") -> str:
        """All answers about an input as a part of the page.

        Raises:
          DataError, QuestionError: an input that cannot be read.
        """
        with self._lock:
            return answered_part(ask_policy(self.policy, [read_touch(source, self.policy.saved, sensor)]))


class DemoHandler(http.server.BaseHTTPRequestHandler):
    """Requests of the page; others are refused, as are those of other pages."""

    demo: ClassVar[Demo]
    timeout = SILENT_S

    def do_GET(self) -> None:
        """The page, or the answers about a generated object."""
        split = split_target(self.path)
        words = urllib.parse.parse_qs(split.query).get("words", [""])[0]
        if not self._admitted():
            return
        if split.path == "/":
            self._reply(self.demo.page())
        elif split.path == "/generated":
            self._answer(lambda: self.demo.answer(f"{GENERATED}:{words}"))
        else:
            self.send_error(404)

    def do_POST(self) -> None:
        """The answers about a video, which is the body of the request."""
        split = split_target(self.path)
        asked = {name: values[0] for name, values in urllib.parse.parse_qs(split.query).items()}
        if not self._admitted():
            return
        length = self.headers.get("Content-Length", "")
        if split.path != "/video" or not re.fullmatch("[0-9]{1,12}", length) or int(length) > MOST_BYTES:
            self._reply(f"a video of at most {MOST_BYTES // 2**20} MB is expected", status=413)
            self._take_rest()
            return
        suffix = re.search(r"\.[A-Za-z0-9]{1,7}$", asked.get("name", ""))
        self._answer(lambda: self._of_video(int(length), suffix[0] if suffix else "", asked.get("sensor", "")))

    def log_message(self, format: str, *args: object) -> None:
        """Keep the terminal free."""

    def _admitted(self) -> bool:
        """True for requests of this page: its host is this machine, and so is the origin of what is sent."""
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        if names_this_machine(host) and origin in (None, f"http://{host}"):
            return True
        self.send_error(403, "open the address that the program printed")
        return False

    def _of_video(self, length: int, suffix: str, sensor: str) -> str:
        """The answers about the next `length` bytes, which go to a file as they come: memory holds a part of them."""
        with tempfile.TemporaryDirectory() as home:
            path, left = Path(home) / f"video{suffix}", length
            with path.open("wb") as file:
                while left and (part := self.rfile.read(min(left, PART_BYTES))):
                    file.write(part)
                    left -= len(part)
            if left:
                raise DataError(f"the video was cut off, {length - left} bytes of {length}; send it again")
            return self.demo.answer(path, sensor)

    def _take_rest(self) -> None:
        """End the answer, then take what still comes: to close meanwhile would reset the connection, and lose it."""
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_WR)
            while self.rfile.read1(PART_BYTES):
                pass

    def _answer(self, answer: Callable[[], str]) -> None:
        try:
            text, status = answer(), 200
        except (UserError, QuestionError) as error:
            text, status = str(error), 400
        except TimeoutError:
            text, status = f"nothing came of the video for {SILENT_S:g} s; send it again", 408
        except OSError as error:
            text, status = f"the video could not be kept ({error}): free some space in TMPDIR of the program", 507
        self._reply(text, status)
        if status != 200:
            self._take_rest()

    def _reply(self, text: str, status: int = 200) -> None:
        content = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", f"text/{'html' if status == 200 else 'plain'}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)


@contextlib.contextmanager
def demo_server(policy: AskablePolicy, port: int) -> Iterator[str]:
    """Serve the page on this machine alone, inside the block; its address.

    Raises:
      OSError: the port is taken.
    """
    handler = type("Handler", (DemoHandler,), {"demo": Demo(policy)})
    server = LimitedServer(("127.0.0.1", port), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, name="demo", daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
