"""All fields of a sensor's pictures in one call, and flags for what a picture cannot carry."""

import dataclasses
import warnings
from typing import Any, Literal

import cv2
import numpy as np

from sensors_io.fields.compliance import NodeGrid
from sensors_io.fields.contact import ContactConfig, ContactRegions, changed_contacts, steepest_change
from sensors_io.fields.deformation import DeformationReader
from sensors_io.fields.depth import DepthReader, ZeroConfig
from sensors_io.fields.evidence import Pattern, examine
from sensors_io.fields.inversion import InverseConfig
from sensors_io.fields.shear import ShearReader
from sensors_io.fields.types import Calibration, CalibrationError, Fields
from sensors_io.layer import Layer
from sensors_io.quality import QualityConfig, saturated
from sensors_io.schema import Flag, SchemaError, Spec, check_arrays

_OTHER_GEL_LEVELS = 15.0
"""Three Minis differ by 4 to 6 levels; swapped channels, a turned picture or 1.2 × the light by 20 to 29."""


class OtherGelWarning(UserWarning):
    """Pictures whose gel at rest looks unlike that of their calibration."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExtractConfig:
    """Settings of the extraction.

    Args:
      nodes: of the vector fields along the longer side of the picture.
      gel: modulus, Poisson ratio and thickness; the modulus scales the forces.
      marker_depth_mm: of the pattern below the surface.
      inverse: how loads are computed; `gradient_free` off suits a gel whose thickness and Poisson ratio are known well.
      shear: `modelled` gives what the traction makes by the gel's compliance; `subtracted` the deformation less what
        the pressure makes, which supposes less of the traction and keeps the noise.
      zero, contact, quality: of depth, contact mask and saturation.
    """

    nodes: int = 24
    gel: Layer = dataclasses.field(default_factory=lambda: Layer(modulus_mpa=0.37, poisson=0.48, thickness_mm=4.5))
    marker_depth_mm: float = 0.5
    inverse: InverseConfig = dataclasses.field(default_factory=InverseConfig)
    shear: Literal["modelled", "subtracted"] = "modelled"
    zero: ZeroConfig = dataclasses.field(default_factory=ZeroConfig)
    contact: ContactConfig = dataclasses.field(default_factory=ContactConfig)
    quality: QualityConfig = dataclasses.field(default_factory=QualityConfig)

    def __post_init__(self) -> None:
        if self.nodes < 4:
            raise ValueError(f"nodes is {self.nodes}: must be ≥ 4; the inversion needs a grid")


class Extractor:
    """Reads depth, contact, deformation, shear and force of one sensor, frame by frame in the order of time.

    Depth and, with it, shear and force need a calibration; deformation, shear and force need a pattern in the gel.  A
    field that the input cannot carry is `None`, and every frame is flagged `REFUSED`.

    Args:
      background: the gel at rest, uint8 [H, W, 3] RGB.
      mm_per_px: pitch.
      calibration: of the colours, `None` without one.
      config: settings.

    Raises:
      CalibrationError: a calibration of another picture size or pitch.
      SchemaError: a background that is not an RGB picture or is too small; a pitch that is not positive.
    """

    def __init__(
        self,
        background: np.ndarray,
        mm_per_px: float,
        calibration: Calibration | None = None,
        config: ExtractConfig | None = None,
    ):
        check_arrays({"background": Spec(np.uint8, ("H", "W", "3"))}, {"background": background}, "extraction")
        if not 0 < mm_per_px < 1:
            raise SchemaError(f"mm_per_px is {mm_per_px}: must lie in (0, 1); give millimetres per pixel")
        self.background, self.mm_per_px = background, mm_per_px
        self.config = config or ExtractConfig()
        self.evidence = examine(cv2.cvtColor(background, cv2.COLOR_RGB2GRAY))
        self._depth = None if calibration is None else self._depth_reader(calibration)
        self._deformation: DeformationReader | None = None
        self._shear: ShearReader | None = None
        self.grid_mm: tuple[float, float] | None = None
        if self.evidence.pattern is not Pattern.BARE:
            self._make_vector_readers()

    @property
    def refused(self) -> tuple[str, ...]:
        """The fields that this sensor cannot carry, and why, one sentence each."""
        reasons = []
        if self._depth is None:
            reasons.append("depth_mm: without a calibration, colours do not show slopes; make one with `calibrate`")
        if self._deformation is None:
            reasons.append(f"deformation_mm, shear_mm: {self.evidence.reason}; use a gel with markers")
        elif self._shear is None:
            reasons.append("shear_mm: needs depth_mm, from which the pressure is computed")
        return tuple(reasons)

    @property
    def judged(self) -> tuple[Flag, ...]:
        """The flags that a picture may be given: without depth none is for want of a zero level, and so on."""
        always = (Flag.NO_CONTACT, Flag.BORDER_CONTACT, Flag.SEVERAL_CONTACTS, Flag.SATURATED, Flag.REFUSED)
        of_depth = () if self._depth is None else (Flag.NO_ZERO_LEVEL,)
        return (*always, *of_depth, *(() if self._deformation is None else (Flag.MARKER_LOSS,)))

    def read(self, picture: np.ndarray, *, gap: bool = False, apart: bool = False) -> Fields:
        """Fields of one picture, uint8 [H, W, 3] RGB, as `Fields` of one frame.

        Args:
          picture: of the same crop as the background.
          gap: whether frames are missing before it: flagged `TIME_GAP`, and markers are looked for anywhere.
          apart: whether nothing says that it follows the picture before, as with stills: markers are looked for
            anywhere, whatever was read before, with no flag.

        Raises:
          SchemaError: a picture of another shape than the background.
        """
        if picture.shape != self.background.shape:
            shapes = f"{list(picture.shape)}: must be {list(self.background.shape)}"
            raise SchemaError(f"the picture has shape {shapes}, as the gel at rest; crop both alike")
        surface = None if self._depth is None else self._depth.read(picture)
        depth = None if surface is None else surface.depth_mm
        contacts = self._contacts(picture) if surface is None else surface.contacts
        found: dict[str, np.ndarray] = {} if depth is None else {"depth_mm": depth}
        flags = self._flags(picture, contacts) | (Flag.TIME_GAP if gap else Flag.NONE)
        if surface is not None and not surface.zero_known:
            flags |= Flag.NO_ZERO_LEVEL
        if self._deformation is not None:
            moved = self._deformation.read(picture, gap, apart)
            flags |= moved.flags
            found["deformation_mm"] = moved.displacement_mm
            if self._shear is not None and depth is not None:
                found |= self._split(moved.displacement_mm, depth, contacts, moved.valid)
        return Fields(
            contact=contacts.mask[None],
            flags=np.array([flags], np.uint32),
            mm_per_px=self.mm_per_px,
            grid_mm=self.grid_mm,
            **{name: array[None].astype(np.float32) for name, array in found.items()},
        )

    def extract(self, frames: np.ndarray) -> Fields:
        """Fields of N stills uint8 [N, H, W, 3] RGB, of which none follows another; `ValueError` if there is none."""
        if frames.ndim != 4 or not len(frames):
            raise ValueError(f"frames have shape {list(frames.shape)}: must be [N, H, W, 3] with N ≥ 1; stack them")
        return joined([self.read(frame, apart=True) for frame in frames])

    def _contacts(self, picture: np.ndarray) -> ContactRegions:
        """Contacts by colour, where there is no depth."""
        return changed_contacts(picture, self.background, self.mm_per_px, self.config.contact)

    def _flags(self, picture: np.ndarray, contacts: ContactRegions) -> Flag:
        contact = self.config.contact
        flags = Flag.REFUSED if self.refused else Flag.NONE
        steep = steepest_change(picture, self.background, self.mm_per_px, contact.smoothing_mm)
        if contacts.count == 0 or steep < contact.steepness:
            flags |= Flag.NO_CONTACT
        if contacts.at_border:
            flags |= Flag.BORDER_CONTACT
        if contacts.count > 1:
            flags |= Flag.SEVERAL_CONTACTS
        if saturated(picture[None], self.background, self.config.quality)[0]:
            flags |= Flag.SATURATED
        return flags

    def _depth_reader(self, calibration: Calibration) -> DepthReader:
        """The reader of a calibration, which must fit the pictures; the background is that of the day."""
        if calibration.background.shape != self.background.shape or calibration.mm_per_px != self.mm_per_px:
            made = f"{calibration.background.shape[:2]} px of {calibration.mm_per_px} mm"
            raise CalibrationError(
                f"calibration is for {made}, the background is {self.background.shape[:2]} px of {self.mm_per_px} mm: "
                "must be equal; calibrate this camera"
            )
        _compare(calibration.background, self.background)
        today = dataclasses.replace(calibration, background=self.background)
        return DepthReader(today, zero=self.config.zero, contact=self.config.contact)

    def _make_vector_readers(self) -> None:
        """Of deformation, and of shear where there is depth, on a grid of `nodes` along the longer side."""
        height, width = self.background.shape[:2]
        shape = tuple(max(4, round(self.config.nodes * n / max(height, width))) for n in (height, width))
        self.grid_mm = (width / shape[1] * self.mm_per_px, height / shape[0] * self.mm_per_px)
        self._deformation = DeformationReader(self.background, self.mm_per_px, (shape[0], shape[1]))
        if self._depth is not None:
            grid = NodeGrid(
                shape=(shape[0], shape[1]),
                pitch_mm=self.grid_mm,
                marker_depth_mm=self.config.marker_depth_mm,
                depth_mm=0.0,
            )
            self._shear = ShearReader(self.config.gel, grid, self.config.inverse)

    def _split(
        self, moved: np.ndarray, depth: np.ndarray, contacts: ContactRegions, valid: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Shear, traction and force of one frame."""
        if self._shear is None:
            raise RuntimeError("the shear reader is missing; make the extractor with a calibration")
        height, width = moved.shape[:2]
        coarse = cv2.resize(depth, (width, height), interpolation=cv2.INTER_AREA)
        touching = cv2.resize(contacts.mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0
        found = self._shear.read(moved, coarse, valid, touching)
        shear = found.shear_mm if self.config.shear == "modelled" else found.subtracted_mm
        return {"shear_mm": shear, "traction_mpa": found.traction_mpa, "force_n": found.force_n}


def _compare(calibrated: np.ndarray, rest: np.ndarray) -> None:
    """Warn if the gel at rest, uint8 [H, W, 3], looks unlike that of the calibration, marks and dirt aside."""
    small = [cv2.resize(p, (32, 24), interpolation=cv2.INTER_AREA).astype(np.float32) for p in (calibrated, rest)]
    levels = float(np.median(np.abs(small[0] - small[1]), axis=(0, 1)).max())
    if levels > _OTHER_GEL_LEVELS:
        warnings.warn(
            f"the gel at rest differs from that of the calibration by {levels:.0f} grey levels in half of the window: "
            "depth may be wrong; look whether it is the same sensor, lamps, exposure, channel order and side up, or "
            "calibrate again",
            OtherGelWarning,
            stacklevel=5,
        )


def joined(parts: list[Fields]) -> Fields:
    """Fields of several runs of frames, one after the other."""
    first = parts[0]
    arrays: dict[str, Any] = {
        name: None if array is None else np.concatenate([part.arrays()[name] for part in parts])
        for name, array in first.arrays().items()
    }
    return dataclasses.replace(first, **arrays)
