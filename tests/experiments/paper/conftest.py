"""A tiny released checkpoint, and the policy that is built on it for the session's records."""

import dataclasses

import jax.numpy as jnp
import pytest

from experiments.paper.tiny_checkpoint import write_tiny
from experiments.study.dataset import open_dataset
from sensors_io.pipeline import ClipConfig
from tests.experiments import tiny
from touchr1_jax.models.load import load_checkpoint
from touchr1_jax.models.lora import LoraConfig
from touchr1_jax.models.released_policy import ReleasedModel, build_released_policy, instruction
from touchr1_jax.models.touch_policy import with_lora
from touchr1_jax.text.language import TOUCH_LANGUAGE

MODEL = ReleasedModel(
    tactile=tiny.MODEL.tactile,
    frames=tiny.MODEL.frames,
    image_px=tiny.MODEL.image_px,
    completion_tokens=48,
    view_px=16,
    dtype="float32",
)


LORA = LoraConfig(rank=2, alpha=4.0, vision_targets=("qkv", "merger_in"))


@pytest.fixture(scope="session")
def weights(tmp_path_factory):
    directory = tmp_path_factory.mktemp("released")
    write_tiny(directory, TOUCH_LANGUAGE, instruction(TOUCH_LANGUAGE))
    return directory


@pytest.fixture(scope="session")
def checkpoint(weights):
    return load_checkpoint(weights, jnp.float32)


@pytest.fixture(scope="session")
def streamed(records):
    """The session's records, of which no clip stays in memory."""
    clip = ClipConfig(frames=MODEL.frames, image_px=MODEL.image_px, view_px=MODEL.view_px)
    return dataclasses.replace(open_dataset(records, clip, 0.35), threads=2)


@pytest.fixture(scope="session")
def policy(checkpoint, streamed):
    return with_lora(build_released_policy(MODEL, checkpoint, streamed.clip.sensors), LORA)
