"""Cameras of this machine, as the kernel describes them."""

import dataclasses
import pathlib

SYSFS = pathlib.Path("/sys/class/video4linux")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraInfo:
    """One capture node, as the kernel describes it.

    Args:
      node: such as /dev/video0.
      product, serial: strings of the USB device; empty where it has none.
      usb_id: vendor and product number, such as "0c45:636d".
      interface: number of the USB interface, which distinguishes the cameras of one device; `None` where it has none.
    """

    node: str
    product: str
    serial: str
    usb_id: str
    interface: int | None = None

    def __str__(self) -> str:
        interface = "" if self.interface is None else f", interface {self.interface}"
        return f"{self.node} {self.product!r} serial {self.serial or 'none'} ({self.usb_id or 'not USB'}{interface})"


def find_cameras(sysfs: pathlib.Path = SYSFS) -> tuple[CameraInfo, ...]:
    """All capture nodes of this machine, in the order of their numbers; metadata nodes are left out."""
    nodes = sorted(sysfs.glob("video*"), key=lambda p: int(p.name.removeprefix("video")))
    return tuple(_describe(node) for node in nodes if _line(node / "index") in ("", "0"))


def _describe(node: pathlib.Path) -> CameraInfo:
    usb = (node / "device").resolve().parent  # node/device is the USB interface, its parent the device
    numbers = [_line(usb / name) for name in ("idVendor", "idProduct")]
    interface = _line(node / "device" / "bInterfaceNumber")
    return CameraInfo(
        node=f"/dev/{node.name}",
        product=_line(usb / "product") or _line(node / "name"),
        serial=_line(usb / "serial"),
        usb_id=":".join(numbers) if all(numbers) else "",
        interface=int(interface, 16) if interface else None,
    )


def _line(path: pathlib.Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace").strip() if path.is_file() else ""
