"""The generated scenes as a live device: every contact in turn, at the rate of the sensor that sees it."""

import dataclasses

from sensors_io.clock import Clock
from sensors_io.devices.replay import Replay
from sensors_io.scenes.config import SceneConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneDeviceConfig:
    """A generated sensor as a device.

    Args:
      sensor: one of `schema.SENSORS`.
      scenes: which scenes.
    """

    sensor: str = "gelsight_mini"
    scenes: SceneConfig = dataclasses.field(default_factory=SceneConfig)

    def open(self, clock: Clock | None = None) -> Replay:
        """The device, not open yet; it ends after the last contact.

        Raises:
          DeviceNotFoundError: no such sensor is generated.
        """
        from sensors_io.devices.scene_source import SceneSource  # JAX, which no other device needs

        return Replay(SceneSource(sensor=self.sensor, config=self.scenes), clock=clock)
