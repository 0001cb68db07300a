"""The accelerator: whether there is one, and what its data sheet promises."""

import dataclasses

import jax

FLASH_PLATFORM = "gpu"
"""Platform of JAX that has NVIDIA's flash attention."""


class NoAccelerator(OSError):
    """JAX sees no GPU."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DataSheet:
    """Of a data sheet: dense bfloat16 operations a second, bytes of memory read a second."""

    flops: float
    read_bytes: float


SHEETS = {
    "H200": DataSheet(flops=989e12, read_bytes=4.8e12),
    "H100 PCIe": DataSheet(flops=756e12, read_bytes=2.0e12),
    "H100": DataSheet(flops=989e12, read_bytes=3.35e12),
    "A100": DataSheet(flops=312e12, read_bytes=2.0e12),
    "L40S": DataSheet(flops=362e12, read_bytes=0.864e12),
}
"""By what stands in the name that the driver gives, the first that fits; NVIDIA's data sheets."""


def sheet_of(kind: str) -> DataSheet | None:
    """The data sheet of a device by its name; `None` where it is not known."""
    return next((sheet for name, sheet in SHEETS.items() if name in kind), None)


def accelerator(*, anywhere: bool) -> jax.Device:
    """The first device.

    Args:
      anywhere: take a CPU too.

    Raises:
      NoAccelerator: it is no GPU.
    """
    device = jax.devices()[0]
    if device.platform != FLASH_PLATFORM and not anywhere:
        raise NoAccelerator(
            f"the first device is {device.device_kind} on {device.platform}: must be a GPU; install JAX with CUDA "
            '(pip install "jax[cuda12]") on a machine that has one, or try the code with --scale smoke'
        )
    return device
