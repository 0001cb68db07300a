"""Tac3D datagrams: layouts in both styles, packets in any order, damaged input, the vendor's signs."""

import socket
import struct

import numpy as np
import pytest

from sensors_io.devices import tac3d, tac3d_messages
from sensors_io.devices.errors import DeviceDataError, DeviceLostError, DeviceNotFoundError
from sensors_io.devices.sources import Tac3dRecording
from tests.sensors_io.checks import refused
from tests.sensors_io.devices.fakes import sent

NAMES = {"3D_Displacements": (400, 3), "3D_Forces": (400, 3), "3D_ResultantForce": (1, 3), "3D_ResultantMoment": (1, 3)}


def matrices(seed=0):
    rng = np.random.default_rng(seed)
    return {name: rng.normal(size=shape) for name, shape in NAMES.items()}


def layout(arrays, *, index=10, serial="AD2-0065L", style="flow", time_s=12.5):
    lines, offset = [], 0
    for name, a in arrays.items():
        size = {"width": a.shape[1], "height": a.shape[0], "offset": offset, "length": a.nbytes}
        pairs = {"name": name, "type": "mat", "dtype": "f64", **size}
        offset += a.nbytes
        if style == "flow":
            lines.append("  - {" + ", ".join(f"{k}: {v}" for k, v in pairs.items()) + "}")
        else:
            lines.append("- " + "\n  ".join(f"{k}: {v}" for k, v in pairs.items()))
    head = f'index: {index}\nSN: {serial}\ntimestamp: {time_s}\nmsg: ""\ndata:\n'
    return (head + "\n".join(lines)).encode()


