"""The mesh description: what it counts and what it refuses."""

import jax
import pytest

from touchr1_jax.distributed.mesh import AXES, MeshConfig


def test_axes_multiply_to_the_devices():
    config = MeshConfig(data=2, fsdp=4, tensor=3)
    assert config.devices == 24
    assert dict(config.abstract().shape) == {"data": 2, "fsdp": 4, "tensor": 3}


def test_the_default_is_one_device():
    mesh = MeshConfig().build(jax.devices()[:1])
    assert mesh.axis_names == AXES
    assert mesh.devices.shape == (1, 1, 1)


def test_another_number_of_devices_is_an_error():
    with pytest.raises(ValueError, match=r"1 · 4 · 2 = 8: must be the number of devices, 1; change an axis"):
        MeshConfig(fsdp=4, tensor=2).build(jax.devices()[:1])


@pytest.mark.parametrize("axis", AXES)
def test_an_axis_without_devices_is_an_error(axis):
    with pytest.raises(ValueError, match=f"mesh {axis} is 0: must be at least 1"):
        MeshConfig(**{axis: 0})
