"""What a vendor's SDK may do: print to standard output, give frames, fail.  Runs in the bridge's process."""

import time

import numpy as np


def frames(serial):
    """Three frames, or as many as the serial says; "fails" raises, no reader takes "objects", "µs" and "wall"."""
    print("vendor banner on standard output", flush=True)  # noqa: T201
    if serial == "fails":
        raise RuntimeError("no such sensor")
    if serial == "objects":
        yield time.monotonic_ns(), 0, {"a": np.array([None])}
        return
    if serial in ("µs", "wall"):
        yield time.monotonic_ns() // 1000 if serial == "µs" else time.time_ns(), 0, {}
        return
    for n in range(int(serial or 3)):
        picture = np.full((2, 3, 3), n, np.uint8)
        picture[..., 2] = 200  # red, in the SDK's BGR
        yield (
            time.monotonic_ns(),
            np.int64(n),
            {"frame_bgr": picture, "depth_mm": np.full((2, 3), 0.5 * n), "resultant": np.arange(6.0), "shear_mm": None},
        )
