"""Static poses of a force sensor, found in its readings while a hand turns it.

A pose is a stretch of `hold_s` in which no component of the force spreads by more than `still_n`, and whose mean lies
`apart_n` or more from that of every pose before it.
"""

import collections
import dataclasses
import pathlib
from typing import Self

import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.errors import MALFORMED, name_and_text
from sensors_io.force import ForceError, GravityModel, fit_gravity, gravity_directions
from sensors_io.json_files import read_json, write_json

_LEAST_READINGS = 8  # in a stretch: fewer show no spread
_UNIT = 1e-3  # by which the length of a direction may differ from 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class PoseConfig:
    """Criteria for a hand at rest.

    Args:
      hold_s: length of a stretch.
      still_n: largest standard deviation in it, of any component; thrice the noise of a small 6-D sensor.
      apart_n: least distance of its mean from those before it.
    """

    hold_s: float = 0.5
    still_n: float = 0.03
    apart_n: float = 0.1

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if not getattr(self, field.name) > 0:
                raise ValueError(f"{field.name} is {getattr(self, field.name)}: must be > 0; raise it")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PoseReading:
    """Mean reading of one pose: force [3], moment [3], and the largest standard deviation of a force component."""

    force_n: np.ndarray
    moment_nmm: np.ndarray
    spread_n: float


class PoseFinder:
    """Finds poses in readings as they come.

    Args:
      config: what counts as one.
    """

    def __init__(self, config: PoseConfig | None = None):
        self._config = config or PoseConfig()
        self._recent: collections.deque[tuple[int, np.ndarray]] = collections.deque()
        self.poses: list[PoseReading] = []

    def offer(self, time_ns: int, force_n: np.ndarray, moment_nmm: np.ndarray) -> PoseReading | None:
        """Take one reading into account; the pose that it completes.

        Args:
          time_ns: of the reading, not before the last one.
          force_n, moment_nmm: [3] each.
        """
        c, recent = self._config, self._recent
        recent.append((time_ns, np.concatenate([force_n, moment_nmm]).astype(np.float64)))
        if time_ns - recent[0][0] < c.hold_s * NS_PER_S or len(recent) < _LEAST_READINGS:
            return None
        values = np.stack([value for _, value in recent])
        spread_n = float(values[:, :3].std(0).max())
        mean = values.mean(0)
        if not spread_n <= c.still_n or self._known(mean[:3]):
            self._forget_half()
            return None
        recent.clear()
        pose = PoseReading(force_n=mean[:3], moment_nmm=mean[3:], spread_n=spread_n)
        self.poses.append(pose)
        return pose

    def _known(self, force_n: np.ndarray) -> bool:
        return any(np.linalg.norm(pose.force_n - force_n) < self._config.apart_n for pose in self.poses)

    def _forget_half(self) -> None:
        """Go on with the later half of the stretch, so that a pose is found within half a stretch of its beginning."""
        for _ in range(len(self._recent) // 2 + 1):
            self._recent.popleft()


@dataclasses.dataclass(frozen=True, kw_only=True)
class ForceZero:
    """Bias and dead weight, and which way is down in the last pose, a unit vector in the sensor's frame [3]."""

    model: GravityModel
    down: np.ndarray

    def save(self, path: pathlib.Path) -> None:
        """Write it as JSON, whole or not at all."""
        tree = dataclasses.asdict(self.model) | {"down": self.down}
        plain = {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in tree.items()}
        write_json(path, plain)

    @classmethod
    def load(cls, path: pathlib.Path) -> Self:
        """Read what `save` wrote.

        Raises:
          ForceError: there is no such file, or a field is missing or is no finite number.
        """
        try:
            tree = read_json(path)
            tree = {name: np.array(v, np.float64) if isinstance(v, list) else v for name, v in tree.items()}
            down = tree.pop("down").reshape(3)
            model = GravityModel(**{**tree, "weight_n": float(tree["weight_n"])})
            for v in (model.bias_n, model.bias_nmm, model.first_moment_nmm, down):
                if v.shape != (3,) or not np.isfinite(v).all():
                    raise ValueError("its vectors must have three finite numbers")
            if not np.isfinite(model.weight_n) or not np.isclose(np.linalg.norm(down), 1, atol=_UNIT):
                raise ValueError("weight_n must be finite, and down of length 1")
            return cls(model=model, down=down)
        except (OSError, *MALFORMED) as error:
            raise ForceError(
                f"{path} holds no gravity model ({name_and_text(error)}); make one with `force-zero`"
            ) from error


def fit_poses(poses: list[PoseReading]) -> ForceZero:
    """Bias, weight and centre of mass from poses that nobody measured, by least squares.

    The directions of gravity follow from the sphere that the forces lie on, see `gravity_directions`.  The residual of
    the force is therefore only its distance from that sphere; that of the moment is a check in its own right.

    Args:
      poses: in all directions; the last one is that in which the sensor will be used.

    Raises:
      ForceError: too few poses, or too little of a turn between them.
    """
    force, moment = (np.stack([getattr(p, name) for p in poses]) for name in ("force_n", "moment_nmm"))
    down = gravity_directions(force)
    return ForceZero(model=fit_gravity(down, force, moment), down=down[-1])
