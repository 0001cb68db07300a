"""Bytes from outside, mutated at random: a documented error or a value, soon, and in little memory.

Inputs of devices, records, arrays and published models; `test_mutated_files` tries the files of people and policies.
"""

import contextlib
import dataclasses
import io
import json
import pathlib
import pickle
import shutil
import socket
import struct
import types
import urllib.parse
import zlib

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.ask.demo import demo_server
from sensors_io.arrays import load_arrays
from sensors_io.codec import decode_card, decode_sequence, encode_card, encode_sequence
from sensors_io.devices import bridge, netft, tac3d_messages
from sensors_io.devices.base import Identity
from sensors_io.errors import UserError
from sensors_io.fields.types import Calibration, ColourMap
from sensors_io.importers.pickles import PickleError, read_pickle
from sensors_io.index import INDEX, Index
from sensors_io.recording.assemble import assemble
from sensors_io.schema import ContactKey
from sensors_io.viewer.server import LiveView
from tests.mutations import check_parser, file_of, mutated, written
from tests.sensors_io import fakes
from tests.sensors_io.devices.test_netft import NEWTONS
from tests.sensors_io.devices.test_tac3d import datagrams, pushed
from tests.touchr1_jax.models.qwen.cases import SHAPES, qwen3_json
from tests.touchr1_jax.text.vocabularies import trained_bpe
from touchr1_jax.bench.json_lines import read_lines
from touchr1_jax.models.qwen import safetensors
from touchr1_jax.models.qwen.config_file import CONFIG_FILE, read_config
from touchr1_jax.text import tokenizer
from touchr1_jax.text.language import TOUCH_LANGUAGE

VERSION_2 = pathlib.Path(__file__).parent / "sensors_io" / "index_of_version_2.json"
SEPARATOR = b"\xfe\xfd\xfc"
NAMES = (
    "Tac3D", "Net F/T", "bridge", "sequence", "card", "journal", "index", "npz", "npy", "calibration", "pickle",
    "safetensors", "configuration", "tokenizer", "JSON Lines", "index of version 2",
    "Qwen3 configuration",
)  # fmt: skip
PUBLISHED = {
    "model_type": "qwen2_5_vl", "vocab_size": 500, "hidden_size": 64, "intermediate_size": 128,
    "num_hidden_layers": 2, "num_attention_heads": 4, "num_key_value_heads": 2, "hidden_act": "silu",
    "rms_norm_eps": 1e-6, "rope_theta": 1e6, "rope_scaling": {"type": "mrope", "mrope_section": [2, 3, 3]},
    "tie_word_embeddings": True, "vision_start_token_id": 1, "vision_end_token_id": 2, "image_token_id": 3,
    "video_token_id": 4, "vision_config": {"out_hidden_size": 64, "depth": 2, "hidden_size": 64, "num_heads": 4,
    "intermediate_size": 96, "hidden_act": "silu", "patch_size": 14, "in_chans": 3, "temporal_patch_size": 2,
    "spatial_merge_size": 2,
    "window_size": 112, "fullatt_block_indexes": [1]},
}  # fmt: skip

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::DeprecationWarning")]


def tac3d(data):
    """A message whose packets are the pieces between separators."""
    assembler, decoder = tac3d_messages.Assembler(), tac3d_messages.Tac3dDecoder()
    for datagram in data.split(SEPARATOR):
        if (whole := assembler.add(datagram)) is not None:
            message = decoder.decode(*whole)
            if message.initialised == 100:
                tac3d_messages.to_schema(message.matrices)


def bridge_frame(data):
    header, _, payload = data.partition(SEPARATOR)
    bridge.to_schema(bridge.unpack(header, payload)[1])


def entry(decode):
    """A decoder of entries of records, given what follows a checksum that holds."""
    return lambda data: decode(b"TCH2" + struct.pack("<I", zlib.crc32(data)) + data)


