"""Tiny recordings with known content."""

import pathlib

import numpy as np

from sensors_io.records import RecordsMeta, RecordWriter
from sensors_io.schema import SENSORS, ContactKey, ObjectCard, Sequence

META = RecordsMeta(source="fake", licence="none", config_hash="c0ffee", sensors=SENSORS)
SPLIT_OF = ("train", "train", "val", "test")


def card(n: int = 0, **changes) -> ObjectCard:
    """Object n, with a grey view and levels that follow from n."""
    values = {
        "object_id": f"object_{n}",
        "split": SPLIT_OF[n % len(SPLIT_OF)],
        "labels": {"hardness": n % 3, "roughness": (n + 1) % 3, "protrusion": (n + 2) % 3, "material": n % 9},
        "annotator": "nobody",
        "view": np.full((10, 12, 3), 10 * n % 256, np.uint8),
        "view_depth_mm": np.full((10, 12), 500.5 + n, np.float32),
    }
    return ObjectCard(**values | changes)


def sequence(n: int = 0, sensor: str = "gelsight_mini", length: int = 12, trial: int = 0, **changes) -> Sequence:
    """A press of object n to 20 N, `length` frames of 16 × 20 px and fields of 5 × 6; Tac3D without frames."""
    rng = np.random.default_rng([n, trial, length, SENSORS.index(sensor)])
    ramp = np.linspace(0, 1, length, dtype=np.float32)
    noise = rng.normal(0, 0.01, (length, 5, 6, 2)).astype(np.float32)
    values = {
        "key": ContactKey(object_id=f"object_{n}", site=0, motion="press", trial=trial),
        "sensor": sensor,
        "serial": f"serial-{n}",
        "camera": {"gain": 2, "white": [1.0, 0.5]},
        "contact_region_px": (1, 2, 3, 4),
        "mm_per_px": 0.0634,
        "frames": None if sensor == "tac3d" else rng.integers(0, 256, (length, 16, 20, 3), dtype=np.uint8),
        "deformation_mm": ramp[:, None, None, None] * 0.3 + noise,
        "depth_mm": np.ascontiguousarray(np.broadcast_to(ramp[:, None, None] * 1.2, (length, 5, 6))),
        "valid": rng.random((length, 5, 6)) < 0.9,
        "force_n": np.stack([0 * ramp, 0 * ramp, -20 * ramp], axis=1),
        "host_time_ns": np.arange(length, dtype=np.int64) * 40_000_000,
        "phase": np.ones(length, np.uint8),
        "flags": np.zeros(length, np.uint32),
    }
    return Sequence(**values | changes)


def write(
    path: pathlib.Path, contacts: int = 8, *, per_shard: int = 3, sensors: tuple[str, ...] = SENSORS
) -> pathlib.Path:
    """Records of `contacts` contacts, two trials of each object, by all sensors."""
    with RecordWriter(path, meta=META, contacts_per_shard=per_shard) as writer:
        for i in range(contacts):
            if i % 2 == 0:
                writer.write_object(card(i // 2))
            writer.write_contact([sequence(i // 2, sensor, trial=i % 2) for sensor in sensors])
    return path