def datagrams(arrays, *, number=1, packets=3, **rest):
    """One message as datagrams; its data in equal parts."""
    data = b"".join(a.tobytes() for a in arrays.values())
    size = -(-len(data) // packets)
    parts = [layout(arrays, **rest), *(data[k : k + size] for k in range(0, len(data), size))]
    return [struct.pack("=IHH", number, packets, k) + part for k, part in enumerate(parts)]


@pytest.mark.parametrize("style", ["flow", "block"])
def test_arrays_come_out_as_they_went_in(style):
    arrays = matrices()
    decoder, assembler = tac3d_messages.Tac3dDecoder(), tac3d_messages.Assembler()
    for index in (10, 11):
        wholes = [assembler.add(d) for d in datagrams(arrays, number=index, index=index, style=style)]
        assert wholes[:-1] == [None] * 3
        message = decoder.decode(*wholes[-1])
        assert (message.index, message.serial, message.send_time_s, message.note) == (index, "AD2-0065L", 12.5, "")
        for name, a in arrays.items():
            np.testing.assert_array_equal(message.matrices[name], a)


def test_what_is_never_completed_is_counted_and_forgotten():
    assembler = tac3d_messages.Assembler()
    for number in range(40):
        assembler.add(datagrams(matrices(), number=number)[0])
    assert assembler.incomplete == 32
    last = [assembler.add(d) for number in (32, 31) for d in datagrams(matrices(), number=number)[1:]]
    assert [whole is not None for whole in last] == [False, False, True] + [False] * 3


def test_packets_may_come_in_any_order_twice_and_between_those_of_other_messages():
    a, b = (datagrams(matrices(k), number=k) for k in (1, 2))
    assembler = tac3d_messages.Assembler()
    order = [a[3], b[0], a[0], a[0], b[3], a[2], b[1]]
    assert [assembler.add(d) for d in order] == [None] * 7
    assert assembler.add(a[1]) is not None
    layout_b, data_b = assembler.add(b[2])
    np.testing.assert_array_equal(
        tac3d_messages.Tac3dDecoder().decode(layout_b, data_b).matrices["3D_Forces"], matrices(2)["3D_Forces"]
    )


def test_damaged_datagrams_are_refused():
    refused(DeviceDataError, "5 bytes: its header alone has 8", lambda: tac3d_messages.Assembler().add(b"\0" * 5))
    refused(DeviceDataError, "misnumbered", lambda: tac3d_messages.Assembler().add(struct.pack("=IHH", 1, 0, 0)))
    refused(DeviceDataError, "misnumbered", lambda: tac3d_messages.Assembler().add(struct.pack("=IHH", 1, 3, 4)))
    refused(DeviceDataError, "misnumbered", lambda: tac3d_messages.Assembler().add(struct.pack("=IHH", 1, 60_000, 4)))


GOOD = layout({"3D_ResultantForce": np.ones((1, 3))})


def empty(height, width):
    """The layout with an array that is said to be of these sides and of no bytes."""
    sides = GOOD.replace(b"height: 1", b"height: %d" % height).replace(b"width: 3", b"width: %d" % width)
    return sides.replace(b"length: 24", b"length: 0")


@pytest.mark.parametrize(
    ("bad", "data", "message"),
    [
        (b"index: 3\nSN: x\n", b"", "no `data:` list"),
        (GOOD, b"\0" * 23, "ends at byte 24 of 23"),
        (GOOD.replace(b"f64", b"f16"), b"\0" * 24, "cannot be read"),
        (GOOD.replace(b"height: 1", b"height: 7"), b"\0" * 24, "are not 24 bytes"),
        (GOOD.replace(b"offset: 0", b"offset: -8"), b"\0" * 24, "are not 24 bytes at -8"),
        (GOOD.replace(b"width: 3", b"width: x"), b"\0" * 24, "cannot be read"),
        (empty(2**32, 2**32), b"", "are not 0 bytes"),  # whose product is 0 in 64 bits
        (empty(0, 10**30), b"", "are not 0 bytes"),
        (GOOD.replace(b"index: 10", b"index: ten"), b"\0" * 24, "lacks a readable index"),
        (GOOD.replace(b"index: 10", b"index: -9223372036854775808"), b"\0" * 24, "must be within ±2"),
        (b"index: 1\nSN: x\ntimestamp: 2\ndata:\n", b"", "lists no array"),
        (b"index: 1\nSN: x\ntimestamp: 2\ndata: \xff\n", b"", "lists no array"),
    ],
)
def test_damaged_layouts_are_refused(bad, data, message):
    refused(DeviceDataError, message, lambda: tac3d_messages.Tac3dDecoder().decode(bad, data))


def pushed(force, move):
    """A message in which everything moves by `move` mm and the gel is loaded with `force` N."""
    return {
        "3D_Displacements": np.tile(np.array(move, float), (400, 1)),
        "3D_ResultantForce": np.array([force], float),
        "3D_ResultantMoment": np.zeros((1, 3)),
    }


def test_a_known_push_has_the_schemas_signs():
    """Pressed by 2 N and dragged to +x: Fz < 0, depth > 0, deformation along +x; point 0 (+x, +y) is bottom right."""
    arrays = pushed([0.5, 0.0, -2.0], [0.3, 0.1, -0.7])
    arrays["3D_Displacements"][0] = [9, 8, -7]
    fields = tac3d_messages.to_schema(arrays)
    assert fields["force_n"].tolist() == [0.5, 0.0, -2.0]
    np.testing.assert_allclose(fields["depth_mm"][0, 0], 0.7, rtol=1e-6)
    np.testing.assert_allclose(fields["deformation_mm"][0, 0], [0.3, 0.1], rtol=1e-6)
    assert fields["deformation_mm"][19, 19].tolist() == [9, 8]
    assert all(a.dtype == np.float32 for a in fields.values())


def test_a_recording_is_read_from_a_folder_and_from_an_archive(tmp_path):
    arrays = {
        "index": np.array([3, 4, 7]),
        "sendTimestamp": np.array([1.0, 1.03, 1.13]),
        "3D_Displacements": np.zeros((3, 400, 3)),
        "3D_ResultantForce": np.ones((3, 1, 3)),
    }
    (tmp_path / "AD2-1").mkdir()
    for name, a in arrays.items():
        np.save(tmp_path / "AD2-1" / f"{name}.npy", a)
    np.savez(tmp_path / "AD2-1.npz", **arrays)
    for path in (tmp_path / "AD2-1", tmp_path / "AD2-1.npz"):
        source = Tac3dRecording(path=path)
        samples = list(source.samples())
        assert [s.index for s in samples] == [3, 4, 7]
        assert [round(s.time_ns / 1e6) for s in samples] == [0, 30, 130]
        assert samples[0].arrays["force_n"].tolist() == [1, 1, 1]
        assert source.identity.serial == "AD2-1"


def listening(port, **rest):
    """An open device whose first message is on its way before it waits for it."""
    return tac3d.Tac3dConfig(port=port, wait_s=5.0, **rest).open()


def test_a_sensor_is_heard_and_told_its_zero(vendor):
    sender, port = vendor
    fine = pushed([0, 0, -1], [0, 0, -0.1])
    by = lambda serial: lambda number: datagrams(fine, number=number, index=number, serial=serial)
    with sent(sender, by("HDL1-7"), by("AD2-0065L")), listening(port, serial="AD2-0065L") as sensor:
        samples = [sensor.read(5.0) for _ in range(3)]
        assert [s.index % 2 for s in samples] == [0, 0, 0]
        assert sensor.identity.serial == "AD2-0065L"
        assert samples[0].device_time_ns == 12_500_000_000
        sensor.take_zero()
        assert sender.recv(10) == b"$C"


def test_silence_and_a_taken_port_are_named(vendor):
    _, port = vendor
    quiet = tac3d.Tac3dConfig(port=port, wait_s=0.05).open()
    refused(DeviceNotFoundError, "nothing heard on port", quiet.__enter__)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port))
        refused(DeviceNotFoundError, "cannot be listened on", listening(port).__enter__)
    refused(DeviceLostError, "not open", lambda: listening(port).read(0.1))
    refused(DeviceLostError, "not open", lambda: listening(port).take_zero())


