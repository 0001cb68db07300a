"""The live view through real HTTP, as a browser uses it."""

import dataclasses
import http.client
import json
import socket
import struct
import threading
import time
import urllib.error
import urllib.parse
import urllib.request

import cv2
import numpy as np
import pytest

from sensors_io.devices.base import Sample
from sensors_io.viewer.panels import arrows, coloured, panels, with_bar, with_rule
from sensors_io.viewer.server import LiveView, Numbers
from tests.sensors_io.checks import refused

NUMBERS = Numbers(
    title="gelsight_mini R0B", time_s=1.5, force_n=(0.0, 0.1, -2.0), tables={"gelsight_mini": {"rate": "25.0 Hz"}}
)


def ask(view, path):
    return urllib.request.urlopen(view.address + path, timeout=10)


def picture(view, name):
    with ask(view, "panel/" + urllib.parse.quote(name)) as answer:
        return cv2.imdecode(np.frombuffer(answer.read(), np.uint8), cv2.IMREAD_COLOR)


def plain(*colour):
    return lambda: np.full((8, 8, 3), colour, np.uint8)


def test_page_numbers_and_pictures():
    with LiveView(port=0) as view:
        with ask(view, "") as page:
            assert b"EventSource('/numbers')" in page.read()
        view.publish({"tac3d: depth": plain(200, 0, 0)}, NUMBERS)
        with ask(view, "numbers") as events:
            said = json.loads(events.readline().removeprefix(b"data: "))
            assert said["panels"] == ["tac3d: depth"]
            assert said["force_n"] == [0.0, 0.1, -2.0]
            blue, _, red = picture(view, "tac3d: depth").mean((0, 1))
            assert red > 180 > 50 > blue
            view.publish({"tac3d: depth": plain(0, 0, 200)}, dataclasses.replace(NUMBERS, alarm="overload"))
            events.readline()
            again = json.loads(events.readline().removeprefix(b"data: "))
            assert (again["version"], again["alarm"]) == (said["version"] + 1, "overload")
            assert picture(view, "tac3d: depth").mean((0, 1))[0] > 180
            view.publish({}, dataclasses.replace(NUMBERS, force_n=(0.0, float("nan"), float("inf"))))
            events.readline()
            assert json.loads(events.readline().removeprefix(b"data: "))["force_n"] == [0.0, None, None]
        for path in ("panel/shear", "etc/passwd"):
            refused(urllib.error.HTTPError, "404", ask, view, path)


def test_panels_of_a_sample():
    grey = np.zeros((4, 4, 3), np.uint8)
    shown = lambda frame, **arrays: panels(Sample(host_time_ns=0, frame=frame, arrays=arrays))
    fields = shown(grey, depth_mm=np.zeros((20, 20)), deformation_mm=np.ones((20, 20, 2)), force_n=np.zeros(3))
    assert list(fields) == ["camera", "depth", "deformation"]
    assert all(p().dtype == np.uint8 and p().ndim == 3 for p in fields.values())
    touched = np.zeros((4, 4), bool)
    touched[1:3, 1:3] = True
    assert np.array_equal(shown(grey, contact=touched)["camera"]()[..., 0] == 255, touched)
    assert shown(np.full((4, 4), 700, np.uint16))["camera"]().shape == (320, 320, 3)
    assert list(shown(grey, view_depth_mm=np.full((4, 4), 300.0, np.float32))) == ["camera", "distance"]


def test_fields_are_coloured_and_holes_are_black():
    field = np.array([[0.0, 1.0], [np.nan, 2.0]])
    drawn = coloured(field, 1.0)
    assert drawn[-1, 0].tolist() == [0, 0, 0]
    assert drawn[0, -1].tolist() == drawn[-1, -1].tolist() != drawn[0, 0].tolist()
    still = arrows(np.zeros((40, 30, 2)))
    assert still.shape[:2] == (320, 240)
    assert np.ptp(still.reshape(-1, 3), axis=0).max() == 0  # no arrow where nothing moves
    assert (arrows(np.full((40, 30, 2), 0.2)) == 255).all(-1).any()
    began = time.process_time()
    assert (arrows(np.full((20, 20, 2), [np.inf, -1e30], np.float32)) == 0).any()
    assert (arrows(np.full((20, 20, 2), [3e38, -1e30], np.float32)) == 255).all(-1).any()
    assert time.process_time() - began < 5  # once minutes


