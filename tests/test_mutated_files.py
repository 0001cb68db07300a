"""Files that people, models and runs leave, mutated at random: a documented error or a value.

With `test_mutated_inputs`, every parser of bytes from outside is tried.
"""

import functools
import hashlib
import io
import json

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.core.artifacts import DamagedFileError
from experiments.core.runs import read_run
from experiments.faults.trainings.small_study import MODEL
from sensors_io.calibration.geometry import CameraGeometry
from sensors_io.commands import label
from sensors_io.errors import UserError
from sensors_io.importers.hdf5 import HDF5Config, list_hdf5
from sensors_io.importers.hdf5_inspect import inspect
from sensors_io.importers.keep import ImportSourceError, Keep
from sensors_io.importers.octopi import list_octopi
from sensors_io.importers.physiclear import read_labels
from sensors_io.importers.pictures import read_picture
from sensors_io.importers.video import read_video
from sensors_io.offsets import Offsets
from sensors_io.poses import ForceZero
from tests.mutations import check_parser, file_of, written
from tests.sensors_io.importers.films import film, picture
from tests.sensors_io.importers.test_hdf5 import mapped, trial, write_map
from tests.touchr1_jax.bench.sample_items import items
from touchr1_jax.bench.people.audit import read_key
from touchr1_jax.bench.people.sheets import read_sheet
from touchr1_jax.models.pretrained import PretrainedEncoder, load_encoder
from touchr1_jax.models.qwen import config as qwen_config
from touchr1_jax.models.qwen import safetensors
from touchr1_jax.models.qwen.pictures import read_budget
from touchr1_jax.models.qwen.weights import find_tensors
from touchr1_jax.models.saved_policy import CHECKSUM, PolicyInput, SavedPolicy, read_policy, save_policy
from touchr1_jax.models.tactile_vit import TactileViTConfig
from touchr1_jax.models.touch_policy import build_policy, touch_shapes
from touchr1_jax.text.chat import check_template

NAMES = (
    "geometry", "offsets", "force zero", "labels", "PhysiCLeAR", "Octopi", "sheet", "audit key", "picture budget",
    "chat template", "weights' index", "encoder", "run", "policy", "picture", "video", "HDF5 map", "HDF5",
)  # fmt: skip
PLAIN = ("labels", "sheet", "picture", "video", "HDF5")
"""Those that are not JSON."""

pytestmark = pytest.mark.slow


def run(path):
    found = read_run(path.parent)
    return found.summary, found.in_use


def octopi(path):
    """One sample, which is left out and named where its description is damaged."""
    skipped = list_octopi(path.parents[1], Keep()).skipped
    if skipped:
        raise ImportSourceError(str(skipped))


def hdf5(folder):
    """Readers of a mapping and of an HDF5 file, and what they read."""
    folder.mkdir()
    path, layout = folder / "a.h5", mapped()
    with h5py.File(path, "w") as file:
        trial(file.create_group("trials/0"))

    def read(data_map):
        found = list_hdf5(folder, HDF5Config(map=data_map))
        if found.skipped:
            raise ImportSourceError(str(found.skipped))
        for contact in found.contacts:
            contact.read()

    def parse(data):
        path.write_bytes(data)
        inspect([path])
        read(write_map(folder, layout))

    whole = path.read_bytes()
    return (file_of(folder / "other.json", read), json.dumps(layout).encode()), (parse, whole)


def encoder(path):
    """A reader of encoders, given what their file says of itself."""
    entries = {"norm/scale": np.ones(16, np.float32)}
    whole = PretrainedEncoder(config=TactileViTConfig(sensors=1), sensors=("xense",), params={}).to_bytes()
    with np.load(io.BytesIO(whole)) as file:
        (about,) = file.files
        text = file[about].tobytes()

    def parse(data):
        with path.open("wb") as file:
            np.savez(file, **{about: np.frombuffer(data, np.uint8)}, **entries)
        load_encoder(path)

    return parse, text


def policy(folder):
    """A reader of saved policies, given their configuration, which is signed where it is JSON at all."""
    shapes = touch_shapes(MODEL, MODEL.vision.image_px, ("xense",))
    made = build_policy(MODEL, ("xense",))
    params = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(functools.partial(made.init, 0), shapes)
    )
    save_policy(folder, SavedPolicy(policy=made, params=params, reads=PolicyInput(), notes={"name": "tiny"}))
    path = folder / "config.json"

    def parse(data):
        try:
            tree = json.loads(data)
            digest = hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()
            data = json.dumps(tree | {CHECKSUM: digest}).encode()
        except (ValueError, TypeError):
            pass
        path.write_bytes(data)
        read_policy(folder)

    whole = json.loads(path.read_text())
    whole.pop(CHECKSUM)
    return parse, json.dumps(whole).encode()


@pytest.fixture(scope="module")
def parsers(tmp_path_factory):
    """Name → function of bytes, bytes that it reads, errors that it documents."""
    folder = tmp_path_factory.mktemp("mutated")
    return {**files_of_people(folder), **files_of_models(folder)}