def test_a_layout_of_another_shape_is_learnt_anew():
    decoder = tac3d_messages.Tac3dDecoder()
    for arrays in (matrices(), {"3D_ResultantForce": np.ones((1, 3))}):
        data = b"".join(a.tobytes() for a in arrays.values())
        assert decoder.decode(layout(arrays), data).matrices.keys() == arrays.keys()


def test_an_incomplete_recording_is_refused(tmp_path):
    refused(DeviceNotFoundError, "neither a folder", tac3d_messages.load_recording, tmp_path / "nowhere")
    np.savez(tmp_path / "a.npz", index=np.arange(3))
    refused(DeviceDataError, "sendTimestamp must be among them", tac3d_messages.load_recording, tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", index=np.arange(3), sendTimestamp=np.arange(2.0))
    refused(DeviceDataError, "one length", tac3d_messages.load_recording, tmp_path / "b.npz")


@pytest.mark.parametrize(
    "changes",
    [
        {"sendTimestamp": np.array([0, np.nan, 1])},
        {"sendTimestamp": np.array([0, 1e12, 2e12])},
        {"sendTimestamp": np.array(["a", "b", "c"])},
        {"index": np.array([0, np.nan, 1])},
        {"index": np.array([0, 0.03, 0.06])},  # the file of the times in its place
        {"index": np.array(["a", "b", "c"])},
        {"index": np.array([1, 2, 2**63], np.uint64)},
        {"3D_ResultantForce": np.full((3, 1, 3), "a")},
        {"3D_ResultantForce": np.array(1.0)},
    ],
)
def test_a_recording_of_what_is_no_number_is_refused(tmp_path, changes):
    np.savez(tmp_path / "a.npz", **{"index": np.arange(3), "sendTimestamp": np.arange(3.0)} | changes)
    refused(DeviceDataError, next(iter(changes)), tac3d_messages.load_recording, tmp_path / "a.npz")
    refused(DeviceNotFoundError, next(iter(changes)), lambda: Tac3dRecording(path=tmp_path / "a.npz").identity)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sendTimestamp": np.array([0.0, 2.0, -1.0])}, "sendTimestamp: row 2 has -1.0 s, row 0 0.0 s: the last must"),
        ({"sendTimestamp": np.ones(3)}, "sendTimestamp: row 2 has 1.0 s, row 0 1.0 s: the last must"),
        ({"3D_Displacements": np.zeros((3, 399, 3))}, "1197 numbers: must have 1200"),
    ],
)
def test_a_recording_that_cannot_be_replayed_is_refused_before_it_is(tmp_path, changes, said):
    np.savez(tmp_path / "a.npz", **{"index": np.arange(3), "sendTimestamp": np.arange(3.0)} | changes)
    refused(DeviceNotFoundError, said, lambda: Tac3dRecording(path=tmp_path / "a.npz").identity)


def test_messages_that_were_swapped_are_replayed_at_the_latest_time_so_far(tmp_path):
    np.savez(tmp_path / "a.npz", index=np.array([4, 6, 5, 7]), sendTimestamp=np.array([0.0, 2.0, 1.0, 3.0]))
    samples = list(Tac3dRecording(path=tmp_path / "a.npz").samples())
    assert [(s.index, s.time_ns // 10**9) for s in samples] == [(4, 0), (6, 2), (5, 2), (7, 3)]
