"""One set of tiny generated records for the session, and what the stages make of it."""

import io

import pytest
from rich.console import Console

from experiments.core.context import Context
from experiments.study.dataset import open_dataset
from experiments.study.sources import scenes_folder
from sensors_io.generate import generate_records
from sensors_io.pipeline import ClipConfig
from tests.experiments import tiny
from touchr1_jax.models.touch_policy import build_policy


@pytest.fixture(scope="session")
def cache_dir(tmp_path_factory):
    """A data cache that holds the tiny scenes already."""
    path = tmp_path_factory.mktemp("data")
    generate_records(tiny.SCENES, scenes_folder(path, tiny.SCENES))
    return path


@pytest.fixture(scope="session")
def records(cache_dir):
    return scenes_folder(cache_dir, tiny.SCENES)


@pytest.fixture(scope="session")
def data(records):
    clip = ClipConfig(frames=tiny.MODEL.frames, image_px=tiny.MODEL.image_px, view_px=tiny.MODEL.vision.image_px)
    return open_dataset(records, clip, 0.35)


@pytest.fixture(scope="session")
def policy(data):
    return build_policy(tiny.MODEL, data.clip.sensors)


@pytest.fixture(scope="session")
def params(policy, data):
    return tiny.params(policy, data)


@pytest.fixture
def console():
    return Console(file=io.StringIO(), width=120)


@pytest.fixture
def context(tmp_path, console):
    directory = tmp_path / "run"
    directory.mkdir()
    context = Context(directory, tmp_path / "cache", console)
    yield context
    context.close()
