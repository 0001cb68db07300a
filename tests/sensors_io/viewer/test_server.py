"""The live view through real HTTP."""

import json
import urllib.error
import urllib.request

import cv2
import numpy as np
import pytest

from sensors_io.devices.base import Sample
from sensors_io.viewer.panels import arrows, coloured, panels
from sensors_io.viewer.server import LiveView, Numbers

NUMBERS = Numbers(title="gelsight_mini R0B", time_s=1.5, force_n=(0.0, 0.1, -2.0), numbers={"missing": "3"})


def ask(view, path):
    return urllib.request.urlopen(view.address + path, timeout=10)


def part(stream):
    """One picture of a multipart stream."""
    assert stream.readline() == b"--frame\r\n"
    assert stream.readline() == b"Content-Type: image/jpeg\r\n"
    length = int(stream.readline().split()[1])
    stream.readline()
    data = stream.read(length)
    stream.readline()
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


def test_page_numbers_and_pictures():
    with LiveView(port=0) as view:
        with ask(view, "") as page:
            assert b"EventSource('/numbers')" in page.read()
        view.publish({"camera": np.full((8, 8, 3), (200, 0, 0), np.uint8)}, NUMBERS)
        with ask(view, "numbers") as events:
            said = json.loads(events.readline().removeprefix(b"data: "))
            assert said["panels"] == ["camera"]
            assert said["force_n"] == [0.0, 0.1, -2.0]
        with ask(view, "panel/camera") as stream:
            blue, _, red = part(stream).mean((0, 1))
            assert red > 180 > 50 > blue
            view.publish({"camera": np.full((8, 8, 3), (0, 0, 200), np.uint8)}, NUMBERS)
            assert part(stream).mean((0, 1))[0] > 180
        with pytest.raises(urllib.error.HTTPError, match="404"):
            ask(view, "etc/passwd")


def test_streams_end_with_the_view():
    with LiveView(port=0) as view:
        view.publish({}, NUMBERS)
        events = ask(view, "numbers")
        events.readline()
    assert events.read() == b"\n"
    events.close()


def test_a_taken_port_is_an_error():
    with LiveView(port=0) as view:
        port = int(view.address.rsplit(":", 1)[1].strip("/"))
        with pytest.raises(OSError, match="in use"), LiveView(port=port):
            pass


def test_panels_of_a_sample():
    arrays = {
        "depth_mm": np.zeros((20, 20), np.float32),
        "deformation_mm": np.ones((20, 20, 2), np.float32),
        "force_n": np.zeros(3),
    }
    shown = panels(Sample(host_time_ns=0, frame=np.zeros((4, 4, 3), np.uint8), arrays=arrays))
    assert list(shown) == ["camera", "depth, 0 to 1.5 mm", "deformation, arrows ×4"]
    assert all(p.dtype == np.uint8 and p.ndim == 3 for p in shown.values())
    touched = np.zeros((4, 4), bool)
    touched[1:3, 1:3] = True
    outlined = panels(Sample(host_time_ns=0, frame=np.zeros((4, 4, 3), np.uint8), arrays={"contact": touched}))[
        "camera"
    ]
    assert np.array_equal(outlined[..., 0] == 255, touched)
    depth = panels(Sample(host_time_ns=0, frame=np.full((4, 4), 700, np.uint16)))["camera"]
    assert depth.shape == (320, 320, 3)


def test_fields_are_coloured_and_holes_are_black():
    field = np.array([[0.0, 1.0], [np.nan, 2.0]])
    picture = coloured(field, 1.0)
    assert picture[-1, 0].tolist() == [0, 0, 0]
    assert picture[0, -1].tolist() == picture[-1, -1].tolist() != picture[0, 0].tolist()
    assert arrows(np.zeros((40, 30, 2))).shape[:2] == (320, 240)
