"""Touch as ROS 2 messages, the same for a bag and for the live node; a bag is written by the library rosbags.

    /touch/<sensor>/image    sensor_msgs/Image, rgb8
    /touch/<sensor>/depth    sensor_msgs/Image, 32FC1, indentation in m (REP 118)
    /touch/<sensor>/wrench   geometry_msgs/WrenchStamped, force on the gel in N, moment about the window's centre in N m
    /touch/<sensor>/flags    std_msgs/UInt32, bits of `schema.Flag`; of recordings alone

Frame `<sensor>` has x right, y down and z out of the gel towards the object, as everywhere in this package.
"""

import dataclasses
import pathlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from sensors_io.exporters.selection import ExportError, Progress, Selected, library, published
from sensors_io.schema import Sequence

Make = Callable[..., Any]
"""From a type's name, such as sensor_msgs/msg/Image, and its fields to a message."""

IMAGE, WRENCH, FLAGS = "sensor_msgs/msg/Image", "geometry_msgs/msg/WrenchStamped", "std_msgs/msg/UInt32"

_END_NS = 2**31 * 10**9  # of the times of ROS
APART_NS = 10**9
"""Between two contacts whose own times overlap, as those of imported and generated records do: each begins at 0."""

_VERSION = 9  # of rosbag2's metadata, that of Jazzy


@dataclasses.dataclass(frozen=True, kw_only=True)
class TopicMessage:
    """A message with its topic and type."""

    topic: str
    kind: str
    message: Any


def touch_messages(
    sensor: str, stamp_ns: int, arrays: Mapping[str, np.ndarray | None], make: Make
) -> Iterator[TopicMessage]:
    """Messages of one moment.

    Args:
      sensor: its name, in the topics and as the frame of reference.
      stamp_ns: time of the moment by ROS's clock.
      arrays: any of `frames` [H, W, 3] uint8, `depth_mm` [h, w], `force_n` [3], `moment_nmm` [3], `flags` [].
      make: of messages.
    """
    stamp = make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = make("std_msgs/msg/Header", stamp=stamp, frame_id=sensor)
    topic = f"/touch/{sensor}"
    frame, depth, force = (arrays.get(name) for name in ("frames", "depth_mm", "force_n"))
    if frame is not None:
        yield TopicMessage(topic=f"{topic}/image", kind=IMAGE, message=_image(header, frame, "rgb8", make))
    if depth is not None:
        in_metres = (depth * np.float32(1e-3)).astype("<f4")
        yield TopicMessage(topic=f"{topic}/depth", kind=IMAGE, message=_image(header, in_metres, "32FC1", make))
    if force is not None:
        moment = arrays.get("moment_nmm")
        in_nm = np.zeros(3) if moment is None else 1e-3 * moment.astype(np.float64)
        vector = lambda v: make("geometry_msgs/msg/Vector3", x=float(v[0]), y=float(v[1]), z=float(v[2]))
        wrench = make("geometry_msgs/msg/Wrench", force=vector(force), torque=vector(in_nm))
        yield TopicMessage(topic=f"{topic}/wrench", kind=WRENCH, message=make(WRENCH, header=header, wrench=wrench))
    flags = arrays.get("flags")
    if flags is not None:
        yield TopicMessage(topic=f"{topic}/flags", kind=FLAGS, message=make(FLAGS, data=int(flags)))


def export_rosbag(selected: Selected, out: pathlib.Path, progress: Progress) -> None:
    """Write contacts as a bag of ROS 2 (a folder, mcap), whole or not at all.

    Stamps are the recorded times; a contact that does not begin after the one before is put `APART_NS` behind it.

    Raises:
      ExportError: `out` exists, rosbags is not installed, or a time is beyond those of ROS.
    """
    typesys, rosbag2 = library("rosbags.typesys", "ros"), library("rosbags.rosbag2", "ros")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    make = lambda kind, **fields: store.types[kind](**fields)
    with published(out) as temporary:
        with rosbag2.Writer(temporary, version=_VERSION, storage_plugin=rosbag2.StoragePlugin.MCAP) as bag:
            connections: dict[str, Any] = {}
            end = -1
            for _, contact in selected.contacts(progress):
                start = min(int(sequence.host_time_ns.min()) for sequence in contact.values())
                later = 0 if start > end else end + APART_NS - start
                for stamp, sent in sorted(_moments(contact, later, make), key=lambda moment: moment[0]):
                    if (end := stamp) >= _END_NS:
                        raise ExportError(
                            f"a time is {stamp} ns: must be < {_END_NS}, those of ROS; leave it out by --contacts"
                        )
                    if sent.topic not in connections:
                        connections[sent.topic] = bag.add_connection(sent.topic, sent.kind, typestore=store)
                    bag.write(connections[sent.topic], stamp, store.serialize_cdr(sent.message, sent.kind))
        _rename(temporary, out.name)


def _moments(contact: Mapping[str, Sequence], later_ns: int, make: Make) -> Iterator[tuple[int, TopicMessage]]:
    names = ("frames", "depth_mm", "force_n", "moment_nmm", "flags")
    for sensor, sequence in contact.items():
        whole = {name: getattr(sequence, name) for name in names}
        for n, stamp in enumerate((sequence.host_time_ns + later_ns).tolist()):
            arrays = {name: None if array is None else array[n] for name, array in whole.items()}
            yield from ((stamp, sent) for sent in touch_messages(sensor, stamp, arrays, make))


def _rename(folder: pathlib.Path, name: str) -> None:
    """Give the bag's file its final name, which its metadata state."""
    [file] = folder.glob("*.mcap")
    metadata = folder / "metadata.yaml"
    text = metadata.read_text(encoding="utf-8").replace(file.name, f"{name}.mcap")
    metadata.write_text(text, encoding="utf-8")
    file.rename(folder / f"{name}.mcap")


def _image(header: Any, pixels: np.ndarray, encoding: str, make: Make) -> Any:
    data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
    height, width = pixels.shape[:2]
    return make(
        IMAGE,
        header=header,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=len(data) // height,
        data=data,
    )
