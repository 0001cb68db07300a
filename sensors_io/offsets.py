"""Delay of each sensor's timestamps, measured once and subtracted from every recording."""

import dataclasses
import pathlib
from collections.abc import Iterable, Mapping
from typing import Self

from sensors_io.errors import MALFORMED, UserError, name_and_text
from sensors_io.json_files import read_json, write_json


class OffsetsError(UserError, ValueError):
    """A file that holds no offsets; the message says what to do about it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Offset:
    """By how much the stamps of one sensor lie behind those of the reference.

    Args:
      late_s: positive where the same moment is stamped later.
      spread_s: standard deviation of one tap; `None` where it came from presses.
      events: taps that both measured; 0 where it came from presses.
      by: "taps" or "presses".
      agreement: correlation of the rates of change, for presses; 1 for taps.
    """

    late_s: float
    spread_s: float | None
    events: int
    by: str
    agreement: float = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Offsets:
    """Offsets of several sensors against one reference.

    Args:
      reference: name of the sensor whose stamps are taken as they are.
      sensors: offsets by the names of the others.
    """

    reference: str
    sensors: Mapping[str, Offset]

    @property
    def late_s(self) -> dict[str, float]:
        """Delay to subtract from the timestamps of each sensor; 0 for the reference."""
        return {self.reference: 0.0} | {name: offset.late_s for name, offset in self.sensors.items()}

    def require(self, names: Iterable[str], path: pathlib.Path | None) -> None:
        """Refuse sensors whose delay was not measured, which would be taken as 0.

        Raises:
          OffsetsError: naming them and the file of the offsets.
        """
        unknown = [name for name in names if name not in self.late_s]
        if unknown:
            raise OffsetsError(f"{path} knows nothing of {', '.join(unknown)}; measure again with `sync --out`")

    def save(self, path: pathlib.Path) -> None:
        """Write them as JSON, whole or not at all."""
        write_json(path, dataclasses.asdict(self))

    @classmethod
    def load(cls, path: pathlib.Path) -> Self:
        """Read what `save` wrote.

        Raises:
          OffsetsError: there is no such file, or a field is missing or of another kind.
        """
        try:
            tree = read_json(path)
            sensors = {str(name): Offset(**offset) for name, offset in tree["sensors"].items()}
            late_s = [offset.late_s for offset in sensors.values()]
            if not all(abs(late) <= LARGEST_S for late in late_s):
                raise ValueError(f"late_s are {late_s}: must lie within ±{LARGEST_S} s")
            return cls(reference=str(tree["reference"]), sensors=sensors)
        except (OSError, *MALFORMED) as error:
            raise OffsetsError(f"{path} holds no offsets ({name_and_text(error)}); make them with `sync`") from error


LARGEST_S = 2.0
"""Of an offset that a camera or a vendor's program may have; more is a mistake."""
