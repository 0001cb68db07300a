"""Runs a vendor's SDK in the vendor's own Python and sends what it gives as frames over standard output.

    VENDOR_PYTHON bridge_server.py xense OG000232
    VENDOR_PYTHON bridge_server.py dmtac S2508080042
    VENDOR_PYTHON bridge_server.py my_module:my_function ARGUMENT

Needs Python 3.8 and the vendor's SDK; nothing of this project is imported.  A frame is

    magic (4 bytes) | length of the header (u32) | length of the payload (u32) | header (JSON) | payload

little-endian; the header names number, stamp (ns, monotonic, taken right after the SDK returned), serial, and the type,
shape and unit-bearing name of every array, whose bytes follow one another in the payload.  The SDKs print to standard
output, so that it is handed to the frames alone and everything else goes to standard error.
"""

import importlib
import json
import os
import struct
import sys
import time

MAGIC = b"TBR1"
PREFIX = struct.Struct("<4sII")


def xense(serial):
    """Frames of a Xense sensor by xensesdk: rectified picture (BGR), depth, forces."""
    sdk = importlib.import_module("xensesdk").Sensor
    sensor = sdk.create(serial)
    kinds = sdk.OutputType
    try:
        while True:
            picture, depth, resultant = sensor.selectSensorInfo(kinds.Rectify, kinds.Depth, kinds.ForceResultant)
            stamp = time.monotonic_ns()
            yield stamp, {"frame_bgr": picture, "depth_mm": depth, "resultant": resultant}
    finally:
        sensor.release()


def dmtac(serial):
    """Frames of a DM-Tac sensor by dmrobotics: raw picture, deformation, shear, depth."""
    sensor = importlib.import_module("dmrobotics").Sensor(serial)
    try:
        while True:
            picture = sensor.getRawImage()
            stamp = time.monotonic_ns()
            yield (
                stamp,
                {
                    "frame_bgr": picture,
                    "deformation_mm": sensor.getDeformation2D(),
                    "shear_mm": sensor.getShear(),
                    "depth_mm": sensor.getDepth(),
                },
            )
    finally:
        sensor.disconnect()


ADAPTERS = {"xense": xense, "dmtac": dmtac}


def pack(number, stamp_ns, serial, arrays):
    """One frame as bytes.

    Args:
      number: counts from 0.
      stamp_ns: monotonic.
      serial: of the unit.
      arrays: name → anything with `dtype.str`, `shape` and `tobytes()`; `None` values are left out.
    """
    given = {name: array for name, array in arrays.items() if array is not None}
    described = [{"name": n, "dtype": a.dtype.str, "shape": list(a.shape)} for n, a in given.items()]
    header = json.dumps({"number": number, "stamp_ns": stamp_ns, "serial": serial, "arrays": described}).encode()
    payload = b"".join(a.tobytes() for a in given.values())
    return PREFIX.pack(MAGIC, len(header), len(payload)) + header + payload


def find(name):
    """The generator function that gives (stamp, arrays): an adapter of this file, or `module:function`."""
    if name in ADAPTERS:
        return ADAPTERS[name]
    module, _, function = name.partition(":")
    if not function:
        raise SystemExit(f"adapter is {name!r}: must be {', '.join(ADAPTERS)} or module:function")
    return getattr(importlib.import_module(module), function)


def main(adapter, serial):
    """Send frames until the reader goes away."""
    out = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    try:
        for number, (stamp_ns, arrays) in enumerate(find(adapter)(serial)):
            data = memoryview(pack(number, stamp_ns, serial, arrays))
            while data:
                data = data[out.write(data) :]
    except BrokenPipeError:
        pass  # the reader has closed its end: that is how it says stop
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    sys.path.insert(0, os.getcwd())
    sys.exit(main(*sys.argv[1:]))