def journal(folder):
    """A reader of journals, given the bodies of the entries, whose checksums hold."""

    def parse(data):
        bodies = [body for body in data.split(SEPARATOR) if body]
        whole = b"".join(struct.pack("<4sII", b"TJR1", len(body), zlib.crc32(body)) + body for body in bodies)
        (folder / "a.journal").write_bytes(whole)
        return assemble(folder / "a.journal")

    return parse


def index(folder):
    """A reader of indices, and of all that their tables say of contacts."""

    def read(path):
        contacts = Index.read(path.parent).contacts
        return [(key, contacts.entries(i)) for i, key in enumerate(contacts)]

    return file_of(folder / INDEX, read)


def without_checksum(path):
    """An index without a checksum is read as that of an earlier version."""
    tree = json.loads(path.read_text())
    del tree["crc32"]
    return json.dumps(tree).encode()


def weights(path):
    for found in safetensors.read_header(path).values():
        if found.dtype in safetensors.DTYPES:
            safetensors.read_tensor(found)


def recording():
    """Bodies of the entries of a journal, joined by separators."""
    identity = dataclasses.asdict(Identity(sensor="tac3d", serial="A1", period_s=0.01))
    stream = {"identity": identity, "late_s": 0.0, "reader": {}, "drift": None}
    key = dataclasses.asdict(ContactKey(object_id="cup", site=0, motion="press", trial=0))
    start = {"key": key, "streams": [stream], "force_sensor": None, "target_n": 5.0, "contact_region_px": None}
    entries = [("start", start, {}), ("phase", {"time_ns": 0, "phase": 1}, {})]
    for k in range(3):
        plain = {"stream": 0, "time_ns": k * 10**7, "device_time_ns": k, "index": k}
        entries.append(("frame", plain, {"depth_mm": np.zeros((3, 3), np.float32), "force_n": np.zeros(3, np.float32)}))
    bodies = []
    for kind, plain, arrays in [*entries, ("end", {"complete": True, "counts": {}}, {})]:
        described = [[name, a.dtype.str, list(a.shape)] for name, a in arrays.items()]
        header = json.dumps({"kind": kind, "plain": plain, "arrays": described}).encode()
        bodies.append(struct.pack("<I", len(header)) + header + b"".join(a.tobytes() for a in arrays.values()))
    return SEPARATOR.join(bodies)


def calibration(folder):
    made = Calibration(
        sensor="gelsight_mini",
        mm_per_px=0.05,
        background=np.full((4, 6, 3), 90, np.uint8),
        colours=ColourMap(weights=np.zeros((1, 9, 2), np.float32), degree=2, position_degree=0),
        made_from={},
    )
    made.save(folder / "calibration.npz")
    return (folder / "calibration.npz").read_bytes()


