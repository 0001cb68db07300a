"""Failures of one frame: each condition alone raises its own bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sensors_io.scenes import failures
from sensors_io.schema import Flag

X = ((np.arange(40) + 0.5) * 0.4 - 8.0).astype(np.float32)
ZERO = np.zeros((40, 40), np.float32)
SATURATED, BORDER = jax.jit(failures.saturated), jax.jit(failures.border_contact)
LOST, LOSS = jax.jit(failures.lost_markers), jax.jit(failures.marker_loss)


@pytest.mark.parametrize("end", [0, 255])
def test_a_clipped_patch_saturates_and_a_few_pixels_do_not(end: int) -> None:
    picture = np.full((112, 112, 3), 128, np.uint8)
    picture[:7, :7, 1] = end  # 49 of 12,544 pixels
    assert not SATURATED(picture)
    picture[:8, :8, 1] = end
    assert SATURATED(picture)


C, S = np.cos(0.6), np.sin(0.6)


@pytest.mark.parametrize(
    ("x", "y", "depth", "lost"),
    [
        *((strain * X[None], strain * X[:, None], 0, lost)  # area (1 + strain)²
          for strain, lost in ((-0.2, False), (-0.3, True), (0.3, False), (0.45, True))),
        ((C - 1) * X[None] - S * X[:, None], S * X[None] + (C - 1) * X[:, None], 0, False),  # a rotation
        (0.8 * X[:, None], 0, 0, False),  # a shear
        (0, 0, 0.95 * X[None], False),  # slopes about 45°
        (0, 0, 1.05 * X[None], True),
    ],
)  # fmt: skip
def test_markers_are_lost_where_their_seen_area_leaves_the_range_or_a_slope_hides_them(x, y, depth, lost) -> None:
    found = np.asarray(LOST(ZERO + x, ZERO + y, ZERO + depth, 0.4))
    assert bool(found.all()) == bool(found.any()) == lost


def test_marker_loss_counts_nodes() -> None:
    valid = np.arange(400).reshape(20, 20) >= 20  # 5 %
    assert not LOSS(valid)
    valid[1, 0] = False
    assert LOSS(valid)


@pytest.mark.parametrize("at", [(0, 7), (39, 7), (7, 0), (7, 39)])
def test_contact_at_any_border_is_seen(at: tuple[int, int]) -> None:
    pressure = np.pad(np.ones((38, 38), np.float32), 1)
    assert not BORDER(pressure)
    pressure[at] = 1e-6
    assert BORDER(pressure)


def test_every_failure_has_its_own_bit_and_works_compiled() -> None:
    names = ("saturated", "marker_loss", "border_contact")
    want = (Flag.SATURATED, Flag.MARKER_LOSS, Flag.BORDER_CONTACT)
    frames = jnp.eye(3, dtype=bool)
    found = jax.jit(lambda f: failures.flags(**dict(zip(names, f, strict=True))))(frames)
    assert [Flag(int(bits)) for bits in found] == list(want)
    assert found.dtype == jnp.uint32
    assert int(failures.flags(saturated=True, marker_loss=True, border_contact=True)) == sum(want)