def files_of_people(folder):
    """Parsers of what people write, film and measure."""
    for name in ("octopi/1", "run"):
        (folder / name).mkdir(parents=True)
    mug = {"object": "mug", "name": "a mug", "split": "train", "hardness": 1, "roughness": 0, "bumps": 2}
    ratings = {"hardness": 3, "roughness": 7.5}
    rated = {"object_id": "mug", "split": "train", "properties": ratings, "exploratory_procedure": "pressing"}
    size = {"size_px": [4, 6], "centre_px": [3, 2], "radial": [0, 0], "homography": np.eye(3).tolist()}
    late = {"xense": {"late_s": 0.01, "spread_s": 0.001, "events": 3, "by": "taps", "agreement": 1.0}}
    zero = {"bias_n": [0, 0, 1], "bias_nmm": [0, 0, 0], "weight_n": 1.0, "first_moment_nmm": [0, 0, 3]}
    begun = {
        "experiment": "a",
        "scale": "default",
        "config": {"steps": 1},
        "command": "x",
        "git": {"commit": "a1", "dirty": False},
    }
    levels = {"hardness": ["soft", "hard"], "bumps": ["few", "many"]}
    sheet = lambda path: read_sheet(path, "object", levels, ["mug", "pen"])
    plain = lambda tree: json.dumps(tree).encode()
    made = {name: written(folder, name, picture) for name in ("a.jpg", "a.png")}
    layout, recordings = hdf5(folder / "hdf5")
    return {
        "HDF5 map": (*layout, ValueError),
        "HDF5": (*recordings, ValueError),
        "geometry": (
            file_of(folder / "geometry.json", CameraGeometry.load),
            plain(size | {"rms_mm": 0.1, "held_out_mm": 0.1}),
            UserError,
        ),
        "offsets": (file_of(folder / "o.json", Offsets.load), plain({"reference": "a", "sensors": late}), UserError),
        "force zero": (
            file_of(folder / "z.json", ForceZero.load),
            plain(zero | {"rms_n": 0.1, "rms_nmm": 0.1, "poses": 8, "down": [0, 0, -1]}),
            ValueError,
        ),
        "labels": (
            file_of(folder / "l.csv", lambda path: label.read_labels(path, "object_id")),
            b"object_id,hardness\nmug,1\npen,2\n",
            UserError,
        ),
        "PhysiCLeAR": (
            file_of(folder / "labels.json", read_labels),
            plain({"objects": [mug | {"material": "rubber", "videos": ["a.avi"]}]}),
            UserError,
        ),
        "Octopi": (file_of(folder / "octopi" / "1" / "data.json", octopi), plain(rated), UserError),
        "sheet": (
            file_of(folder / "s.csv", sheet),
            b"object,hardness,bumps\nmug,soft,few\npen,hard,many\n",
            ValueError,
        ),
        "audit key": (
            file_of(folder / "k.json", lambda path: read_key(path, items())),
            plain({str(i): one.ask.id for i, one in enumerate(items())}),
            ValueError,
        ),
        "run": (file_of(folder / "run" / "config.json", run), plain(begun), DamagedFileError),
        "picture": (file_of(folder / "b.jpg", read_picture), made["a.jpg"], ValueError),
        "video": (
            file_of(folder / "b.avi", lambda path: read_video(path, Keep())),
            film(folder / "a.avi").read_bytes(),
            ValueError,
        ),
    }


def files_of_models(folder):
    """Parsers of what a published model or a policy consists of."""
    for name in ("sharded", "checkpoint"):
        (folder / name).mkdir()
    safetensors.write_file(folder / "sharded" / "1.safetensors", {"a": np.zeros(3, np.float32)})
    sizes = qwen_config.QwenVisionConfig(out_size=64)
    shards = json.dumps({"metadata": {}, "weight_map": {"a": "1.safetensors"}}).encode()
    index_file = folder / "sharded" / "model.safetensors.index.json"
    budget = json.dumps(
        {"patch_size": 14, "merge_size": 2, "size": {"shortest_edge": 3136, "longest_edge": 9999}}
    ).encode()
    found = (OSError, ValueError)
    return {
        "picture budget": (
            file_of(folder / "checkpoint" / "preprocessor_config.json", lambda path: read_budget(path.parent, sizes)),
            budget,
            found,
        ),
        "chat template": (
            file_of(
                folder / "checkpoint" / "tokenizer_config.json", lambda path: check_template(path.parent, "qwen2_5_vl")
            ),
            json.dumps({"chat_template": "{% for %}", "model_max_length": 10}).encode(),
            found,
        ),
        "weights' index": (file_of(index_file, lambda path: find_tensors(path.parent)), shards, found),
        "encoder": (*encoder(folder / "e.npz"), ValueError),
        "policy": (*policy(folder / "policy"), ValueError),
    }


@pytest.mark.parametrize("name", NAMES)
def test_a_parser_answers_any_file_by_a_value_or_a_documented_error(parsers, name):
    parse, data, documented = parsers[name]
    if name != "chat template":  # whose published text is no part of this repository
        parse(data)
    check_parser(name, 100 + NAMES.index(name), parse, data, documented, shaped=name not in PLAIN)
