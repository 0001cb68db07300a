"""Instructions for the operator's hand, from the measured force alone.

Two stages.  A press: from first touch to 20 N.  Then six motions at 2, 5 and 10 N each: load, settle, move, unload; a
tap loads and unloads three times; a hold waits at its force.  The coach sees one force after the other and answers with
a prompt, the phase that is under way, and whether to record.
"""

import collections
import dataclasses

import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.schema import EXPLORATORY, FORCES_N, PRESS_FORCE_N, Phase

_MOVING = {
    "slide_x": "slide 4 mm right, 4 mm left, and back",
    "slide_y": "slide 4 mm down, 4 mm up, and back",
    "twist": "twist 30° clockwise, 30° back past the start, and return",
    "roll": "tilt 10° to the right, 10° to the left, and back",
}


_GLITCH_NS = 10_000_000  # within which the median of the readings counts: one wrong reading is no press and no release
_REST_S = 1.0  # of free motion, whose first pictures are taken for the gel at rest


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactStage:
    """One contact of the protocol: its motion, the normal force it is made at, and which force level that is."""

    motion: str
    force_n: float
    level: int = 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class CoachConfig:
    """Thresholds of force and time.

    Args:
      touch_n: less is no contact; three times the noise of a 6-D sensor.
      clear_s: so long must nothing touch before a contact.
      reached_share: of the target that counts as reached; a hand stops short rather than past it.
      settle_s: at the target before a motion.
      hold_s: of the motion "hold".
      move_s: of a motion.
      taps: of the motion "tap".
      overload_n: at which the hand must stop; half of what the sensors bear.
    """

    touch_n: float = 0.1
    clear_s: float = 0.5
    reached_share: float = 0.95
    settle_s: float = 0.2
    hold_s: float = 1.8
    move_s: float = 2.3
    taps: int = 3
    overload_n: float = 22.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if getattr(self, field.name) <= 0:
                raise ValueError(f"{field.name} is {getattr(self, field.name)}: must be > 0; raise it")
        if self.reached_share > 1:
            raise ValueError(f"reached_share is {self.reached_share}: must be ≤ 1, a share of the target; lower it")
        for name, least, most in (
            ("touch_n", 0.0, self.reached_share * min(FORCES_N)),  # or a hand at the target would touch nothing
            ("overload_n", self.reached_share * PRESS_FORCE_N, np.inf),  # or the press would end in a stop
        ):
            if not least < getattr(self, name) < most:
                raise ValueError(
                    f"{name} is {getattr(self, name)}: must lie between {least:g} and {most:g} N, or no contact is "
                    "ever complete; correct it"
                )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Advice:
    """Instruction that follows from the last force.

    Args:
      prompt: to the hand.
      phase: under way.
      recording: whether frames belong to the contact.
      done: the contact is over.
      complete: it went through all of its phases.
      normal_n: normal force, pressing positive.
      target_n: of the stage.
    """

    prompt: str
    phase: Phase
    recording: bool
    done: bool
    complete: bool
    normal_n: float
    target_n: float


def protocol() -> tuple[ContactStage, ...]:
    """All contacts at one site: the press, then every motion at every force, gentlest first."""
    moves = [ContactStage(motion=m, force_n=f, level=k) for k, f in enumerate(FORCES_N) for m in EXPLORATORY]
    return (ContactStage(motion="press", force_n=PRESS_FORCE_N), *moves)


