"""From what a force sensor reads to the force on the gel at the moment of a frame.

A force–torque sensor under the gel's mount reads, in its own frame, with d the unit vector of gravity there,

    F = b + w d + F_contact,      M = b_M + c × w d + M_contact

Bias b, b_M, weight w and centre of mass c come from static poses without contact, by least squares; the rest is the
contact, turned into the gel's frame, moved to the centre of the window, and read at the time of the frame.
"""

import dataclasses

import numpy as np

from sensors_io.clock import NS_PER_S
from sensors_io.errors import UserError

GRAVITY_M_PER_S2 = 9.80665
_WORST_CONDITION = 100.0  # of the poses: errors of a reading grow by at most this
_STEPS = 4  # of the grid on which lags are looked for, in one frame period
_DEGREE = 3  # of the gel's response to force
_LEAST_WEIGHT_N = 0.02  # 2 g: below it a centre of mass cannot be determined


class ForceError(UserError, ValueError):
    """Readings from which nothing can be determined; the message says what to do about it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GravityModel:
    """Bias and dead weight of a force sensor.

    Args:
      bias_n, bias_nmm: reading without any load, [3] each.
      weight_n: of what is mounted on the sensor.
      first_moment_nmm: weight times centre of mass, [3].
      rms_n, rms_nmm: of the residuals of the fit.
      poses: it was fitted to.
    """

    bias_n: np.ndarray
    bias_nmm: np.ndarray
    weight_n: float
    first_moment_nmm: np.ndarray
    rms_n: float
    rms_nmm: float
    poses: int

    @property
    def mass_kg(self) -> float:
        """Mass of what is mounted on the sensor."""
        return self.weight_n / GRAVITY_M_PER_S2

    @property
    def centre_mm(self) -> np.ndarray:
        """Its centre of mass in the sensor's frame, [3].

        Raises:
          ForceError: it weighs too little to have one.
        """
        if self.weight_n < _LEAST_WEIGHT_N:
            raise ForceError(
                f"weight_n is {self.weight_n:.4f}: must be ≥ {_LEAST_WEIGHT_N} for a centre; none is needed"
            )
        return self.first_moment_nmm / self.weight_n

    def contact(self, force_n: np.ndarray, moment_nmm: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Readings [..., 3] less bias and weight.

        Args:
          force_n, moment_nmm: as read.
          down: unit vector of gravity in the sensor's frame, [..., 3].
        """
        force = force_n - self.bias_n - self.weight_n * down
        return force, moment_nmm - self.bias_nmm - np.cross(self.first_moment_nmm, down)


def fit_gravity(down: np.ndarray, force_n: np.ndarray, moment_nmm: np.ndarray) -> GravityModel:
    """Bias, weight and centre of mass by least squares.

    Args:
      down: unit vector of gravity in the sensor's frame at each pose, [P, 3]; see `gravity_directions`.
      force_n, moment_nmm: mean readings at each pose, without contact, [P, 3].

    Raises:
      ForceError: poses that do not determine all of them, or directions that are no unit vectors.
    """
    poses = len(down)
    if not np.allclose(np.linalg.norm(down, axis=-1), 1, atol=1e-3):
        raise ForceError("down holds vectors that are not of length 1: divide each by its length")
    eye = np.broadcast_to(np.eye(3), (poses, 3, 3))
    for_force = np.concatenate([eye, down[:, :, None]], -1).reshape(-1, 4)
    for_moment = np.concatenate([eye, -_cross_matrix(down)], -1).reshape(-1, 6)
    force, force_rms = _solve(for_force, force_n.ravel(), poses)
    moment, moment_rms = _solve(for_moment, moment_nmm.ravel(), poses)
    return GravityModel(
        bias_n=force[:3],
        bias_nmm=moment[:3],
        weight_n=float(force[3]),
        first_moment_nmm=moment[3:],
        rms_n=force_rms,
        rms_nmm=moment_rms,
        poses=poses,
    )


