"""Runs a vendor's SDK in the vendor's own Python and sends what it gives as frames over standard output.

    VENDOR_PYTHON bridge_server.py xense OG000232
    VENDOR_PYTHON bridge_server.py dmtac S2508080042
    VENDOR_PYTHON bridge_server.py my_module:my_function ARGUMENT

Needs Python 3.8 and the vendor's SDK; nothing of this project is imported, nor NumPy.  A frame is

    magic (4 bytes) | length of the header (u32) | length of the payload (u32) | header (JSON) | payload

little-endian; the header names number, stamp (ns, monotonic, taken right after the SDK returned), serial, and the type,
shape and unit-bearing name of every array, whose bytes follow one another in the payload.  The SDKs print to standard
output, so that it is handed to the frames alone and everything else goes to standard error.  Standard input is only
held: when it ends, whoever reads the frames is gone, and so is the server, however silent its SDK.

An adapter is a generator function of one argument that yields (stamp, number or None, name → array), the stamp by
`time.monotonic_ns()`, the fields on one grid.  The number is the SDK's own count of frames; without one, losses are
found by the period and repeats by equal pictures.
"""

import _thread
import importlib
import json
import operator
import os
import struct
import sys
import threading
import time

MAGIC = b"TBR1"
PREFIX = struct.Struct("<4sII")
_NOTICE_S = 0.5  # for a frame that finds the pipe closed
_RELEASE_S = 2.0  # for an SDK to let its sensor go


def xense(serial):
    """Frames of a Xense sensor by xensesdk 1.4 to 2: rectified picture, depth in mm, resultant.

    As documented in github.com/XenseRobotics/xensesdk and xensedoc.readthedocs.io.  They call the picture RGB, but
    their own examples show and write it by OpenCV as it comes: it is taken as BGR.  The resultant has no stated unit.
    """
    sdk = vendor("xensesdk").Sensor
    sensor = sdk.create(serial or 0)
    kinds = sdk.OutputType
    try:
        while True:
            picture, depth, resultant = sensor.selectSensorInfo(kinds.Rectify, kinds.Depth, kinds.ForceResultant)
            stamp = time.monotonic_ns()
            yield stamp, None, {"frame_bgr": picture, "depth_mm": depth, "resultant": resultant}
    finally:
        sensor.release()


def dmtac(serial):
    """Frames of a DM-Tac sensor by dmrobotics, whose interface changed with `SensorOptions` (1.2)."""
    sdk = vendor("dmrobotics")
    return dmtac_by_options(sdk, serial) if hasattr(sdk, "SensorOptions") else dmtac_by_serial(sdk, serial)


def dmtac_by_options(sdk, serial):
    """dmrobotics from 1.2: every getter gives (number, data), every channel is off unless it is asked for.

    Fields in mm; getForce is Fx Fy Fz in N, Mx My Mz in 10⁻² N m (the vendor's development manual 2.0).
    """
    options = sdk.SensorOptions(
        dev_id=serial or 0,
        enable_raw=True,
        enable_deformation=True,
        enable_depth=True,
        enable_shear=True,
        enable_force=True,
    )
    sensor = sdk.Sensor(options)
    number = -1
    try:
        while True:
            if not sensor.wait_for_new(number, timeout_ms=500):
                continue
            stamp = time.monotonic_ns()
            number, depth = sensor.getDepth()
            _, picture = sensor.getRawImg()
            yield (
                stamp,
                number,
                {
                    "frame_bgr": picture.img,
                    "deformation_mm": sensor.getDeformation2D()[1],
                    "shear_mm": sensor.getShear()[1],
                    "depth_mm": depth,
                    "resultant_n_cnm": sensor.getForce()[1],
                },
            )
    finally:
        sensor.disconnect()


def dmtac_by_serial(sdk, serial):
    """dmrobotics before 1.2: getters give arrays, and the last frame again where there is no new one."""
    sensor = sdk.Sensor(serial or 0)
    try:
        while True:
            picture = sensor.getRawImage()
            stamp = time.monotonic_ns()
            yield (
                stamp,
                None,
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


def vendor(module):
    """The vendor's SDK, or an end that says which Python lacks it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise SystemExit(
            f"{sys.executable} (Python {sys.version.split()[0]}) cannot import {module}: {error}; install the vendor's "
            "SDK in it, or name the Python that has it"
        ) from error


def pack(number, stamp_ns, serial, arrays):
    """One frame as bytes.

    Args:
      number: the SDK's count, or None.
      stamp_ns: monotonic.
      serial: of the unit.
      arrays: name → anything with `dtype.str`, `shape` and `tobytes()`; `None` values are left out.
    """
    given = {name: array for name, array in arrays.items() if array is not None}
    described = [{"name": n, "dtype": a.dtype.str, "shape": list(a.shape)} for n, a in given.items()]
    tree = {"number": number, "stamp_ns": stamp_ns, "serial": serial, "arrays": described}
    header = json.dumps(tree, default=operator.index).encode()  # numbers may be NumPy's
    payload = b"".join(a.tobytes() for a in given.values())
    return PREFIX.pack(MAGIC, len(header), len(payload)) + header + payload


def find(name):
    """The adapter of a name: one of this file, or `module:function`."""
    if name in ADAPTERS:
        return ADAPTERS[name]
    module, _, function = name.partition(":")
    if not function:
        raise SystemExit(f"adapter is {name!r}: must be {', '.join(ADAPTERS)} or module:function")
    return getattr(vendor(module), function)


def end_with_reader(ending):
    """Wait until standard input ends, then stop the SDK in its main thread, and end without it if it does not stop.

    Args:
      ending: event that is set once the main thread is ending by itself.
    """
    while os.read(0, 1):
        pass
    if not ending.wait(_NOTICE_S):
        _thread.interrupt_main()
    time.sleep(_RELEASE_S)
    os._exit(1)


def main(adapter, serial):
    """Send frames until the reader goes away."""
    out = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    ending = threading.Event()
    threading.Thread(target=end_with_reader, args=(ending,), daemon=True).start()
    frames = find(adapter)(serial)
    try:
        for stamp_ns, number, arrays in frames:
            data = memoryview(pack(number, stamp_ns, serial, arrays))
            while data:
                data = data[out.write(data) :]
    except (BrokenPipeError, KeyboardInterrupt):
        pass  # the reader has closed its end: that is how it says stop
    finally:
        ending.set()
        frames.close()
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        raise SystemExit(__doc__)
    sys.path.insert(0, os.getcwd())
    sys.exit(main(*sys.argv[1:]))
