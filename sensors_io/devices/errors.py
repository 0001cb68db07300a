"""Errors of devices; every message names the device, the problem and the fix."""

from sensors_io.errors import UserError


class DeviceError(UserError, RuntimeError):
    """A device that does not do what it is asked for."""


class DeviceNotFoundError(DeviceError):
    """No such device: not plugged in, not powered, another serial."""


class DeviceLostError(DeviceError):
    """A device that was open and has stopped working; opening it again may help."""


class DeviceTimeoutError(DeviceError):
    """A device that is there and gave no sample in time."""


class DeviceDataError(DeviceError):
    """Bytes that break the device's protocol."""


class StaleFrameError(DeviceError):
    """The newest sample is older than asked for."""


class StreamEndedError(DeviceError):
    """A replay has come to its end."""


class OutOfViewError(DeviceError, ValueError):
    """A contact that a camera does not see."""


class SettingRefusedWarning(UserWarning):
    """A camera setting that could not be locked at the value asked for."""


class OverloadWarning(UserWarning):
    """The consumer falls behind: samples were overwritten before anybody read them."""


class WrongRateWarning(UserWarning):
    """A device that sends at another rate than it was said to, or whose clock runs at another."""


class TwoSendersWarning(UserWarning):
    """Two programs that send as one device."""
