"""Guidance of a hand that presses a ball for a calibration: rest picture, steady presses, where to press next."""

import dataclasses

import cv2
import numpy as np

from sensors_io.calibration.circles import first_touch
from sensors_io.calibration.coverage import Coverage, coverage
from sensors_io.calibration.presses import Touches
from sensors_io.fields.contact import ContactConfig, changed_contacts

_INK, _HALO, _NEXT = (255, 255, 255), (20, 23, 26), (255, 210, 0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class GuideConfig:
    """Limits of what counts as rest, as a press, and as enough.

    Args:
      presses: wanted.
      cover: share of the window that they must cover.
      rest_frames: still frames that make the rest picture.
      steady_frames: still frames that make a press.
      still_levels: mean change between two frames of a still gel, grey levels.
      moved_radii: contact radii by which the ball must have moved if it was not lifted.
      least_radius, most_radius: of the contact, in ball radii.
      most_saturated: share of the contact's pixels with a channel at 255.
    """

    presses: int = 30
    cover: float = 0.9
    rest_frames: int = 16
    steady_frames: int = 4
    still_levels: float = 1.5
    moved_radii: float = 0.5
    least_radius: float = 0.25
    most_radius: float = 0.95
    most_saturated: float = 0.3

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if not getattr(self, field.name) > 0:
                raise ValueError(f"{field.name} is {getattr(self, field.name)}: must be > 0; raise it")
        if self.cover > 1:
            raise ValueError(f"cover is {self.cover}: must be ≤ 1, a share; lower it")
        if self.least_radius >= self.most_radius:
            raise ValueError(
                f"least_radius is {self.least_radius}: must be < most_radius, {self.most_radius}, else no press is "
                "taken; lower it"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Guidance:
    """Prompt to the hand, the contact's circle (x, y, radius) in px, and the press that is to be kept, if any."""

    prompt: str
    circle: np.ndarray | None = None
    taken: np.ndarray | None = None


class PressGuide:
    """Guide of one session: it sees one frame after the other, says what to do, and takes the presses.

    Args:
      radius_mm: of the ball.
      mm_per_px: pitch.
      config: what counts.
      background: the gel at rest, uint8 [H, W, 3]; without it the first still frames are its mean.
    """

    def __init__(
        self,
        radius_mm: float,
        mm_per_px: float,
        config: GuideConfig | None = None,
        background: np.ndarray | None = None,
    ):
        self.background = background
        self.touches: list[np.ndarray] = []
        self._radius_mm, self._mm_per_px, self._config = radius_mm, mm_per_px, config or GuideConfig()
        self._still: list[np.ndarray] = []
        self._lifted = True

    def coverage(self, shape: tuple[int, int]) -> Coverage:
        """Coverage of the window by the presses taken so far."""
        return coverage(Touches.of(np.reshape(self.touches, (-1, 3))), shape)

    @property
    def done(self) -> bool:
        """True once the presses are enough and cover the window."""
        if self.background is None or len(self.touches) < self._config.presses:
            return False
        return self.coverage((self.background.shape[0], self.background.shape[1])).share >= self._config.cover

    def look(self, frame: np.ndarray) -> Guidance:
        """Guidance after one more frame, uint8 [H, W, 3] RGB."""
        last = self._still[-1] if self._still else frame
        if frame.shape != last.shape or float(cv2.absdiff(frame, last).mean()) > self._config.still_levels:
            self._still = []
        self._still.append(frame)
        if self.background is None:
            return self._rest()
        self._still = self._still[-self._config.steady_frames :]
        contact = changed_contacts(frame, self.background, self._mm_per_px, ContactConfig())
        if not contact.count:
            self._lifted = True
            return Guidance(prompt=self._next(frame))
        circle = first_touch(frame, self.background, self._radius_mm, self._mm_per_px)
        if problem := self._problem(frame, circle):
            return Guidance(prompt=problem, circle=circle)
        if not self._lifted and np.hypot(*(circle - self.touches[-1])[:2]) < self._config.moved_radii * circle[2]:
            return Guidance(prompt="taken; lift the ball", circle=circle)
        if len(self._still) < self._config.steady_frames:
            return Guidance(prompt="hold it still", circle=circle)
        self.touches.append(circle)
        self._lifted = False
        return Guidance(prompt=f"press {len(self.touches)} taken; lift the ball", circle=circle, taken=frame)

    def resume(self, press: np.ndarray) -> None:
        """Count a press that was taken before."""
        rest = press if self.background is None else self.background
        self.touches.append(first_touch(press, rest, self._radius_mm, self._mm_per_px))

    def _rest(self) -> Guidance:
        wanted = self._config.rest_frames
        if len(self._still) < wanted:
            return Guidance(prompt=f"touch nothing: rest picture, {len(self._still)} of {wanted} still frames")
        self.background = np.mean(self._still, axis=0).round().astype(np.uint8)
        return Guidance(prompt=self._next(self.background))

    def _next(self, frame: np.ndarray) -> str:
        seen = self.coverage((frame.shape[0], frame.shape[1]))
        x, y = seen.next_px
        have = f"{len(self.touches)} of {self._config.presses} presses cover {seen.share:.0%}"
        return f"{have}: press the ball in {seen.where()} ({x:.0f}, {y:.0f})"

    def _problem(self, frame: np.ndarray, circle: np.ndarray) -> str:
        """The fault of a contact, empty if it has none."""
        share = circle[2] * self._mm_per_px / self._radius_mm
        if share < self._config.least_radius:
            return "press deeper"
        if share > self._config.most_radius:
            return "press less deep"
        y, x = np.mgrid[: frame.shape[0], : frame.shape[1]]
        inside = np.hypot(x - circle[0], y - circle[1]) < circle[2]
        if float((frame[inside] == 255).any(-1).mean()) > self._config.most_saturated:
            return "the contact is saturated: lower the camera's exposure, and begin anew"
        return ""


def drawn(frame: np.ndarray, guidance: Guidance, seen: Coverage) -> np.ndarray:
    """The frame with the contact's circle, what is covered tinted green, and a cross where to press next."""
    picture = frame.copy()
    picture[seen.covered] = (0.75 * picture[seen.covered] + (0, 60, 0)).astype(np.uint8)
    x, y = (round(value) for value in seen.next_px)
    cv2.drawMarker(picture, (x, y), _HALO, cv2.MARKER_CROSS, 22, 4)
    cv2.drawMarker(picture, (x, y), _NEXT, cv2.MARKER_CROSS, 22, 2)
    if guidance.circle is not None:
        centre = (round(float(guidance.circle[0])), round(float(guidance.circle[1])))
        for ink, width in ((_HALO, 3), (_INK, 1)):
            cv2.circle(picture, centre, round(float(guidance.circle[2])), ink, width)
    return picture
