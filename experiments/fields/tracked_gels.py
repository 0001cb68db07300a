"""A gel ready for tracking under known motion: what is followed on it, and how it is moved."""

import dataclasses

import cv2
import numpy as np

from experiments.fields.gels_at_rest import GelAtRest
from experiments.fields.known_motion import GelMotion, pressed
from sensors_io.fields.deformation import DeformationReader

PEAK_PX, JUMP_PX = 12.0, 28.0
"""Greatest displacement of a motion and of a jump, on a picture 320 pixels wide."""

NOISE_GREY = 2.0
"""Standard deviation of the camera's noise, grey levels."""

FIRST_SEED = 400
"""Of motions and noise that are reported: settings were chosen on motions of the seeds 0 to 3, on other pictures."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackedGel:
    """A gel ready for tracking: points [P, 2], half side of the windows and radius of a dot, as the package finds them;
    on a dense pattern the window stands for the dot.
    """

    rest: GelAtRest
    points_px: np.ndarray
    half_px: int
    dot_radius_px: float

    @property
    def unit(self) -> float:
        """TrainingPixels per pixel of a picture 320 wide."""
        return self.rest.picture.shape[1] / 320

    def motion(self, peak_px: float, seed: int | None) -> GelMotion:
        """A motion of a peak on a picture 320 wide; the published one without a seed."""
        rng = None if seed is None else np.random.default_rng(seed)
        return pressed(self.rest.picture.shape, peak_px * self.unit, rng)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Points whose window lies in the picture."""
        height, width = self.rest.picture.shape[:2]
        margin = self.half_px + 1
        return np.all((points >= margin) & (points <= np.array([width, height]) - 1 - margin), -1)


def subject(rest: GelAtRest) -> TrackedGel:
    """What the package would follow on a gel."""
    reader = DeformationReader(rest.picture, mm_per_px=1.0)
    dots, half = reader.evidence.markers, reader.tracker.half_px
    return TrackedGel(
        rest=rest,
        points_px=reader.tracker.points_px,
        half_px=half,
        dot_radius_px=float(half) if dots is None else dots.radius_px,
    )


def grey(picture: np.ndarray) -> np.ndarray:
    """RGB uint8 [H, W, 3] → uint8 [H, W]."""
    return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