def gravity_directions(force_n: np.ndarray) -> np.ndarray:
    """Direction of gravity at poses that nobody measured: readings without contact lie on a sphere about the bias.

        |F|² = 2 b · F + (w² − |b|²),      d = (F − b) / w

    Args:
      force_n: mean readings, [P, 3], P ≥ 4, turned in all directions.

    Returns:
      Unit vectors [P, 3].

    Raises:
      ForceError: readings that span no sphere.
    """
    design = np.concatenate([2 * force_n, np.ones((len(force_n), 1))], -1)
    scale = np.linalg.norm(force_n - force_n.mean(0), axis=-1).mean()
    spread = np.linalg.svd(force_n - force_n.mean(0), compute_uv=False)
    if len(force_n) < 4 or spread[-1] < scale / _WORST_CONDITION * np.sqrt(len(force_n)):
        raise ForceError(
            f"force_n holds {len(force_n)} readings that span no sphere: turn the sensor in all directions"
        )
    solution = np.linalg.lstsq(design, np.sum(force_n**2, -1), rcond=None)[0]
    away = force_n - solution[:3]
    return away / np.linalg.norm(away, axis=-1, keepdims=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mount:
    """Mounting of the gel on the force sensor.

    Args:
      rotation: turns the sensor's axes into the gel's (x right, y down, z out of the gel), [3, 3].
      offset_mm: from the sensor's origin to the centre of the window, in the sensor's frame, [3].
      sign: +1 where the sensor reads the force on what is mounted on it, −1 where it reads the reaction: a press must
        come out as Fz < 0.
    """

    rotation: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    offset_mm: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    sign: int = 1

    def __post_init__(self) -> None:
        product = self.rotation @ self.rotation.T
        if not np.allclose(product, np.eye(3), atol=1e-6) or np.linalg.det(self.rotation) < 0:
            raise ForceError(
                f"rotation is {self.rotation.tolist()}: must be a rotation; a mirrored frame has no moments"
            )
        if self.sign not in (-1, 1):
            raise ForceError(f"sign is {self.sign}: must be 1 or −1; press the gel and see which gives Fz < 0")

    def to_gel(self, force_n: np.ndarray, moment_nmm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Force and moment [..., 3] in the gel's frame, the moment about the centre of the window."""
        moved = moment_nmm - np.cross(self.offset_mm, force_n)
        return self.sign * force_n @ self.rotation.T, self.sign * moved @ self.rotation.T


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lag:
    """By how much frames are stamped later than the forces that shaped them, and how well that is known."""

    seconds: float
    correlation: float


def estimate_lag(
    frame_time_ns: np.ndarray,
    signal: np.ndarray,
    force_time_ns: np.ndarray,
    force_n: np.ndarray,
    *,
    max_lag_s: float = 0.3,
    least_correlation: float = 0.6,
) -> Lag:
    """Lag between a picture's response and the force, from where their rates of change agree best.

    Both are brought to a grid of a quarter of the frame period, averaged over one frame period and differentiated,
    which takes out offset and creep; the peak of their correlation is refined by a parabola.  A second round replaces
    the force by the cubic polynomial of it that fits the signal best, for a gel responds less and less.

    Args:
      frame_time_ns, signal: one number per frame that grows with the load, such as the mean change of the picture, [N].
      force_time_ns, force_n: magnitude of the force, [M], over the same time.
      max_lag_s: largest lag either way.
      least_correlation: a worse agreement is refused.

    Raises:
      ForceError: too short, nothing happens in one of them, or no agreement within `max_lag_s`.
    """
    start = max(frame_time_ns[0], force_time_ns[0])
    period_s = float(np.median(np.diff(frame_time_ns))) / NS_PER_S
    step_s = period_s / _STEPS
    grid = np.arange(0, (min(frame_time_ns[-1], force_time_ns[-1]) - start) / NS_PER_S, step_s)
    reach = int(np.ceil(max_lag_s / step_s))
    if len(grid) < 4 * reach:
        raise ForceError(
            f"the recording overlaps by {len(grid) * step_s:.2f} s: must be ≥ {4 * max_lag_s} s; record longer"
        )
    seen = np.interp(grid, (frame_time_ns - start) / NS_PER_S, signal)
    pressed = np.interp(grid, (force_time_ns - start) / NS_PER_S, force_n)
    shift, _ = _best_shift(seen, pressed, reach)
    inner = slice(reach, len(grid) - reach)
    curve = np.polynomial.Polynomial.fit(np.roll(pressed, round(shift))[inner], seen[inner], _DEGREE)
    shift, agreement = _best_shift(seen, curve(pressed), reach)
    if not agreement >= least_correlation or abs(shift) >= reach:
        raise ForceError(
            f"picture and force agree by {agreement:.2f} at most: must be ≥ {least_correlation} within "
            f"{max_lag_s} s; press and release a few times, and check which force sensor this is"
        )
    return Lag(seconds=shift * step_s, correlation=agreement)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ForceAtFrames:
    """Readings brought to the times of frames.

    Args:
      value: [N, k].
      time_ns: of the reading, on the force sensor's clock mapped to the host's: frame time less lag, int64 [N].
      covered: whether readings lie on either side and close enough; elsewhere `value` is the nearest one, [N].
      residual: distance of the readings next to each frame from the line between their neighbours, the larger one and
        its largest component, [N]; what linear interpolation at half the rate would err by.
    """

    value: np.ndarray
    time_ns: np.ndarray
    covered: np.ndarray
    residual: np.ndarray


def at_frames(
    frame_time_ns: np.ndarray,
    force_time_ns: np.ndarray,
    value: np.ndarray,
    *,
    lag_s: float = 0.0,
    max_gap_s: float = 0.05,
) -> ForceAtFrames:
    """Interpolate readings linearly to the times of frames.

    Args:
      frame_time_ns: [N].
      force_time_ns: ascending, [M].
      value: [M, k].
      lag_s: of the frames, see `estimate_lag`.
      max_gap_s: readings further apart do not cover what lies between them.

    Raises:
      ForceError: fewer than three readings, or times that do not rise.
    """
    if len(force_time_ns) < 3 or np.any(np.diff(force_time_ns) <= 0):
        raise ForceError(
            f"force_time_ns holds {len(force_time_ns)} times: must be ≥ 3 and rise; look at the force sensor"
        )
    wanted = frame_time_ns - round(lag_s * NS_PER_S)
    after = np.clip(np.searchsorted(force_time_ns, wanted, "right"), 1, len(force_time_ns) - 1)
    before = after - 1
    gap = force_time_ns[after] - force_time_ns[before]
    share = np.clip((wanted - force_time_ns[before]) / gap, 0, 1)
    inside = (wanted >= force_time_ns[0]) & (wanted <= force_time_ns[-1])
    line = (value[:-2] + value[2:]) / 2
    bend = np.abs(value[1:-1] - line).max(-1)
    either_side = np.clip(np.stack([before, after]) - 1, 0, len(bend) - 1)
    return ForceAtFrames(
        value=value[before] + share[:, None] * (value[after] - value[before]),
        time_ns=wanted,
        covered=inside & (gap <= max_gap_s * NS_PER_S),
        residual=bend[either_side].max(0),
    )


def _cross_matrix(v: np.ndarray) -> np.ndarray:
    """[v]× with [v]× q = v × q, [P, 3, 3]."""
    zero = np.zeros(len(v))
    x, y, z = v.T
    return np.stack([np.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], -2)


def _solve(design: np.ndarray, seen: np.ndarray, poses: int) -> tuple[np.ndarray, float]:
    if design.shape[0] < design.shape[1] or np.linalg.cond(design) > _WORST_CONDITION:
        raise ForceError(
            f"down holds {poses} poses that do not separate bias from weight: turn the sensor in more directions"
        )
    solution = np.linalg.lstsq(design, seen, rcond=None)[0]
    return solution, float(np.sqrt(np.mean((design @ solution - seen) ** 2)))


def _best_shift(seen: np.ndarray, pressed: np.ndarray, reach: int) -> tuple[float, float]:
    """By how many steps `seen` comes later, ± reach, and how well the rates of change then agree."""
    a, b = _rate(seen), _rate(pressed)
    inner = slice(reach, len(a) - reach)
    shifts = np.arange(-reach, reach + 1)
    agreement = np.array([_correlation(a[inner], np.roll(b, k)[inner]) for k in shifts])
    best = int(np.argmax(agreement))
    if best in (0, len(shifts) - 1):
        return float(shifts[best]), float(agreement[best])
    before, peak, after = agreement[best - 1 : best + 2]
    bend = before - 2 * peak + after
    return float(shifts[best] + (0.5 * (before - after) / bend if bend < 0 else 0.0)), float(peak)


def _rate(value: np.ndarray) -> np.ndarray:
    """Differences of the mean over one frame period."""
    return np.diff(np.convolve(value, np.full(_STEPS, 1 / _STEPS), "same"))


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    scale = float(np.sqrt(np.sum(a**2) * np.sum(b**2)))
    return float(np.sum(a * b)) / scale if scale else 0.0
