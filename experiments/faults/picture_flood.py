"""An adapter of the bridge that gives pictures of noise as fast as they are taken, in place of a vendor's SDK."""

import time
from collections.abc import Iterator

import numpy as np

SHAPE = (480, 640, 3)
"""Of a picture: the cameras of Xense and DM-Tac."""


def frames(count: str) -> Iterator[tuple[int, int, dict[str, np.ndarray]]]:
    """So many pictures, stamped when they are made, as `bridge_server` wants them."""
    noise = np.random.default_rng(0).integers(0, 256, SHAPE, dtype=np.uint8)
    for n in range(int(count)):
        yield time.monotonic_ns(), n, {"frame_bgr": noise}