def test_a_picture_of_known_width_has_a_scale_and_a_field_its_colours():
    rule = with_rule(np.full((240, 320, 3), 90, np.uint8), 20.0)
    assert (rule[232] == 255).all(-1).sum() == pytest.approx(5 / 20 * 320, abs=4)  # 5 mm of 20
    dark = np.zeros((80, 106, 3), np.uint8)
    assert with_rule(dark, None) is with_rule(dark, 1e-7) is dark
    for shape in ((240, 320), (400, 300)):
        drawn = with_bar(coloured(np.zeros(shape), 1.5), 1.5)
        assert len(np.unique(drawn[:, -1], axis=0)) == 1  # no letter is cut off at the edge
        bar = drawn[:, shape[1] + round(10 * shape[1] / 320)]
        assert bar[0].tolist() == coloured(np.full((1, 1), 2.0), 1.5)[0, 0].tolist()
        assert bar[-1].tolist() == coloured(np.zeros((1, 1)), 1.5)[0, 0].tolist()
    frame = np.full((60, 80, 3), 90, np.uint8)
    sample = Sample(host_time_ns=0, frame=frame, arrays={"depth_mm": np.zeros((60, 80))})
    assert panels(sample, 0.2)["depth"]().shape[1] > panels(sample, 0.2)["camera"]().shape[1] == 320


def requested(view, path="/", **headers):
    """Status and cookie of a plain request with headers of its own."""
    port = int(urllib.parse.urlsplit(view.address).port)
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    connection.close()
    return answer.status, answer.headers.get("Set-Cookie", "")


@pytest.mark.parametrize(
    ("host", "status"), [("127.0.0.1:80", 200), ("localhost", 200), ("[::1]:9", 200), ("evil.example", 403), ("", 403)]
)
def test_another_sites_name_is_refused(host, status):
    with LiveView(port=0) as view:
        assert requested(view, Host=host)[0] == status


def test_a_view_for_the_network_wants_its_token():
    with LiveView(port=0, host="0.0.0.0") as view:
        token = view.address.partition("?token=")[2]
        assert len(token) >= 16
        assert [requested(view, path)[0] for path in ("/", "/numbers", "/panel/a", "/?token=wrong")] == [403] * 4
        status, cookie = requested(view, f"/?token={token}")
        assert (status, cookie.partition("=")[2].partition(";")[0]) == (200, token)
        view.publish({"a": plain(1, 2, 3)}, NUMBERS)
        shown = cookie.partition(";")[0]
        assert requested(view, "/panel/a", Cookie=shown)[0] == 200
        others = 'settings={"a": [1]}; token=x; __Host-a[b]=\xe9'  # of whatever else this machine serves
        assert requested(view, "/panel/a", Cookie=f"{others}; {shown}")[0] == 200
        with LiveView(port=0, host="0.0.0.0") as second:  # browsers keep one cookie of a name for all ports
            other = requested(second, "/?token=" + second.address.partition("?token=")[2])[1]
            assert other.partition("=")[0] != shown.partition("=")[0]


def test_a_view_has_an_address_of_version_6(capfd):
    with LiveView(port=0, host="::1") as view:
        assert view.address.startswith("http://[::1]:")
        with ask(view, "") as page:
            assert b"EventSource" in page.read()
    refused(OSError, "192.0.2.1; must be an address of this machine", LiveView(port=0, host="192.0.2.1").__enter__)


def test_requests_of_no_browser_are_refused_without_a_word_in_the_terminal(capfd):
    """Addresses that are none, a header smuggled into the answer, a connection that is reset."""
    with LiveView(port=0) as view:
        port = int(urllib.parse.urlsplit(view.address).port)
        ended = b"\r\nConnection: close\r\n\r\n"
        for target, host, status in (
            (b"/", b"[", b"403"),
            (b"http://[", b"localhost", b"404"),
            (b"/?token=x%0d%0aSet-Cookie:%20a=b", b"localhost", b"200"),
            (b"/?token=%E2%82%AC", b"localhost", b"200"),
        ):
            with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
                connection.sendall(b"GET " + target + b" HTTP/1.1\r\nHost: " + host + ended)
                answer = b"".join(iter(lambda: connection.recv(65_536), b""))
            assert answer.partition(b" ")[2].startswith(status)
            assert b"Set-Cookie" not in answer
        with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
            connection.sendall(b"GET /numbers HTTP/1.1\r\nHost: localhost")
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        assert requested(view)[0] == 200
    assert capfd.readouterr().err == ""


def test_streams_end_with_the_view_and_a_taken_port_is_an_error():
    with LiveView(port=0) as view:
        port = int(urllib.parse.urlsplit(view.address).port)
        with pytest.raises(OSError, match=r"in use: 127.*; name another --port"), LiveView(port=port):
            pass
        view.publish({}, NUMBERS)
        events = ask(view, "numbers")
        events.readline()
    assert events.read() == b"\n"
    events.close()


@pytest.mark.long
def test_connections_too_many_are_told_so_and_closed():
    with LiveView(port=0) as view:
        port = int(urllib.parse.urlsplit(view.address).port)
        before = threading.active_count()
        silent = [socket.create_connection(("127.0.0.1", port), timeout=10) for _ in range(100)]
        for connection in silent[64:]:
            answer = b"".join(iter(lambda c=connection: c.recv(65_536), b""))
            assert answer.startswith(b"HTTP/1.1 503 ")
            assert b"64 connections are open, and no more are served: close other tabs" in answer
        assert threading.active_count() - before <= 64
        for connection in silent:
            connection.close()
