"""Devices as the command line names them, and how a command is told to stop."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Annotated

import tyro

from sensors_io.devices.base import Device
from sensors_io.devices.bridge import BridgeConfig
from sensors_io.devices.netft import NetFtConfig
from sensors_io.devices.replay import ReplayConfig
from sensors_io.devices.scene import SceneDeviceConfig
from sensors_io.devices.tac3d import Tac3dConfig
from sensors_io.devices.uvc import UvcConfig

Tactile = (
    Annotated[UvcConfig, tyro.conf.subcommand("uvc")]
    | Annotated[Tac3dConfig, tyro.conf.subcommand("tac3d")]
    | Annotated[BridgeConfig, tyro.conf.subcommand("bridge")]
    | Annotated[ReplayConfig, tyro.conf.subcommand("replay")]
    | Annotated[SceneDeviceConfig, tyro.conf.subcommand("scene")]
)
Force = Annotated[NetFtConfig, tyro.conf.subcommand("netft")] | Annotated[None, tyro.conf.subcommand("no-force")]


def opened(config: UvcConfig | Tac3dConfig | BridgeConfig | ReplayConfig | SceneDeviceConfig | NetFtConfig) -> Device:
    """The device of a config, not open yet."""
    return config.open()


@contextlib.contextmanager
def stop_on_interrupt() -> Iterator[threading.Event]:
    """An event that Ctrl-C sets, so that a command ends its work instead of being torn out of it."""
    stop = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        del number, frame
        stop.set()

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)
