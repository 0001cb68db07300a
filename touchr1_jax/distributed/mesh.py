"""The mesh: how many devices share the batch, the parameters and the matrix products of a layer."""

import dataclasses
import math
from collections.abc import Sequence

import jax
from jax.sharding import AbstractMesh, AxisType, Mesh

DATA, FSDP, TENSOR = "data", "fsdp", "tensor"
"""Names of the mesh's axes, slowest first: neighbours on the last axis exchange most."""

AXES = (DATA, FSDP, TENSOR)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MeshConfig:
    """A mesh of data · fsdp · tensor devices; the defaults are one device.

    Prompts are split over data and fsdp.  Parameters and optimizer state are whole along data, so that it suits slow
    links between machines; they are split along fsdp and gathered where they are used (ZeRO-3, arXiv 1910.02054), to
    sample once before the first token, and split along tensor for good, each device computing its heads and hidden
    channels (Megatron-LM, arXiv 1909.08053).

    Raises:
      ValueError: an axis of less than one device.
    """

    data: int = 1
    fsdp: int = 1
    tensor: int = 1

    def __post_init__(self) -> None:
        for name, size in zip(AXES, self.shape, strict=True):
            if size < 1:
                raise ValueError(f"mesh {name} is {size}: must be at least 1; 1 leaves the axis out")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Devices along each of `AXES`."""
        return self.data, self.fsdp, self.tensor

    @property
    def devices(self) -> int:
        """Devices of the mesh."""
        return math.prod(self.shape)

    def build(self, devices: Sequence[jax.Device] | None = None) -> Mesh:
        """The mesh of these devices; by default of all devices of all processes.

        Raises:
          ValueError: another number of devices.
        """
        found = jax.devices() if devices is None else list(devices)
        if len(found) != self.devices:
            raise ValueError(
                f"mesh data · fsdp · tensor is {self.data} · {self.fsdp} · {self.tensor} = {self.devices}: must be the "
                f"number of devices, {len(found)}; change an axis"
            )
        return jax.make_mesh(self.shape, AXES, (AxisType.Auto,) * len(AXES), devices=found)

    def abstract(self) -> AbstractMesh:
        """The mesh without devices, for questions about placement alone."""
        return AbstractMesh(self.shape, AXES, (AxisType.Auto,) * len(AXES))