class Coach:
    """Leads one contact.

    Args:
      stage: which contact.
      config: thresholds.
    """

    def __init__(self, stage: ContactStage, config: CoachConfig | None = None):
        self._stage = stage
        self._config = config or CoachConfig()
        self._clear_since_ns: int | None = None
        self._latest: collections.deque[tuple[int, float]] = collections.deque()
        self._armed = False
        self._phase = Phase.APPROACH
        self._since_ns = 0
        self._tapped = 0
        self._normal = 0.0
        self._done = self._complete = False

    @property
    def begun(self) -> bool:
        """True from the first touch on."""
        return self._phase != Phase.APPROACH or self._tapped > 0 or self._done

    def step(self, time_ns: int, force_n: np.ndarray) -> Advice:
        """Take one force [3] on the gel into account; one that is not finite, or that a later one overtook, is none."""
        latest = self._latest
        if np.isfinite(force_n).all() and (not latest or time_ns >= latest[-1][0]):
            latest.append((time_ns, -float(force_n[2])))
            while time_ns - latest[0][0] > _GLITCH_NS:
                latest.popleft()
            self._normal = sorted(normal for _, normal in latest)[len(latest) // 2]
            if not self._armed:
                self._arm(time_ns, self._normal)
            elif not self._done:
                self._advance(time_ns, self._normal)
        return Advice(
            prompt=self._prompt(self._normal),
            phase=self._phase,
            recording=self._armed and not self._done,
            done=self._done,
            complete=self._complete,
            normal_n=self._normal,
            target_n=self._stage.force_n,
        )

    def _arm(self, time_ns: int, normal: float) -> None:
        if abs(normal) >= self._config.touch_n:
            self._clear_since_ns = None
        elif self._clear_since_ns is None:
            self._clear_since_ns = time_ns
        elif time_ns - self._clear_since_ns >= self._config.clear_s * NS_PER_S:
            self._armed = True

    def _advance(self, time_ns: int, normal: float) -> None:
        c, reached = self._config, normal >= self._config.reached_share * self._stage.force_n
        lasted_s = (time_ns - self._since_ns) / NS_PER_S
        released = normal < c.touch_n
        if self._phase == Phase.APPROACH:
            if not released:
                self._enter(Phase.LOAD, time_ns)
        elif self._phase == Phase.LOAD and reached:
            self._after_load(time_ns)
        elif self._phase in (Phase.LOAD, Phase.HOLD, Phase.MOVE) and released:
            self._done = True  # let go too early: kept, and asked for again
        elif self._phase == Phase.HOLD and lasted_s >= (c.hold_s if self._stage.motion == "hold" else c.settle_s):
            self._enter(Phase.UNLOAD if self._stage.motion == "hold" else Phase.MOVE, time_ns)
        elif self._phase == Phase.MOVE and lasted_s >= c.move_s:
            self._enter(Phase.UNLOAD, time_ns)
        elif self._phase == Phase.UNLOAD and released:
            self._after_unload(time_ns)

    def _after_load(self, time_ns: int) -> None:
        if self._stage.motion == "press":
            self._done = self._complete = True
        else:
            self._enter(Phase.UNLOAD if self._stage.motion == "tap" else Phase.HOLD, time_ns)

    def _after_unload(self, time_ns: int) -> None:
        self._tapped += 1
        if self._stage.motion == "tap" and self._tapped < self._config.taps:
            self._enter(Phase.APPROACH, time_ns)
        else:
            self._done = self._complete = True

    def _enter(self, phase: Phase, time_ns: int) -> None:
        self._phase, self._since_ns = phase, time_ns

    def _prompt(self, normal: float) -> str:
        stage, force = self._stage, f"{self._stage.force_n:g} N"
        if self._done:
            return "done: release" if self._complete else "released too early: again"
        if normal >= self._config.overload_n:
            return f"STOP: {normal:.1f} N, release"
        if not self._armed:
            return "keep clear of the gel"
        if normal > 1.2 * stage.force_n and self._phase in (Phase.HOLD, Phase.MOVE):
            return f"less: back to {force}"
        return {
            Phase.APPROACH: f"{stage.motion}: touch, then press slowly to {force}",
            Phase.LOAD: f"press slowly on to {force}",
            Phase.HOLD: f"hold {force}",
            Phase.UNLOAD: "release slowly",
            Phase.MOVE: f"at {force}, {_MOVING.get(stage.motion, 'hold')}",
        }[self._phase]


class FreeCoach:
    """Records without a protocol for some time; needs no force.

    Args:
      seconds: from the first sample on.
    """

    def __init__(self, seconds: float):
        self._seconds = seconds
        self._start_ns: int | None = None
        self.begun = True

    def step(self, time_ns: int, force_n: np.ndarray) -> Advice:
        """Take one moment into account; `force_n` is shown only."""
        self._start_ns = time_ns if self._start_ns is None else self._start_ns
        left_s = self._seconds - (time_ns - self._start_ns) / NS_PER_S
        at_first = "; touch nothing yet, for the gel at rest" if left_s > self._seconds - _REST_S else ""
        return Advice(
            prompt=f"free motion: {max(0.0, left_s):.0f} s left{at_first}",
            phase=Phase.APPROACH,
            recording=left_s > 0,
            done=left_s <= 0,
            complete=True,
            normal_n=-float(np.nan_to_num(force_n[2])),
            target_n=0.0,
        )
