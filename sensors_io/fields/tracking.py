"""Points of a gel followed through pictures, each picture matched straight to the one at rest, so that nothing drifts.

One frame goes through six steps:

    1. Lucas–Kanade from the picture at rest, started where the points were last seen; a picture of another exposure
       is brought to that of the one at rest first
    2. where the points tear the gel, or frames are missing: a new start from dense flow (DIS), and from the largest
       piece that hangs together outward, ring by ring, each ring started where the spline of the piece puts it
    3. the affine fit of `patches`, which takes strain and light into account
    4. the gates: back to the picture at rest within a pixel, alike, whole, as the others predict
    5. points that fail are flagged and placed where the spline of the others puts them, from where they are found again
    6. all are brought to the smoothest field that their noise warrants (`smoothing`)

Sources: Lucas & Kanade 1981 in Bouguet's pyramid; Kroeger et al., ECCV 2016 (DIS); Kalal et al., ICPR 2010 (forward
and back).
"""

import dataclasses
from collections.abc import Iterator

import cv2
import numpy as np

from sensors_io.fields.neighbours import Neighbours
from sensors_io.fields.patches import Patches
from sensors_io.fields.smoothing import Smoother
from sensors_io.fields.spline import ThinPlate

LEAST_POINTS = 4
"""Found points below which nothing is known of the others."""

_LEVELS = 2  # of the pyramid: a quarter of the picture
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)  # the affine fit does the rest
_BACK_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 5, 0.03)
_PIECES = 3  # that are tried as the one that is right
_RINGS = 12  # that grow around a piece at most
_NEARLY_ALL = 0.9  # share of the most points that any start leaves whole
_SAMPLED_PX = 4  # from which exposure is estimated: every so many along both axes
_LIGHT_OF_CONTACT = 0.1  # relative change of the median that a contact's own shading may make


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackingConfig:
    """Gates.

    Args:
      back_px: greatest distance from where a point started, after going forth and back.
      likeness: least correlation of a window with itself at rest.
      spread_px: greatest standard deviation of a point that noise may make; at twice as much it may be a pixel off.
      strain: greatest difference of two neighbours' displacements over their distance; a gel's own stays below 0.4, a
        mistaken dot next to a right one makes 0.6 and more.
      safe_strain: the same, below which a piece is taken for right, to grow from.
      surprise: greatest difference from what all other points predict, over the points' pitch.
      reseed_share: of points that fail, above which a new start is looked for.
      affine, smooth: whether steps 3 and 6 are taken.
    """

    back_px: float = 1.0
    likeness: float = 0.7
    spread_px: float = 0.5
    strain: float = 0.5
    safe_strain: float = 0.2
    surprise: float = 0.2
    reseed_share: float = 0.02
    affine: bool = True
    smooth: bool = True

    def __post_init__(self) -> None:
        for name in ("back_px", "likeness", "spread_px", "strain", "safe_strain", "surprise", "reseed_share"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} is {getattr(self, name)}: must be > 0; raise it")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tracked:
    """P points in one picture.

    `points_px` [P, 2] where they are, or where the others put them if not `found` [P]; `reseeded`: whether a new start
    was needed.
    """

    points_px: np.ndarray
    found: np.ndarray
    reseeded: bool


