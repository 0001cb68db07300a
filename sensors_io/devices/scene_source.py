"""A generated sensor as a source of samples; the only source that computes with JAX."""

import dataclasses
from collections.abc import Iterator

from sensors_io.clock import NS_PER_S
from sensors_io.devices.base import Identity
from sensors_io.devices.errors import DeviceNotFoundError
from sensors_io.devices.sources import Recorded
from sensors_io.scenes.config import SceneConfig
from sensors_io.scenes.protocol import slot
from sensors_io.scenes.sensors import MODELS
from sensors_io.scenes.sequence import make_sequence
from sensors_io.schema import FRAME_ARRAYS, SENSORS


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneSource:
    """Samples of one generated sensor for the contacts of a config, one after the other.

    Contacts past the strain limit are given as they are, flagged; a data set replaces them.

    Args:
      sensor: one of `schema.SENSORS`.
      config: which scenes.
      first: number of the first contact.

    Raises:
      DeviceNotFoundError: no such sensor is generated.
    """

    sensor: str = "gelsight_mini"
    config: SceneConfig = dataclasses.field(default_factory=SceneConfig)
    first: int = 0

    def __post_init__(self) -> None:
        if self.sensor not in SENSORS:
            raise DeviceNotFoundError(f"sensor is {self.sensor!r}: must be one of {', '.join(SENSORS)}; rename it")

    @property
    def identity(self) -> Identity:
        period_s = MODELS[SENSORS.index(self.sensor)].frame_period_ms / 1000
        return Identity(sensor=self.sensor, serial="generated", product="scene", where="scene", period_s=period_s)

    def samples(self) -> Iterator[Recorded]:
        period_ns = round((self.identity.period_s or 0) * NS_PER_S)
        order, count = SENSORS.index(self.sensor), 0
        for index in range(self.first, self.config.contact_count):
            made = make_sequence(self.config, index, slot(self.config, index), order, 0)
            arrays = {
                n: a
                for n in FRAME_ARRAYS
                if n not in ("frames", "host_time_ns") and (a := getattr(made, n)) is not None
            }
            for i in range(len(made)):
                frame = None if made.frames is None else made.frames[i]
                yield Recorded(
                    time_ns=count * period_ns, index=count, frame=frame, arrays={n: a[i] for n, a in arrays.items()}
                )
                count += 1
