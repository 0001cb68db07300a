"""`python -m sensors_io devices`."""

import dataclasses

from rich.table import Table

from sensors_io.commands.console import OUT
from sensors_io.devices.base import Device
from sensors_io.devices.cameras import SYSFS, find_cameras
from sensors_io.devices.errors import DeviceNotFoundError
from sensors_io.devices.netft import NetFtConfig
from sensors_io.devices.tac3d import PORT, Tac3dConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class Devices:
    """List the cameras of this machine, whether a Tac3D is sending, and whether a Net F/T answers at its address."""

    tac3d_port: int = PORT
    """UDP port that the vendor's Tac3D program sends to."""
    netft_host: str | None = None
    """Address of a Net F/T force sensor; without one, none is queried."""
    wait_s: float = 1.0
    """Time to wait for each device."""

    def run(self) -> int:
        table = Table("device", "product", "serial", "at")
        cameras = find_cameras()
        if not cameras:
            table.add_row("camera", "absent", "–", f"none: {SYSFS} names no video device; look at its cable")
        for camera in cameras:
            interface = "" if camera.interface is None else f", interface {camera.interface}"
            where = f"{camera.node} ({camera.usb_id or 'not USB'}{interface})"
            table.add_row("camera", camera.product, camera.serial or "–", where)
        asked: dict[str, Device] = {"tac3d": Tac3dConfig(port=self.tac3d_port, wait_s=self.wait_s).open()}
        if self.netft_host is not None:
            asked["netft"] = NetFtConfig(host=self.netft_host, wait_s=self.wait_s).open()
        else:
            table.add_row("netft", "not asked", "–", "give its address by --netft-host")
        for name, device in asked.items():
            try:
                with device:
                    identity = device.identity
                    table.add_row(name, identity.product, identity.serial or "–", identity.where)
            except DeviceNotFoundError as absent:
                table.add_row(name, "absent", "–", str(absent))
        OUT.print(table)
        return 0
