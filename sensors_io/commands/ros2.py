"""`python -m sensors_io ros2`."""

import array
import contextlib
import dataclasses
import importlib
import pathlib
import time
from typing import Any

import numpy as np

from sensors_io.commands.choices import Bench, readers, stop_on_interrupt
from sensors_io.commands.console import OUT
from sensors_io.commands.extraction import Extraction
from sensors_io.devices.base import Sample
from sensors_io.devices.errors import StreamEndedError
from sensors_io.errors import UserError
from sensors_io.exporters.ros import touch_messages
from sensors_io.fields.extract import Extractor

_QUEUE = 10  # messages that wait for a slow subscriber
_WAIT_S = 0.005


class RosError(UserError):
    """No ROS 2 in this environment."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ros2(Bench):
    """Publish sensors as topics of ROS 2, until Ctrl-C; needs a shell in which ROS 2 was sourced.

    Topics are /touch/<sensor>/image, depth (with `--calibration`) and wrench.  Devices are joined by a + of its own:
    ros2 uvc --product "GelSight Mini" + tac3d + netft --host H.
    """

    node: str = "touch"
    """Name of the node."""
    background: pathlib.Path | None = None
    """Picture of the gel at rest: with a calibration, depth of the first camera is published too."""
    calibration: pathlib.Path | None = None
    """Calibration from `calibrate`."""
    mm_per_px: float = 0.0634
    """Millimetres per pixel if neither calibration nor device states them; default: a GelSight Mini at 320 × 240."""
    seconds: float = 0.0
    """If > 0, stop after this time."""

    def run(self) -> int:
        rclpy = _ros("rclpy")
        parts = self.parts()
        with contextlib.ExitStack() as stack:
            stop = stack.enter_context(stop_on_interrupt())
            devices = stack.enter_context(readers(parts.tactile))
            devices = [*devices, *stack.enter_context(readers((parts.force,) if parts.force else ()))]
            extraction = Extraction(self.background, self.calibration, self.mm_per_px)
            extractors = [extraction.extractor(device) if i == 0 else None for i, device in enumerate(devices)]
            rclpy.init()
            stack.callback(rclpy.shutdown)
            node = rclpy.create_node(self.node)
            stack.callback(node.destroy_node)
            publisher = TouchPublisher(node)
            OUT.print(
                f"publishing /touch/{{{','.join(d.identity.sensor for d in devices)}}}, Ctrl-C ends", markup=False
            )
            end_s = time.monotonic() + self.seconds if self.seconds else float("inf")
            with contextlib.suppress(StreamEndedError):
                while not stop.is_set() and time.monotonic() < end_s:
                    for device, extractor in zip(devices, extractors, strict=True):
                        for sample in device.drain():
                            publisher.publish(device.identity.sensor, sample, extractor)
                    stop.wait(_WAIT_S)
        OUT.print(f"published {publisher.count} messages", highlight=False)
        return 0


class TouchPublisher:
    """Publisher of the samples of devices.

    Args:
      node: of rclpy.
    """

    def __init__(self, node: Any):
        self._node, self._publishers = node, dict[str, Any]()
        self.count = 0

    def publish(self, sensor: str, sample: Sample, extractor: Extractor | None = None) -> None:
        """Publish a sample, stamped by ROS's clock with the time of its grab."""
        stamp_ns = self._node.get_clock().now().nanoseconds - (time.monotonic_ns() - sample.host_time_ns)
        arrays: dict[str, np.ndarray | None] = dict(sample.arrays)
        if sample.frame is not None and sample.frame.ndim == 3:
            arrays["frames"] = sample.frame
            if extractor is not None:
                fields = extractor.read(sample.frame)
                arrays |= {} if fields.depth_mm is None else {"depth_mm": fields.depth_mm[0]}
        for said in touch_messages(sensor, stamp_ns, arrays, ros_message):
            if said.topic not in self._publishers:
                self._publishers[said.topic] = self._node.create_publisher(_ros_type(said.kind), said.topic, _QUEUE)
            self._publishers[said.topic].publish(said.message)
            self.count += 1


def ros_message(kind: str, **fields: Any) -> Any:
    """A message of a type such as sensor_msgs/msg/Image; bytes as the array that rclpy copies at once."""
    plain = {name: array.array("B", x.tobytes()) if isinstance(x, np.ndarray) else x for name, x in fields.items()}
    return _ros_type(kind)(**plain)


def _ros_type(kind: str) -> Any:
    package, _, name = kind.partition("/msg/")
    return getattr(_ros(f"{package}.msg"), name)


def _ros(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise RosError(
            f"{module} cannot be imported ({error}): the shell must know ROS 2; source /opt/ros/<distribution>/"
            "setup.bash and run Python of that distribution"
        ) from error
