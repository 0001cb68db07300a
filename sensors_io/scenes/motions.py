"""The press and the six exploratory motions over time: what the hand commands, before any physics.

Everything is given in the gel's frame (x right, y down, z out of the gel): the object moves, the gel stands still.  The
hand controls the normal force; the object's rigid displacement along the gel, its twist about the normal and its tilt
are prescribed.  Speeds are constant within a phase.  Amplitudes, speeds and shares of frames are our choice: they keep
the contact inside a 15 mm window and take every contact through full slip and back at a friction of 0.2 to 1.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sensors_io.scenes import surface
from sensors_io.scenes.config import require
from sensors_io.schema import EXPLORATORY, Phase

_RISE = 1.5  # force grows as depth^1.5 under Hertz: such a ramp is an approach at constant speed


@dataclasses.dataclass(frozen=True, kw_only=True)
class Pace:
    """Speeds and the division of a sequence into phases.

    A slide, twist or roll is one cycle 0 → +A → −A → 0 at constant speed, so that A = speed × time / 4.
    """

    frames: int = 90
    period_s: float = 1 / 30
    approach_frames: int = 4
    load_frames: int = 14
    settle_frames: int = 4
    unload_frames: int = 10
    slide_mm_per_s: float = 4.0
    twist_rad_per_s: float = 0.6
    roll_rad_per_s: float = 0.2
    taps: int = 3

    def __post_init__(self) -> None:
        counts = ("approach_frames", "load_frames", "settle_frames", "unload_frames", "taps")
        for name in counts:
            require(getattr(self, name) >= 1, name, getattr(self, name), "must be ≥ 1")
        for name in ("period_s", "slide_mm_per_s", "twist_rad_per_s", "roll_rad_per_s"):
            require(getattr(self, name) > 0, name, getattr(self, name), "must be > 0")
        least = self.approach_frames + self.load_frames + self.settle_frames + self.unload_frames + 4
        require(self.frames >= least, "frames", self.frames, f"must be ≥ {least}, four frames of motion")
        require(self.frames >= 6 * self.taps, "taps", self.taps, f"must be ≤ {self.frames // 6}, six frames a tap")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """One sequence as commanded, F frames.

    `force_n` is the normal force ≥ 0, exactly 0 where nothing touches; `slide_mm` [F, 2] the object's displacement
    along x and y, `twist_rad` [F] its rotation about the normal from x to y, `tilt_rad` [F, 2] its tilt: a skin that
    was level rises by tan(tilt) along x and y.  `phase` [F] holds `Phase` codes, `time_s` [F] starts at 0.
    """

    motion: str
    force_n: np.ndarray
    slide_mm: np.ndarray
    twist_rad: np.ndarray
    tilt_rad: np.ndarray
    phase: np.ndarray
    time_s: np.ndarray

    def __len__(self) -> int:
        return len(self.force_n)


def plan(motion: str, force_n: float, pace: Pace | None = None) -> Plan:
    """Describe one sequence.

    Args:
      motion: "press" or one of `EXPLORATORY`.
      force_n: greatest normal force, N; `PRESS_FORCE_N` for the press, one of `FORCES_N` for the others by protocol.
      pace: speeds and phases; the default one if `None`.

    Raises:
      ValueError: an unknown motion, a force not above 0.
    """
    known = ("press", *EXPLORATORY)
    require(motion in known, "motion", motion, f"must be one of {', '.join(known)}")
    require(force_n > 0, "force_n", force_n, "must be > 0")
    pace = pace or Pace()
    phase, level = _PROFILES[motion](pace) if motion in _PROFILES else _move_profile(pace)
    slide, twist, tilt = _path(motion, phase, pace)
    return Plan(
        motion=motion,
        force_n=force_n * level,
        slide_mm=slide,
        twist_rad=twist,
        tilt_rad=tilt,
        phase=phase,
        time_s=np.arange(pace.frames) * pace.period_s,
    )


def moved(
    pose: surface.SensorPose, slide_mm: Float[Array, "2"], twist_rad: Float[Array, ""], tilt_rad: Float[Array, "2"]
) -> surface.SensorPose:
    """Pose of the object after a rigid motion in the gel's frame: its skin, relief and texture go with it.

    `surface.gap(skin, moved(pose, ...), x)` is the gap that the normal contact of that frame needs.  The twist turns
    about the site, `pose.offset_mm` + slide; the tilt about the same point.
    """
    return dataclasses.replace(
        pose,
        offset_mm=pose.offset_mm + slide_mm,
        turn_rad=pose.turn_rad + twist_rad,
        tilt=pose.tilt + jnp.tan(tilt_rad),
    )


def _press_profile(pace: Pace) -> tuple[np.ndarray, np.ndarray]:
    """Approach, then load to the end."""
    return _profile((Phase.APPROACH, pace.approach_frames), (Phase.LOAD, pace.frames - pace.approach_frames))


def _hold_profile(pace: Pace) -> tuple[np.ndarray, np.ndarray]:
    """Approach, a quarter of the rest loading, half of it holding, a quarter unloading."""
    ramp = (pace.frames - pace.approach_frames) // 4
    hold = pace.frames - pace.approach_frames - 2 * ramp
    return _profile(
        (Phase.APPROACH, pace.approach_frames), (Phase.LOAD, ramp), (Phase.HOLD, hold), (Phase.UNLOAD, ramp)
    )


def _tap_profile(pace: Pace) -> tuple[np.ndarray, np.ndarray]:
    """Equal taps, each a sixth approach, a third loading, a sixth holding, a third unloading; the first is longest."""
    each = pace.frames // pace.taps
    first = each + pace.frames - each * pace.taps
    pieces = [piece for n in (first, *[each] * (pace.taps - 1)) for piece in _tap(n)]
    return _profile(*pieces)


def _tap(frames: int) -> tuple[tuple[Phase, int], ...]:
    ramp, hold = frames // 3, frames // 6
    return (Phase.APPROACH, frames - 2 * ramp - hold), (Phase.LOAD, ramp), (Phase.HOLD, hold), (Phase.UNLOAD, ramp)


def _move_profile(pace: Pace) -> tuple[np.ndarray, np.ndarray]:
    """Approach, load, settle, move at constant force, unload."""
    still = pace.approach_frames + pace.load_frames + pace.settle_frames + pace.unload_frames
    return _profile(
        (Phase.APPROACH, pace.approach_frames),
        (Phase.LOAD, pace.load_frames),
        (Phase.HOLD, pace.settle_frames),
        (Phase.MOVE, pace.frames - still),
        (Phase.UNLOAD, pace.unload_frames),
    )


_PROFILES = {"press": _press_profile, "hold": _hold_profile, "tap": _tap_profile}


def _profile(*pieces: tuple[Phase, int]) -> tuple[np.ndarray, np.ndarray]:
    """Phase codes [F] and relative force [F]; a load ends at 1, an unloading at 0."""
    phase = np.concatenate([np.full(n, code, np.uint8) for code, n in pieces])
    level = np.concatenate([_level(code, n) for code, n in pieces])
    return phase, level


def _level(code: Phase, n: int) -> np.ndarray:
    progress = np.arange(1, n + 1) / n
    return {
        Phase.APPROACH: np.zeros(n),
        Phase.LOAD: progress**_RISE,
        Phase.HOLD: np.ones(n),
        Phase.UNLOAD: (1 - progress) ** _RISE,
        Phase.MOVE: np.ones(n),
    }[code]


def _path(motion: str, phase: np.ndarray, pace: Pace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slide [F, 2], twist [F], tilt [F, 2]; they rest at 0 outside the phase MOVE."""
    moving = phase == Phase.MOVE
    wave = np.zeros(len(phase))
    wave[moving] = _triangle(int(moving.sum())) if moving.any() else 0.0
    quarter_s = moving.sum() * pace.period_s / 4
    slide, twist, tilt = np.zeros((len(phase), 2)), np.zeros(len(phase)), np.zeros((len(phase), 2))
    if motion in ("slide_x", "slide_y"):
        slide[:, int(motion == "slide_y")] = wave * pace.slide_mm_per_s * quarter_s
    if motion == "twist":
        twist = wave * pace.twist_rad_per_s * quarter_s
    if motion == "roll":
        tilt[:, 0] = wave * pace.roll_rad_per_s * quarter_s
    return slide, twist, tilt


def _triangle(n: int) -> np.ndarray:
    """One cycle 0 → 1 → −1 → 0 of constant speed, the last of n frames back at 0."""
    t = np.arange(1, n + 1) / n
    return np.interp(t, [0, 0.25, 0.75, 1], [0, 1, -1, 0])
