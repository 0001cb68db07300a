"""The gel of an imported source, which its files do not state: pitch and picture at rest, kept with the records."""

import dataclasses
import hashlib
import pathlib

import cv2
import numpy as np

from sensors_io.contents import RESTS, put_rest_pictures
from sensors_io.importers.keep import ImportSourceError, UnreadableError
from sensors_io.importers.pictures import read_picture
from sensors_io.schema import Sequence

_REST = "rest.png"


@dataclasses.dataclass(frozen=True, kw_only=True)
class SourceGel:
    """Pitch and gel at rest of the pictures as they are published, at their own size.

    Args:
      mm_per_px: millimetres per pixel; `None` where unknown.
      background: picture file of the gel at rest; `None` where there is none.
    """

    mm_per_px: float | None = None
    background: pathlib.Path | None = None

    def __post_init__(self) -> None:
        if self.mm_per_px is not None and not 0 < self.mm_per_px < 1:
            raise ImportSourceError(f"mm_per_px is {self.mm_per_px}: must lie in (0, 1); give millimetres per pixel")

    @property
    def known(self) -> bool:
        """True if anything is."""
        return self.mm_per_px is not None or self.background is not None

    def require_one_sensor(self, sensors: tuple[str, ...]) -> None:
        """Refuse one gel for several sensors.

        Raises:
          ImportSourceError: naming them.
        """
        if self.known and len(sensors) != 1:
            raise ImportSourceError(
                f"--mm-per-px and --background are of one gel, the source has {', '.join(sensors)}: leave them out, "
                "and give them to `check` and `extract`"
            )

    def identity(self, of_source: str) -> str:
        """Hash of a source's identity and of what is kept with it; that of the source where nothing is."""
        if not self.known:
            return of_source
        picture = b"" if self.background is None else self._picture().tobytes()
        return hashlib.sha256(f"{of_source} {self.mm_per_px}".encode() + picture).hexdigest()[:16]

    def store(self, out: pathlib.Path) -> None:
        """Write the picture of the gel at rest into the folder of the records.

        Raises:
          ImportSourceError: it cannot be read.
          OSError: it cannot be written.
        """
        if self.background is None:
            return
        _, data = cv2.imencode(".png", cv2.cvtColor(self._picture(), cv2.COLOR_RGB2BGR))
        put_rest_pictures(out, {_REST: data.tobytes()})

    def kept(self, sequence: Sequence) -> Sequence:
        """The sequence with its gel; the pitch is that of its pictures as they were brought to their height."""
        if not self.known or sequence.frames is None:
            return sequence
        camera, pitch = dict(sequence.camera), sequence.mm_per_px
        if self.mm_per_px is not None:
            pitch = self.mm_per_px * camera.get("size_px", sequence.frames.shape[1:3])[0] / sequence.frames.shape[1]
        if self.background is not None:
            camera["recording"] = {"background": f"{RESTS}/{_REST}"}
        return dataclasses.replace(sequence, camera=camera, mm_per_px=pitch)

    def _picture(self) -> np.ndarray:
        assert self.background is not None
        try:
            return read_picture(self.background)
        except UnreadableError as error:
            raise ImportSourceError(f"{self.background} {error}: must be a whole picture; replace it") from error


NO_GEL = SourceGel()
"""Nothing is known of it."""
