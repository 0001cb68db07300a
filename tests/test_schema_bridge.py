"""The NumPy record of a clip and the JAX batch type are one schema, though neither package knows the other."""

import dataclasses
import typing

import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from beartype import beartype

from sensors_io.pipeline import ClipConfig, make_clip
from sensors_io.schema import ATTRIBUTES, CLIP_ARRAYS, LEVELS, SENSORS
from tests.sensors_io.fakes import card, sequence
from touchr1_jax.text.language import TOUCH_LANGUAGE
from touchr1_jax.types import TouchBatch

FIELDS = [field.name for field in dataclasses.fields(TouchBatch)]
HINTS = typing.get_type_hints(TouchBatch)
CONFIG = ClipConfig(frames=4, image_px=8, view_px=6)


@jaxtyping.jaxtyped(typechecker=beartype)
@dataclasses.dataclass(frozen=True)
class Checked:
    """The fields of `TouchBatch`, checked together when it is made."""

    frames: HINTS["frames"]
    force_n: HINTS["force_n"]
    frame_index: HINTS["frame_index"]
    frame_mask: HINTS["frame_mask"]
    stream_mask: HINTS["stream_mask"]
    view: HINTS["view"]
    view_mask: HINTS["view_mask"]
    label: HINTS["label"]


def stored_hint(name: str) -> typing.Any:
    """Annotation of an array as it is stored; an encoder may read statistics in the place of frames."""
    return (typing.get_args(HINTS[name]) or (HINTS[name],))[0]


def clips(**changes) -> dict[str, np.ndarray]:
    """Arrays of two real clips, stacked; the second lacks a sensor and its view."""
    one = make_clip({s: sequence(0, s) for s in SENSORS}, card(0), CONFIG)
    two = make_clip({s: sequence(1, s) for s in SENSORS[1:]}, card(1, view=None), CONFIG)
    return {name: np.stack([one.arrays()[name], two.arrays()[name]]) for name in CLIP_ARRAYS} | changes


def on_device(arrays: dict[str, np.ndarray]) -> dict[str, jnp.ndarray]:
    return {name: jnp.asarray(value) for name, value in arrays.items()}


def test_names_and_order_agree():
    assert list(CLIP_ARRAYS) == FIELDS


@pytest.mark.parametrize("name", FIELDS)
def test_dimensions_agree_after_the_leading_p(name):
    assert tuple(stored_hint(name).dim_str.split()) == ("P", *CLIP_ARRAYS[name].dims)


@pytest.mark.parametrize("name", FIELDS)
def test_dtypes_agree(name):
    """JAX keeps the stored dtype, and the annotation allows it."""
    stored = np.dtype(CLIP_ARRAYS[name].dtype)
    assert stored.name in stored_hint(name).dtypes
    assert jnp.asarray(np.zeros(1, stored)).dtype == stored


def test_no_clip_array_is_optional():
    assert not any(spec.optional for spec in CLIP_ARRAYS.values())


def test_a_real_clip_batch_is_a_touch_batch():
    arrays = on_device(clips())
    Checked(**arrays)
    batch = TouchBatch(**arrays)
    assert batch.frames.shape == (2, len(SENSORS), 4, 8, 8, 3)
    np.testing.assert_array_equal(batch.stream_mask, [[True] * 4, [False, True, True, True]])
    np.testing.assert_array_equal(batch.view_mask, [True, False])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("frames", np.zeros((2, 4, 4, 8, 8, 4), np.uint8)),
        ("frames", np.zeros((2, 4, 4, 8, 8, 3), np.float32)),
        ("force_n", np.zeros((2, 4, 5, 3), np.float32)),  # F differs
        ("frame_index", np.zeros((2, 4, 4), np.float32)),
        ("stream_mask", np.zeros((2, 3), bool)),  # S differs
        ("view_mask", np.zeros((2, 1), bool)),
        ("label", np.zeros((3, 4), np.int32)),  # P differs
    ],
)
def test_the_check_refuses_what_breaks_the_schema(name, value):
    with pytest.raises(jaxtyping.TypeCheckError):
        Checked(**on_device(clips(**{name: value})))


def test_language_and_schema_name_the_same_attributes_levels_and_sensors():
    assert tuple(a.name for a in TOUCH_LANGUAGE.attributes) == ATTRIBUTES
    assert {a.name: len(a.levels) for a in TOUCH_LANGUAGE.attributes} == dict(LEVELS)
    assert tuple(s.name for s in TOUCH_LANGUAGE.sensors) == SENSORS
