"""Fields in the live view: of which sensor, and what cannot be shown."""

import pathlib
from collections.abc import Sequence as Seq

from sensors_io.commands.console import OUT
from sensors_io.devices.reader import Reader
from sensors_io.fields.extract import Extractor
from sensors_io.fields.sources import read_picture
from sensors_io.fields.types import Calibration
from sensors_io.viewer.presenter import Channel


class Extraction:
    """Settings of live field extraction in `view` and `record`: the first sensor, from a picture of its gel at rest.

    Args:
      background: that picture; `None` extracts nothing.
      calibration: of its colours; `None` leaves depth out.
      mm_per_px: pitch, where neither calibration nor device states it.
    """

    def __init__(self, background: pathlib.Path | None, calibration: pathlib.Path | None, mm_per_px: float):
        self._background, self._calibration, self._mm_per_px = background, calibration, mm_per_px

    def channels(self, devices: Seq[Reader]) -> list[Channel]:
        """One channel of the page for every device."""
        return [Channel(device, self.extractor(device) if i == 0 else None) for i, device in enumerate(devices)]

    def extractor(self, device: Reader) -> Extractor | None:
        if self._background is None:
            return None
        calibration = None if self._calibration is None else Calibration.load(self._calibration)
        pitch = device.identity.mm_per_px or self._mm_per_px
        if calibration is not None:
            calibration.require_sensor(device.identity.sensor)
            pitch = calibration.mm_per_px
        extractor = Extractor(read_picture(self._background), pitch, calibration)
        for reason in extractor.refused:
            OUT.print(f"not shown: {reason}", highlight=False)
        return extractor
