"""Methods that track the dots of a gel: the package's, and reimplementations of those in common use.

A follower is made from the picture at rest and the points at rest.  Called with the next picture, it returns the points
(x, y) [P, 2], NaN where it reports a point as lost.
"""

from collections.abc import Callable
from typing import Protocol

import cv2
import numpy as np

from sensors_io.fields.markers import find_markers
from sensors_io.fields.tracking import Tracker, TrackingConfig


class Follower(Protocol):
    """Follows points through pictures."""

    def __call__(self, grey: np.ndarray) -> np.ndarray:
        """Points in the next picture, uint8 [H, W]."""


Make = Callable[[np.ndarray, np.ndarray, int], Follower]
"""From the picture at rest, the points and the half side of the windows to a follower."""


def ours(affine: bool, smooth: bool) -> Make:
    """The package's tracker, with or without the affine fit and smoothing."""

    def make(rest: np.ndarray, points: np.ndarray, half_px: int) -> Follower:
        tracker = Tracker(rest, points, half_px, TrackingConfig(affine=affine, smooth=smooth))

        def follow(grey: np.ndarray) -> np.ndarray:
            tracked = tracker.track(grey)
            return np.where(tracked.found[:, None], tracked.points_px, np.nan)

        return follow

    return make


def lucas_kanade_between_frames(rest: np.ndarray, points: np.ndarray, half_px: int) -> Follower:
    """Each picture matched to the one before."""
    del half_px
    state = {"grey": rest, "points": points}

    def follow(grey: np.ndarray) -> np.ndarray:
        state.update(points=_lucas_kanade(state["grey"], grey, state["points"]), grey=grey)
        return state["points"]

    return follow


def lucas_kanade_to_rest(rest: np.ndarray, points: np.ndarray, half_px: int) -> Follower:
    """Each picture matched to the one at rest, from no motion."""
    del half_px
    return lambda grey: _lucas_kanade(rest, grey, points)


def dense_inverse_search(preset: int) -> Make:
    """DIS flow from the picture at rest, read at the points."""

    def make(rest: np.ndarray, points: np.ndarray, half_px: int) -> Follower:
        del half_px
        flow = cv2.DISOpticalFlow.create(preset)
        return lambda grey: points + _at_points(flow.calc(rest, grey, None), points)  # type: ignore[call-overload]

    return make


def farneback(window_px: int) -> Make:
    """Farnebäck's flow from the picture at rest, read at the points."""

    def make(rest: np.ndarray, points: np.ndarray, half_px: int) -> Follower:
        del half_px
        return lambda grey: points + _at_points(farneback_flow(rest, grey, window_px), points)

    return make


def farneback_flow(rest: np.ndarray, grey: np.ndarray, window_px: int) -> np.ndarray:
    """Farnebäck's flow with the settings that shear estimators commonly use, [H, W, 2]."""
    start = np.zeros((*rest.shape, 2), np.float32)
    return cv2.calcOpticalFlowFarneback(rest, grey, start, 0.5, 3, window_px, 3, 5, 1.2, 0)


def nearest_dot(rest: np.ndarray, points: np.ndarray, half_px: int) -> Follower:
    """Dots are detected in every picture; a point and a dot are paired where each is the other's nearest."""
    del rest, half_px
    state = {"points": points.copy()}

    def follow(grey: np.ndarray) -> np.ndarray:
        dots = find_markers(grey)
        if dots is None:
            return np.full_like(points, np.nan)
        gaps = np.hypot(*(state["points"][:, None] - dots.points_px[None]).transpose(2, 0, 1))
        mine, theirs = gaps.argmin(1), gaps.argmin(0)
        mutual = theirs[mine] == np.arange(len(points))
        state["points"] = np.where(mutual[:, None], dots.points_px[mine], state["points"]).astype(np.float32)
        return np.where(mutual[:, None], state["points"], np.nan)

    return follow


def mean_shift(rest: np.ndarray, points: np.ndarray, half_px: int) -> Follower:
    """Each point moves to the centroid of the dark pixels in a window around where it was, a few times.

    The method of gsrobotics' `marker_tracker`, with windows of the dots' size in place of a fixed one.
    """
    del rest
    state = {"points": points.copy()}
    side = np.arange(-half_px, half_px + 1)
    dy, dx = (a.ravel() for a in np.meshgrid(side, side, indexing="ij"))

    def follow(grey: np.ndarray) -> np.ndarray:
        dark = (cv2.blur(grey, (31, 31)).astype(np.float32) - grey > 15).astype(np.float32)
        at = state["points"]
        for _ in range(5):
            x = np.clip(np.round(at[:, :1]).astype(int) + dx, 0, grey.shape[1] - 1)
            y = np.clip(np.round(at[:, 1:]).astype(int) + dy, 0, grey.shape[0] - 1)
            weight = dark[y, x]
            total = weight.sum(1)
            centroid = np.stack([(weight * x).sum(1), (weight * y).sum(1)], 1) / np.maximum(total, 1)[:, None]
            at = np.where(total[:, None] > 0, centroid, at).astype(np.float32)
        state["points"] = at
        return at

    return follow


FOLLOWERS: dict[str, Make] = {
    "this": ours(affine=True, smooth=True),
    "this, affine alone": ours(affine=True, smooth=False),
    "this, LK alone": ours(affine=False, smooth=False),
    "LK to rest": lucas_kanade_to_rest,
    "LK frame to frame": lucas_kanade_between_frames,
    "DIS ultrafast": dense_inverse_search(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST),
    "DIS fast": dense_inverse_search(cv2.DISOPTICAL_FLOW_PRESET_FAST),
    "DIS medium": dense_inverse_search(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM),
    "Farnebäck 15": farneback(15),
    "Farnebäck 45": farneback(45),
    "dots, nearest": nearest_dot,
    "mean shift": mean_shift,
}
"""Name in tables and charts → method."""


def _at_points(flow: np.ndarray, points: np.ndarray) -> np.ndarray:
    """A flow [H, W, 2] at points (x, y) [P, 2]."""
    x, y = (np.ascontiguousarray(points[:, i : i + 1], np.float32) for i in (0, 1))
    return cv2.remap(flow, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]


def _lucas_kanade(source: np.ndarray, target: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pyramidal Lucas–Kanade with the settings that marker trackers commonly use, from no motion, [P, 2]."""
    moved, _, _ = cv2.calcOpticalFlowPyrLK(
        source, target, points[:, None], points[:, None].copy(), winSize=(15, 15), maxLevel=2, criteria=(3, 10, 0.03)
    )
    return np.asarray(moved)[:, 0]
