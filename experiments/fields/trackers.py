"""Methods that track the dots of a gel: the package's, and reimplementations of those in common use.

A follower is made from the picture at rest and the points at rest.  Called with the next picture, it returns the points
(x, y) [P, 2], NaN where it reports a point as lost.
"""

import functools
from collections.abc import Callable

import cv2
import numpy as np

from sensors_io.fields.markers import find_markers
from sensors_io.fields.tracking import Tracker, TrackingConfig

Follower = Callable[[np.ndarray], np.ndarray]  # from the next picture, uint8 [H, W], to the points in it

MakeFollower = Callable[[np.ndarray, np.ndarray, int], Follower]
"""From the picture at rest, the points and the half side of the windows to a follower."""

Flow = Callable[[np.ndarray], np.ndarray]
"""From a picture, uint8 [H, W], to its displacement against the picture at rest, [H, W, 2]."""


def package_tracker(affine: bool, smooth: bool) -> MakeFollower:
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
    before, at = rest, points

    def follow(grey: np.ndarray) -> np.ndarray:
        nonlocal before, at
        before, at = grey, _lucas_kanade(before, grey, at)
        return at

    return follow


def lucas_kanade_to_rest(rest: np.ndarray, points: np.ndarray, half_px: int) -> Follower:
    """Each picture matched to the one at rest, from no motion."""
    del half_px
    return lambda grey: _lucas_kanade(rest, grey, points)


def dense_flow(make_flow: Callable[[np.ndarray], Flow]) -> MakeFollower:
    """A dense flow from the picture at rest, read at the points."""

    def make(rest: np.ndarray, points: np.ndarray, half_px: int) -> Follower:
        del half_px
        flow = make_flow(rest)
        return lambda grey: points + _at_points(flow(grey), points)

    return make


def inverse_search(preset: int, rest: np.ndarray) -> Flow:
    """DIS flow from the picture at rest."""
    flow = cv2.DISOpticalFlow.create(preset)
    return lambda grey: flow.calc(rest, grey, None)  # type: ignore[call-overload]


def farneback(window_px: int, rest: np.ndarray) -> Flow:
    """Farnebäck's flow from the picture at rest with the settings that shear estimators commonly use."""
    start = lambda: np.zeros((*rest.shape, 2), np.float32)
    return lambda grey: cv2.calcOpticalFlowFarneback(rest, grey, start(), 0.5, 3, window_px, 3, 5, 1.2, 0)


FLOWS: dict[str, Callable[[np.ndarray], Flow]] = {
    "DIS ultrafast": functools.partial(inverse_search, cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST),
    "DIS fast": functools.partial(inverse_search, cv2.DISOPTICAL_FLOW_PRESET_FAST),
    "DIS medium": functools.partial(inverse_search, cv2.DISOPTICAL_FLOW_PRESET_MEDIUM),
    "Farnebäck 15": functools.partial(farneback, 15),
    "Farnebäck 45": functools.partial(farneback, 45),
}
"""Name → from the picture at rest to a dense flow."""


def nearest_dot(rest: np.ndarray, points: np.ndarray, half_px: int) -> Follower:
    """Dots are detected in every picture; a point and a dot are paired where each is the other's nearest."""
    del rest, half_px
    at = points.copy()

    def follow(grey: np.ndarray) -> np.ndarray:
        nonlocal at
        dots = find_markers(grey)
        if dots is None:
            return np.full_like(points, np.nan)
        gaps = np.hypot(*(at[:, None] - dots.points_px[None]).transpose(2, 0, 1))
        mine, theirs = gaps.argmin(1), gaps.argmin(0)
        mutual = theirs[mine] == np.arange(len(points))
        at = np.where(mutual[:, None], dots.points_px[mine], at).astype(np.float32)
        return np.where(mutual[:, None], at, np.nan)

    return follow


def mean_shift(rest: np.ndarray, points: np.ndarray, half_px: int) -> Follower:
    """Each point moves to the centroid of the dark pixels in a window around where it was, a few times.

    The method of gsrobotics' `marker_tracker`, with windows of the dots' size in place of a fixed one.
    """
    del rest
    at, side = points.copy(), np.arange(-half_px, half_px + 1)
    dy, dx = (a.ravel() for a in np.meshgrid(side, side, indexing="ij"))

    def follow(grey: np.ndarray) -> np.ndarray:
        nonlocal at
        dark = (cv2.blur(grey, (31, 31)).astype(np.float32) - grey > 15).astype(np.float32)
        for _ in range(5):
            x = np.clip(np.round(at[:, :1]).astype(int) + dx, 0, grey.shape[1] - 1)
            y = np.clip(np.round(at[:, 1:]).astype(int) + dy, 0, grey.shape[0] - 1)
            weight = dark[y, x]
            total = weight.sum(1)
            centroid = np.stack([(weight * x).sum(1), (weight * y).sum(1)], 1) / np.maximum(total, 1)[:, None]
            at = np.where(total[:, None] > 0, centroid, at).astype(np.float32)
        return at

    return follow


FOLLOWERS: dict[str, MakeFollower] = {
    "this": package_tracker(affine=True, smooth=True),
    "this, affine alone": package_tracker(affine=True, smooth=False),
    "this, LK alone": package_tracker(affine=False, smooth=False),
    "LK to rest": lucas_kanade_to_rest,
    "LK frame to frame": lucas_kanade_between_frames,
    **{name: dense_flow(make_flow) for name, make_flow in FLOWS.items()},
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