class Tracker:
    """Follows P points of a gel.

    Args:
      reference: grey picture at rest, uint8 [H, W].
      points_px: (x, y) [P, 2].
      half_px: half side of the windows, which must lie inside the picture.
      config: gates.

    Raises:
      ValueError: fewer than four points, points on a line, or a window that leaves the picture.
    """

    def __init__(
        self, reference: np.ndarray, points_px: np.ndarray, half_px: int, config: TrackingConfig | None = None
    ):
        self._config = config or TrackingConfig()
        self.half_px = half_px
        self._side = 2 * half_px + 1
        self._start = np.ascontiguousarray(points_px, np.float32)
        self.spline = ThinPlate(self._start)
        self._smoothed = Smoother(self.spline)
        self._patches = Patches(reference, self._start, half_px)
        self._neighbours = Neighbours(self._start)
        self._reference = np.ascontiguousarray(reference)
        self._brightness = _brightness(reference)
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._last = self._start

    def __len__(self) -> int:
        return len(self._start)

    @property
    def points_px(self) -> np.ndarray:
        """The points at rest [P, 2]."""
        return self._start

    def track(self, picture: np.ndarray, gap: bool = False, apart: bool = False) -> Tracked:
        """Find the points in the next picture.

        Args:
          picture: grey, uint8 [H, W] as the reference.
          gap: whether frames are missing before it; the points may then be anywhere.
          apart: whether it follows no other picture: the points may be anywhere, and what was tracked before it has no
            influence.

        Raises:
          ValueError: a picture of another shape or type.
        """
        self._check(picture)
        picture = self._exposed_alike(picture)
        if apart:
            self._last, gap = self._start, True
        points, found = self._forth(picture, self._last)
        reseeded = gap or self._failed(points, found)
        if reseeded:
            points, found = self._recovered(picture, points, found, gap)
        points, found = self._gated(picture, points, found)
        self._last = self._completed(points, found)
        return Tracked(points_px=self._last, found=found, reseeded=reseeded)

    def _exposed_alike(self, picture: np.ndarray) -> np.ndarray:
        """The picture as bright as the reference, where its median says that its exposure differs."""
        gain = self._brightness / max(_brightness(picture), 1.0)
        if abs(gain - 1) <= _LIGHT_OF_CONTACT:
            return picture
        return cv2.LUT(picture, np.clip(np.round(gain * np.arange(256)), 0, 255).astype(np.uint8))

    def _gated(self, picture: np.ndarray, points: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Steps 3 and 4."""
        if self._config.affine:
            fit = self._patches.find(picture, points)
            sure = (fit.likeness >= self._config.likeness) & (fit.spread_px <= self._config.spread_px)
            points, found = fit.points_px, found & sure
        back, returned = self._lucas_kanade(picture, self._reference, points, self._start, 0, _BACK_STOP)
        found = found & returned & (np.hypot(*(back - self._start).T) <= self._config.back_px)
        return points, self._consistent(points, found)

    def _forth(self, picture: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._lucas_kanade(self._reference, picture, self._start, start, _LEVELS, _STOP)

    def _lucas_kanade(
        self,
        source: np.ndarray,
        target: np.ndarray,
        points: np.ndarray,
        start: np.ndarray,
        levels: int,
        stop: tuple[int, int, float],
    ) -> tuple[np.ndarray, np.ndarray]:
        moved, status, _ = cv2.calcOpticalFlowPyrLK(
            source,
            target,
            points[:, None],
            start[:, None].copy(),
            winSize=(self._side, self._side),
            maxLevel=levels,
            criteria=stop,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return moved[:, 0], status[:, 0].astype(bool)

    def _failed(self, points: np.ndarray, found: np.ndarray) -> bool:
        moved = points - self._start
        return bool(
            np.mean(~found) > self._config.reseed_share or self._neighbours.torn(moved, found, self._config.strain)
        )

    def _recovered(
        self, picture: np.ndarray, points: np.ndarray, found: np.ndarray, gap: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """The start that leaves most points whole, of those grown from every large piece of two fields: the present
        one and that of dense flow.

        A regular lattice moved by a whole pitch looks the same.  Unless frames are missing, a start near the last
        picture therefore comes first if it leaves nearly as many points whole.
        """
        flow = self._flow.calc(self._reference, picture, None)  # type: ignore[call-overload]
        at_points = cv2.remap(flow, self._start[:, :1], self._start[:, 1:], cv2.INTER_LINEAR)[:, 0]
        fields = ((points, found), self._forth(picture, self._start + at_points))
        grown = [g for field in fields for g in self._grown(picture, *field)]
        if not grown:
            return points, found
        most = max(found.sum() for _, found in grown)
        near = [g for g in grown if not gap and self._is_near(*g) and g[1].sum() >= _NEARLY_ALL * most]
        return max(near or grown, key=lambda g: (g[1].sum(), -self.spline.bending(g[0] - self._start, g[1])))

    def _is_near(self, points: np.ndarray, found: np.ndarray) -> bool:
        """True if the points moved by less than half a pitch since the last picture, by their median."""
        step = np.hypot(*(points - self._last)[found].T)
        return bool(np.median(step) < self.spline.pitch_px / 2)

    def _grown(
        self, picture: np.ndarray, points: np.ndarray, found: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        pieces = self._neighbours.pieces(points - self._start, found, self._config.safe_strain)
        for piece in pieces[:_PIECES]:
            if piece.sum() >= LEAST_POINTS:
                yield self._grow(picture, points, piece)

    def _grow(self, picture: np.ndarray, points: np.ndarray, piece: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        for _ in range(_RINGS):
            ring = self._neighbours.adjacent(piece)
            start = self._start + self.spline.filled(points - self._start, piece)
            found_at, found = self._forth_unscaled(picture, start)
            points = np.where(piece[:, None], points, found_at)
            near = np.hypot(*(found_at - start).T) <= self._config.strain * self.spline.pitch_px
            added = ring & found & near
            if not added.any():
                break
            piece = self._neighbours.pieces(points - self._start, piece | added, self._config.strain)[0]
        return points, piece

    def _forth_unscaled(self, picture: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """From a start that is near: the coarse levels would carry it to another dot."""
        return self._lucas_kanade(self._reference, picture, self._start, start, 0, _STOP)

    def _consistent(self, points: np.ndarray, found: np.ndarray) -> np.ndarray:
        """The found points that hang together and that the others predict."""
        moved = points - self._start
        if self._neighbours.torn(moved, found, self._config.strain):
            found = self._neighbours.pieces(moved, found, self._config.strain)[0]
        return found & ~self.spline.inconsistent(moved, found, self._config.surprise * self.spline.pitch_px)

    def _completed(self, points: np.ndarray, found: np.ndarray) -> np.ndarray:
        """Steps 5 and 6; all points at rest where too few are found for a spline."""
        if found.sum() < LEAST_POINTS:
            return self._start
        moved = self.spline.filled(points - self._start, found)
        return self._start + (self._smoothed(moved) if self._config.smooth else moved)

    def _check(self, picture: np.ndarray) -> None:
        if picture.dtype != np.uint8 or picture.shape != self._reference.shape:
            raise ValueError(
                f"picture is {picture.dtype}{list(picture.shape)}: must be uint8{list(self._reference.shape)} as the "
                "reference; convert it to grey and crop it likewise"
            )


def _brightness(picture: np.ndarray) -> float:
    """Median grey level, which a contact hardly moves."""
    return float(np.median(picture[::_SAMPLED_PX, ::_SAMPLED_PX]))
