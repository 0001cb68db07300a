"""Exports for the eye and for ROS: surfaces, Rerun recordings, bags, and the node that publishes the same messages."""

import pathlib
import subprocess
import sys
import time
import types

import numpy as np
import pytest

from sensors_io import __main__ as main
from sensors_io.codec import decode_sequence, encode_sequence
from sensors_io.commands.ros2 import TouchPublisher
from sensors_io.devices.base import Sample
from sensors_io.exporters.ply import export_ply, surface
from sensors_io.exporters.rerun import export_rerun
from sensors_io.exporters.ros import export_rosbag
from sensors_io.exporters.selection import ExportError, Selected
from sensors_io.records import RecordStore, RecordWriter
from tests.sensors_io import fakes
from tests.sensors_io.checks import refused

SILENT = lambda done, total: None
VERTEX = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]


@pytest.fixture
def selected(tmp_path) -> Selected:
    return Selected(store=RecordStore(fakes.write(tmp_path / "records", 2, sensors=("gelsight_mini",))))


def parsed(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a PLY of ours."""
    head, _, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode().splitlines()]
    count = {line[1]: int(line[2]) for line in lines if line[0] == "element"}
    vertices = np.frombuffer(body, VERTEX, count["vertex"])
    faces = np.frombuffer(body, [("n", "u1"), ("at", "<i4", 3)], count.get("face", 0), vertices.nbytes)
    assert len(body) == vertices.nbytes + faces.nbytes
    return vertices, faces


def test_a_surface_has_the_depth_of_its_map_and_faces_outwards():
    depth = np.array([[0, 0.5, 0], [0, 1.0, 0]], np.float32)
    colours = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    vertices, faces = parsed(surface(depth, 0.1, colours))
    np.testing.assert_allclose(vertices["z"], -depth.ravel())
    np.testing.assert_allclose(vertices["x"], [0, 0.1, 0.2] * 2)
    assert vertices["green"].tolist() == colours[..., 1].ravel().tolist()
    flat, faces = parsed(surface(np.zeros((2, 3), np.float32), 0.1))
    at = np.stack([flat[axis] for axis in "xyz"], -1)[faces["at"]]
    normals = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
    assert len(faces) == 4
    assert (normals[:, 2] > 0).all()
    assert len(parsed(surface(depth, 0.1, points=True))[1]) == 0


def test_a_surface_for_each_sequence_at_its_deepest_frame(tmp_path, selected):
    export_ply(selected, tmp_path / "ply", False, SILENT)
    names = sorted(path.name for path in (tmp_path / "ply").iterdir())
    assert names == [f"00000{n}-object_0-press-gelsight_mini-00011.ply" for n in range(2)]
    vertices, _ = parsed((tmp_path / "ply" / names[0]).read_bytes())
    sequence = selected.store.contact(0)["gelsight_mini"]
    np.testing.assert_allclose(vertices["z"], -sequence.depth_mm[11].ravel())
    assert vertices["y"].max() == pytest.approx(4 * 0.0634 * 16 / 5)  # the grid of the depth covers the picture
    refused(ExportError, "must not exist yet", export_ply, selected, tmp_path / "ply", False, SILENT)


def test_depth_of_a_file_becomes_surfaces(tmp_path, capsys):
    depth = np.ones((2, 3, 4), np.float32)
    np.savez(tmp_path / "d.npz", depth_mm=depth, mm_per_px=np.float64(0.1), names=np.array(["a.png", "b.mp4#7"]))
    assert main.main(["export", str(tmp_path / "d.npz"), "--to", "ply", "--points", "--out", str(tmp_path / "p")]) == 0
    assert sorted(path.name for path in (tmp_path / "p").iterdir()) == ["00000-a.ply", "00001-b.ply"]
    np.savez(tmp_path / "d.npz", depth_mm=np.nan * depth, mm_per_px=np.float64(0.1), names=np.array(["a", "b"]))
    assert main.main(["export", str(tmp_path / "d.npz"), "--to", "ply", "--out", str(tmp_path / "q")]) == 1
    assert "holds no depth" in capsys.readouterr().err
    assert main.main(["export", str(tmp_path), "--to", "zarr", "--points", "--out", "x"]) == 1
    assert "--points is of --to ply" in capsys.readouterr().err
    for out in (tmp_path, tmp_path / "x", tmp_path / "a" / ".." / "b"):
        assert main.main(["export", str(tmp_path), "--to", "hdf5", "--out", str(out)]) == 1
        assert "lies in the folder of the records" in capsys.readouterr().err


@pytest.mark.long
def test_a_rerun_recording_loads_and_has_its_entities(tmp_path, selected):
    pytest.importorskip("rerun")
    export_rerun(selected, tmp_path / "a.rrd", SILENT)
    rrd = lambda what: [sys.executable, "-m", "rerun", "rrd", what, str(tmp_path / "a.rrd")]
    tell = lambda what: subprocess.run(rrd(what), capture_output=True, text=True, check=True)
    verified = tell("verify")
    assert "verified without error" in verified.stdout + verified.stderr
    shown = tell("print").stdout
    for name in ("view", *(f"gelsight_mini/{field}" for field in ("camera", "depth", "deformation", "force"))):
        assert f"/00001_object_0_press/{name}" in shown


def test_a_phase_without_a_name_is_a_number_in_rerun(tmp_path):
    pytest.importorskip("rerun")
    with RecordWriter(tmp_path / "records", meta=fakes.META) as writer:
        writer.write_object(fakes.card())
        writer.write_contact([fakes.sequence(length=2, phase=np.array([0, 5], np.uint8))])
    export_rerun(Selected(store=RecordStore(tmp_path / "records")), tmp_path / "a.rrd", SILENT)
    assert b"phase 5" in (tmp_path / "a.rrd").read_bytes()


def recorded_messages(bag: pathlib.Path):
    """Topic, time and message of everything in a bag."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    with pytest.importorskip("rosbags.rosbag2").Reader(bag) as reader:
        for connection, time_ns, raw in reader.messages():
            yield connection.topic, time_ns, store.deserialize_cdr(raw, connection.msgtype)


def test_a_bag_holds_pictures_depth_force_and_flags_in_the_units_of_ros(tmp_path, selected):
    pytest.importorskip("rosbags")
    export_rosbag(selected, tmp_path / "bag", SILENT)
    found = list(recorded_messages(tmp_path / "bag"))
    times = [time_ns for _, time_ns, _ in found]
    assert times == sorted(times)
    sequence = selected.store.contact(1)["gelsight_mini"]
    last = {topic.rpartition("/")[2]: message for topic, _, message in found}
    assert last.keys() == {"image", "depth", "wrench", "flags"}
    assert (last["image"].encoding, last["image"].step) == ("rgb8", 60)
    np.testing.assert_array_equal(last["image"].data.reshape(16, 20, 3), sequence.frames[-1])
    depth = last["depth"].data.view("<f4").reshape(5, 6)
    np.testing.assert_allclose(depth, 1e-3 * sequence.depth_mm[-1], rtol=1e-6)
    assert last["wrench"].wrench.force.z == pytest.approx(-20, abs=1e-3)
    stamp = last["image"].header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == times[-1] == 2 * sequence.host_time_ns[-1] + 10**9
    assert last["image"].header.frame_id == "gelsight_mini"


def test_a_time_beyond_those_of_ros_is_named(tmp_path):
    pytest.importorskip("rosbags")
    with RecordWriter(tmp_path / "records", meta=fakes.META) as writer:
        writer.write_object(fakes.card())
        writer.write_contact([fakes.sequence(length=2, host_time_ns=np.array([0, 2**62]))])
    selected = Selected(store=RecordStore(tmp_path / "records"))
    refused(ExportError, f"a time is {2**62} ns: must be < ", export_rosbag, selected, tmp_path / "bag", SILENT)


class FakeNode:
    """A node of rclpy that keeps what is published, and whose clock is 1,000 s ahead of the host's."""

    def __init__(self):
        self.published = []

    def get_clock(self):
        return types.SimpleNamespace(now=lambda: types.SimpleNamespace(nanoseconds=time.monotonic_ns() + 10**12))

    def create_publisher(self, kind, topic, queue):
        return types.SimpleNamespace(publish=lambda message: self.published.append((topic, message)))

    def destroy_node(self):
        pass


@pytest.fixture
def ros(monkeypatch):
    """Stand-ins of ROS's Python packages: messages are those of the library rosbags, made as rclpy makes them."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)

    def maker(kind):
        def made(**fields):
            as_array = lambda x: np.frombuffer(x, np.uint8) if type(x).__name__ == "array" else x
            return store.types[kind](**{name: as_array(value) for name, value in fields.items()})

        return made

    nodes = []
    for package in ("builtin_interfaces", "std_msgs", "sensor_msgs", "geometry_msgs"):
        module = types.ModuleType(f"{package}.msg")
        for kind in store.types:
            if kind.startswith(f"{package}/msg/"):
                setattr(module, kind.rpartition("/")[2], maker(kind))
        monkeypatch.setitem(sys.modules, package, types.ModuleType(package))
        monkeypatch.setitem(sys.modules, f"{package}.msg", module)
    rclpy = types.ModuleType("rclpy")
    rclpy.init, rclpy.shutdown = lambda: None, lambda: None
    rclpy.create_node = lambda name: nodes.append(FakeNode()) or nodes[-1]
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    return types.SimpleNamespace(store=store, nodes=nodes)


def test_the_node_publishes_what_a_bag_records(tmp_path, selected, ros):
    """Samples with the arrays of a recording give the recorded messages, byte for byte but for their stamps."""
    export_rosbag(selected, tmp_path / "bag", SILENT)
    sequence = decode_sequence(encode_sequence(selected.store.contact(0)["gelsight_mini"]))
    node = FakeNode()
    publisher = TouchPublisher(node)
    for n in range(len(sequence)):
        arrays = {"depth_mm": sequence.depth_mm[n], "force_n": sequence.force_n[n]}
        sample = Sample(host_time_ns=10**9 * n, frame=sequence.frames[n], arrays=arrays)
        publisher.publish("gelsight_mini", sample)
    recorded = [(topic, message) for topic, _, message in recorded_messages(tmp_path / "bag") if "flags" not in topic]
    assert publisher.count == len(node.published) == 36
    stamps = [message.header.stamp for _, message in node.published]
    np.testing.assert_allclose([t.sec + 1e-9 * t.nanosec for t in stamps], 1000 + np.arange(36) // 3, atol=0.2)
    never = ros.store.types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    for (topic, message), (recorded_topic, kept) in zip(node.published, recorded, strict=False):
        assert topic == recorded_topic
        message.header.stamp = kept.header.stamp = never
        kind = message.__msgtype__
        assert bytes(ros.store.serialize_cdr(message, kind)) == bytes(ros.store.serialize_cdr(kept, kind))


def test_the_command_publishes_a_replayed_camera_until_it_is_told(tmp_path, ros, capsys):
    gelslam = pathlib.Path(__file__).resolve().parents[2] / "data" / "gelslam"
    replay = ["replay", "--path", str(gelslam), "--rate-hz", "100"]
    assert main.main(["ros2", "--seconds", "0.6", *replay]) == 0
    topics = {topic for topic, _ in ros.nodes[0].published}
    assert topics == {"/touch/gelsight_mini/image"}
    assert f"published {len(ros.nodes[0].published)} messages" in capsys.readouterr().out


def test_without_ros_the_command_says_what_to_source(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert main.main(["ros2", "replay", "--path", "nowhere"]) == 1
    assert "source /opt/ros/<distribution>/setup.bash" in capsys.readouterr().err


def test_names_that_rerun_would_split_are_escaped(tmp_path):
    pytest.importorskip("rerun")
    with RecordWriter(tmp_path / "records", meta=fakes.META) as writer:
        writer.write_object(fakes.card(0, object_id="cup.2-b"))
        key = fakes.sequence(0).key.__class__(object_id="cup.2-b", site=0, motion="press", trial=0)
        writer.write_contact([fakes.sequence(0, length=2, key=key)])
    export_rerun(Selected(store=RecordStore(tmp_path / "records")), tmp_path / "a.rrd", SILENT)
    assert (tmp_path / "a.rrd").stat().st_size > 0


@pytest.mark.parametrize(
    "changed",
    [
        {"depth_mm": np.ones((2, 4), np.float32)},
        {"depth_mm": np.array(["x"])},
        {"depth_mm": np.ones((0, 4, 5), np.float32), "names": np.array([], str)},
        {"names": np.array(["a"])},
        {"names": np.array("a")},
        {"mm_per_px": np.ones(3)},
        {"mm_per_px": np.float64("nan")},
        {"mm_per_px": np.float64(0)},
    ],
)
def test_arrays_that_are_no_surfaces_are_one_line(tmp_path, changed, capsys):
    whole = {"depth_mm": np.ones((2, 4, 5), np.float32), "mm_per_px": np.float64(0.1), "names": np.array(["a", "b"])}
    np.savez(tmp_path / "d.npz", **whole | changed)
    assert main.main(["export", str(tmp_path / "d.npz"), "--to", "ply", "--out", str(tmp_path / "p")]) == 1
    assert "ExportError" in capsys.readouterr().err
    assert not (tmp_path / "p").exists()
