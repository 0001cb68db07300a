"""A stand-in for S3, moto's server, that fails, stalls, is full or refuses: `python -m` this module PORT FAULTS."""

import http
import json
import random
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from werkzeug.serving import make_server

_ERROR = '<?xml version="1.0"?><Error><Code>{}</Code><Message>{}</Message></Error>'
ANSWERS = {
    "errors": (http.HTTPStatus.SERVICE_UNAVAILABLE, "SlowDown"),
    "full": (http.HTTPStatus.INSUFFICIENT_STORAGE, "XMinioStorageFull"),
    "refuses": (http.HTTPStatus.FORBIDDEN, "SignatureDoesNotMatch"),
}
"""Fault → the store's answer; `stall_s` is the time for which the tenth request waits."""


class FaultyStore:
    """Answers a share of the requests with each fault, `full` uploads alone, and hands on the others."""

    def __init__(self, app: Callable[..., Iterable[bytes]], faults: Mapping[str, float]):
        self._app, self._faults, self._rng, self._count = app, dict(faults), random.Random(0), 0

    def __call__(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        if environ["PATH_INFO"] == "/faults":  # a test sets them anew
            self._faults = json.loads(environ["wsgi.input"].read(int(environ["CONTENT_LENGTH"])))
            start_response("200 OK", [])
            return [json.dumps(self._count).encode()]
        self._count += 1
        for name, (status, code) in ANSWERS.items():
            uploads = name == "full" and environ["REQUEST_METHOD"] != "PUT"
            if not uploads and self._rng.random() < self._faults.get(name, 0.0):
                environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
                start_response(f"{status.value} {status.phrase}", [("Content-Type", "application/xml")])
                return [_ERROR.format(code, status.description or code).encode()]
        if stall_s := self._faults.pop("stall_s", 0.0):
            time.sleep(stall_s)
        return self._app(environ, start_response)


if __name__ == "__main__":
    from moto.server import DomainDispatcherApplication, create_backend_app

    served = FaultyStore(DomainDispatcherApplication(create_backend_app), json.loads(sys.argv[2]))
    make_server("127.0.0.1", int(sys.argv[1]), served, threaded=True).serve_forever()
