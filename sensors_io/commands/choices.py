"""Devices as the command line names them, one after the other with a + between, and how a command is stopped."""

import contextlib
import dataclasses
import signal
import threading
from collections.abc import Iterator
from collections.abc import Sequence as Seq
from types import FrameType
from typing import Annotated, Any, TypeVar

import tyro

from sensors_io.devices.base import Device
from sensors_io.devices.bridge import BridgeConfig
from sensors_io.devices.errors import DeviceNotFoundError
from sensors_io.devices.netft import NetFtConfig
from sensors_io.devices.reader import Reader, ReaderConfig
from sensors_io.devices.replay import ReplayConfig
from sensors_io.devices.rgbd_camera import RgbdCameraConfig
from sensors_io.devices.scene import SceneDeviceConfig
from sensors_io.devices.tac3d import Tac3dConfig
from sensors_io.devices.uvc import UvcConfig
from sensors_io.signals import ENDING, Ended

TactileConfig = UvcConfig | Tac3dConfig | BridgeConfig | ReplayConfig | SceneDeviceConfig
AnyConfig = TactileConfig | NetFtConfig | RgbdCameraConfig

AnyDevice = (
    Annotated[UvcConfig, tyro.conf.subcommand("uvc")]
    | Annotated[Tac3dConfig, tyro.conf.subcommand("tac3d")]
    | Annotated[BridgeConfig, tyro.conf.subcommand("bridge")]
    | Annotated[ReplayConfig, tyro.conf.subcommand("replay")]
    | Annotated[SceneDeviceConfig, tyro.conf.subcommand("scene")]
    | Annotated[NetFtConfig, tyro.conf.subcommand("netft")]
    | Annotated[RgbdCameraConfig, tyro.conf.subcommand("rgbd")]
)

_FORCE_CAPACITY = 8192  # readings: a second at the 7 kHz of a Net F/T


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bench:
    """A command on devices; several are joined by a + of its own: uvc --serial S + tac3d + netft --host H."""

    device: AnyDevice
    """The first device; more follow, each after a +."""
    more: tyro.conf.Suppress[tyro.conf.Fixed[tuple[Any, ...]]] = ()
    """Those after the first."""

    def parts(self) -> "Parts":
        """The devices by what they are for."""
        return Parts.of((self.device, *self.more))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parts:
    """Devices of a bench by what they are for."""

    tactile: tuple[TactileConfig, ...]
    force: NetFtConfig | None
    view: RgbdCameraConfig | None

    @classmethod
    def of(cls, configs: Seq[AnyConfig]) -> "Parts":
        """Sort devices.

        Raises:
          DeviceNotFoundError: two force sensors, or two cameras that look at the object.
        """
        force = [c for c in configs if isinstance(c, NetFtConfig)]
        view = [c for c in configs if isinstance(c, RgbdCameraConfig)]
        for name, found in (("force sensors", force), ("RGB-D cameras", view)):
            if len(found) > 1:
                raise DeviceNotFoundError(f"{len(found)} {name} are named: at most one can be used; leave one out")
        tactile = tuple(c for c in configs if not isinstance(c, NetFtConfig | RgbdCameraConfig))
        return cls(tactile=tactile, force=force[0] if force else None, view=view[0] if view else None)

    def require_tactile(self) -> None:
        """Refuse a bench without a tactile sensor.

        Raises:
          DeviceNotFoundError: there is none.
        """
        if not self.tactile:
            raise DeviceNotFoundError("no tactile sensor is named: give one, such as uvc --product 'GelSight Mini'")


SomeCommand = TypeVar("SomeCommand")


def with_devices(command: SomeCommand, others: Seq[Seq[str]]) -> SomeCommand:
    """The command with the devices of the sections behind its own.

    Raises:
      DeviceNotFoundError: the command takes one device or none.
    """
    if not others:
        return command
    if not isinstance(command, Bench):
        raise DeviceNotFoundError(f"{type(command).__name__.lower()} takes no device after a +; leave them out")
    configs = [tyro.cli(AnyDevice, args=o, prog="…  +", config=(tyro.conf.OmitArgPrefixes,)) for o in others]
    return dataclasses.replace(command, more=tuple(configs))


def opened(config: AnyConfig) -> Device:
    """The device of a config, not open yet."""
    return config.open()


@contextlib.contextmanager
def readers(configs: Seq[AnyConfig], *, numbers: bool = False) -> Iterator[list[Reader]]:
    """Readers of devices, open, each in a thread of its own.

    Args:
      configs: of the devices.
      numbers: that no pictures are expected, and thousands of samples are kept.

    Raises:
      DeviceNotFoundError: one is absent, or two have one name.
    """
    with contextlib.ExitStack() as stack:
        made = []
        for config in configs:
            many = numbers or isinstance(config, NetFtConfig)
            keep = ReaderConfig(capacity=_FORCE_CAPACITY) if many else ReaderConfig()
            made.append(stack.enter_context(Reader(opened(config), config=keep)))
        names = [reader.identity.sensor for reader in made]
        if len(set(names)) != len(names):
            raise DeviceNotFoundError(
                f"devices are {names}: each name once; name cameras apart, such as --sensor gelsight_mini.left; of two "
                "Tac3D sensors, or two replays of records, leave one out"
            )
        yield made


@contextlib.contextmanager
def stop_on_interrupt() -> Iterator[threading.Event]:
    """An event that a signal sets, so that a command ends its work; a second one tears it out, as a device may hang."""
    stop = threading.Event()

    def handle(number: int, frame: FrameType | None) -> None:
        del frame
        if stop.is_set():
            raise Ended(number)
        stop.set()

    heard = [signal.SIGINT, *(n for n in ENDING if signal.getsignal(n) is not signal.SIG_IGN)]
    before = {number: signal.signal(number, handle) for number in heard}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