@pytest.fixture(scope="module")
def parsers(tmp_path_factory):
    """Name → function of bytes, bytes that it reads, errors that it documents."""
    folder = tmp_path_factory.mktemp("mutated")
    arrays, array = io.BytesIO(), io.BytesIO()
    np.savez(arrays, a=np.arange(6.0), b=np.array("text"))
    np.save(array, np.arange(12.0).reshape(3, 4))
    frame = {"frame_bgr": np.zeros((4, 5, 3), np.uint8), "resultant": np.zeros(6)}
    described = [{"name": n, "dtype": a.dtype.str, "shape": a.shape} for n, a in frame.items()]
    header = json.dumps({"number": 1, "stamp_ns": 5, "arrays": described}).encode()
    tensors = {"a.weight": np.ones((2, 3), np.float32), "b": np.zeros(4, jnp.bfloat16)}
    configuration = file_of(folder / "checkpoint" / CONFIG_FILE, lambda path: read_config(path.parent))
    message = {**pushed([0, 0, -1], [0, 0, 0]), "InitializeProgress": np.array([[100.0]])}
    poses = {"timestamps": [0.0, 0.5], "poses": np.eye(3), "n": np.float64(2)}
    fakes.write(folder / "records", 2)
    shutil.copytree(folder / "records", folder / "index")  # the tables that the mutated root states
    (folder / "checkpoint").mkdir()
    return {
        "Tac3D": (tac3d, SEPARATOR.join(datagrams(message)), UserError),
        "Net F/T": (netft.parse_calibration, NEWTONS, UserError),
        "bridge": (bridge_frame, header + SEPARATOR + b"".join(a.tobytes() for a in frame.values()), UserError),
        "sequence": (entry(decode_sequence), encode_sequence(fakes.sequence(length=3))[8:], UserError),
        "card": (entry(decode_card), encode_card(fakes.card())[8:], UserError),
        "journal": (journal(folder), recording(), UserError),
        "index": (index(folder / "index"), without_checksum(folder / "records" / INDEX), UserError),
        "index of version 2": (index(folder / "index"), without_checksum(VERSION_2), UserError),
        "npz": (file_of(folder / "a.npz", load_arrays), arrays.getvalue(), UserError),
        "npy": (file_of(folder / "a.npy", load_arrays), array.getvalue(), UserError),
        "calibration": (file_of(folder / "c.npz", Calibration.load), calibration(folder), UserError),
        "pickle": (file_of(folder / "a.pkl", read_pickle), pickle.dumps(poses, 2), PickleError),
        "safetensors": (
            file_of(folder / "a.safetensors", weights),
            written(folder, "b.safetensors", lambda path: safetensors.write_file(path, tensors)),
            ValueError,
        ),
        "configuration": (configuration, json.dumps(PUBLISHED).encode(), ValueError),
        "Qwen3 configuration": (configuration, json.dumps(qwen3_json(SHAPES[0])).encode(), ValueError),
        "tokenizer": (
            file_of(folder / "tokenizer.json", tokenizer.from_file),
            written(folder, "t.json", lambda path: trained_bpe(TOUCH_LANGUAGE).save(str(path))),
            ValueError,
        ),
        "JSON Lines": (file_of(folder / "a.jsonl", read_lines), b'{"id": "a", "level": 2}\n{"id": "b"}\n', ValueError),
    }


@pytest.mark.parametrize("name", NAMES)
def test_a_parser_answers_any_bytes_by_a_value_or_a_documented_error(parsers, name):
    parse, data, documented = parsers[name]
    parse(data)
    shaped = name in ("index", "configuration", "tokenizer", "index of version 2", "Qwen3 configuration")
    check_parser(name, NAMES.index(name), parse, data, documented, shaped=shaped)


@contextlib.contextmanager
def viewer():
    with LiveView(port=0) as view:
        yield view.address


@contextlib.contextmanager
def demo():
    saved = types.SimpleNamespace(notes={"name": "stub"}, sensors=("xense",))
    with demo_server(types.SimpleNamespace(saved=saved, attributes={}, name="stub"), port=0) as address:
        yield address


@pytest.mark.parametrize(
    ("served", "good"),
    [
        (viewer, b"GET /panel/a HTTP/1.1\r\nHost: localhost\r\nCookie: token=x\r\nConnection: close\r\n\r\n"),
        (demo, b"POST /video?name=a.avi&sensor=xense HTTP/1.1\r\nHost: localhost\r\nContent-Length: 4\r\n\r\nRIFF"),
    ],
    ids=["viewer", "demo"],
)
def test_a_server_answers_any_request(served, good, capsys):
    rng = np.random.default_rng(22)
    with served() as address:
        port = urllib.parse.urlsplit(address).port
        for _ in range(1_000):
            with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
                connection.sendall(mutated(rng, good))
                connection.shutdown(socket.SHUT_WR)
                with contextlib.suppress(ConnectionResetError):  # refused before all of it was read
                    while connection.recv(65_536):
                        pass
        with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
            connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            assert connection.recv(15).endswith(b" 200 OK")
    assert "Traceback" not in capsys.readouterr().err
