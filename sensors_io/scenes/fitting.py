"""Fit of the photometric optics to pictures of a rigid ball pressed into a real sensor.

A press is three numbers, the *touch*: where the ball's axis meets the window and how wide the contact is.  Given the
touches, the contact solver gives slopes and depth, and the optics follow by linear least squares; given the optics,
each touch follows by non-linear least squares on its own picture.  Both alternate, from touches that are given.

Departures: the ball is rigid, the gel has the modelled thickness and, as in all scenes, small strain; tilt, friction
and the gel's edge are ignored.
"""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from scipy import ndimage, optimize

from sensors_io import layer
from sensors_io.scenes import contact, photometric
from sensors_io.scenes.photometric import FLAT_DEGREE, SLOPE_DEGREE, PhotometricOptics, basis

NEAR_MM = 4.2
"""From the axis of the ball: beyond it a press leaves no mark above the noise."""

CONTACT_MM = (0.8, 2.8)
"""Contact radii that are considered."""

ROUNDS = 4
RIDGE = 1e-6
"""Of the mean diagonal of the normal equations: decides only what no press constrains."""

_NORMAL_MAD = 1.4826  # standard deviation over median absolute deviation of a normal variable


@dataclasses.dataclass(frozen=True, kw_only=True)
class BallPictures:
    """Pictures of presses [P, N, N, 3] and of the gel at rest [N, N, 3], RGB in 0..1; the ball's radius; the scale."""

    pictures: np.ndarray
    background: np.ndarray
    radius_mm: float
    mm_per_px: float

    def __post_init__(self) -> None:
        shape = self.pictures.shape
        if len(shape) != 4 or shape[1] != shape[2] or shape[1:] != self.background.shape or shape[-1] != 3:
            raise ValueError(
                f"pictures have shape {shape}, background {self.background.shape}: must be [P, N, N, 3] and [N, N, 3]; "
                "crop them to one square"
            )

    @property
    def axis_mm(self) -> np.ndarray:
        """Pixel centres along x, and along y, from the centre, [N]."""
        n = self.pictures.shape[1]
        return (np.arange(n) - (n - 1) / 2) * self.mm_per_px

    @property
    def window_mm(self) -> float:
        """Side of the pictures."""
        return self.pictures.shape[1] * self.mm_per_px


@dataclasses.dataclass(frozen=True, kw_only=True)
class Profiles:
    """Indentation of the gel by a ball, by contact radius a and distance r from the axis: mm at r = a · `ratio`."""

    contact_mm: np.ndarray
    ratio: np.ndarray
    depth_mm: np.ndarray

    def at(self, contact_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """r, depth and its slope against r for one contact radius, each [K]."""
        r = contact_mm * self.ratio
        k = np.clip(np.searchsorted(self.contact_mm, contact_mm), 1, len(self.contact_mm) - 1)
        low, high = self.contact_mm[k - 1 : k + 1]
        share = (contact_mm - low) / (high - low)
        depth = (1 - share) * self.depth_mm[k - 1] + share * self.depth_mm[k]
        return r, depth, np.gradient(depth, r)

    def field(self, touch: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth, mm, and its slopes along x and y of a touch at points x, y, mm, each of their common shape."""
        dx, dy = x - touch[0], y - touch[1]
        away = np.hypot(dx, dy)
        r, depth, slope = self.at(touch[2])
        per_mm = np.interp(away, r, slope) / np.maximum(away, 1e-9)
        return np.interp(away, r, depth), per_mm * dx, per_mm * dy


@dataclasses.dataclass(frozen=True, kw_only=True)
class Noise:
    """Of pictures in 0..1, per channel: standard deviation read + shot √I from frame to frame, and the fixed grain.

    `grain` is relative to I, `shared` the correlation of two channels' grain.
    """

    read: tuple[float, float, float]
    shot: tuple[float, float, float]
    grain: tuple[float, float, float]
    shared: float


def ball_profiles(gel: layer.Layer, radius_mm: float, presses: int = 24, side_mm: float = 18.0) -> Profiles:
    """Solve a rigid ball on the gel over forces that cover `CONTACT_MM`."""
    pixels = 180
    spacing = side_mm / pixels
    x = (np.arange(pixels) + 0.5) * spacing - side_mm / 2
    away = np.hypot(x[:, None], x[None])
    gap = _ball(away, radius_mm)
    q = np.hypot(*layer.wave_numbers(288, spacing))  # leaves 2.4 thicknesses of a 4.5 mm gel between periodic images
    spectrum = jnp.asarray(layer.normal_compliance(q, gel), jnp.float32)
    ratio = np.arange(0, 9, 0.04)
    contacts, depths = [], []
    for force in gel.modulus_mpa * np.geomspace(0.1, 40, presses):
        solved = contact.solve(jnp.asarray(gap, jnp.float32), jnp.float32(force), spectrum, 0 * spectrum, spacing, 1e-4)
        contacts.append(spacing * np.sqrt(np.sum(np.asarray(solved.pressure_mpa) > 0) / np.pi))
        r = contacts[-1] * ratio
        outside = _radial_mean(np.asarray(solved.displacement_mm), away, r)
        depths.append(np.where(ratio < 1, float(solved.approach_mm) - _ball(r, radius_mm), outside))
    return Profiles(contact_mm=np.array(contacts), ratio=ratio, depth_mm=np.array(depths))


def fit(presses: BallPictures, profiles: Profiles, touches: np.ndarray) -> PhotometricOptics:
    """Optics by linear least squares: the flat field from the background, slope and depth from the presses' changes."""
    half, axis = presses.window_mm / 2, presses.axis_mm
    x = axis / half
    flat = _least_squares(basis(x, x, FLAT_DEGREE).reshape(-1, x.size**2).T, presses.background.reshape(-1, 3))
    grid = basis(x, x, SLOPE_DEGREE)
    size = 5 * len(grid) + 1
    normal, right, steepest = np.zeros((size, size)), np.zeros((size, 3)), 0.0
    for touch, picture in zip(touches, presses.pictures, strict=True):
        close = near(axis, touch)
        features = _features(profiles, touch, *points(axis, touch))
        rows = np.stack([f * g for f in features[:5] for g in grid[:, close]] + [features[5]], -1)
        normal, right = normal + rows.T @ rows, right + rows.T @ (picture - presses.background)[close]
        steepest = max(steepest, float(np.hypot(*features[:2]).max()))
    weights = np.linalg.solve(normal + RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal)), right)
    return PhotometricOptics(
        half_window_mm=half, flat=_rows(flat), slope=_rows(weights[:-1]), depth=_rows(weights[-1:]), max_tilt=steepest
    )


def align(presses: BallPictures, profiles: Profiles, touches: np.ndarray, optics: PhotometricOptics) -> np.ndarray:
    """Touches that explain each picture best, given the optics; [P, 3]."""
    return np.array(
        [
            _align_one(presses, profiles, picture, touch, optics)
            for picture, touch in zip(presses.pictures, touches, strict=True)
        ]
    )


def fit_jointly(
    presses: BallPictures,
    profiles: Profiles,
    begun: np.ndarray,
    train: np.ndarray,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[PhotometricOptics, np.ndarray]:
    """Optics from the presses `train` alone, and touches of all: the others are only aligned to finished optics.

    Args:
      presses: the pictures.
      profiles: of their ball.
      begun: about where the touches are (x, y, contact radius), mm, [P, 3].
      train: indices of the presses that are fitted.
      progress: called with the number of rounds done and of all, the last of which aligns all presses.
    """
    touches = np.column_stack([begun[:, :2], np.clip(begun[:, 2], *CONTACT_MM)])
    chosen = dataclasses.replace(presses, pictures=presses.pictures[train])
    optics = fit(chosen, profiles, touches[train])
    for n in range(ROUNDS):
        touches[train] = align(chosen, profiles, touches[train], optics)
        optics = fit(chosen, profiles, touches[train])
        progress(n + 1, ROUNDS + 1)
    touches = align(presses, profiles, touches, optics)
    progress(ROUNDS + 1, ROUNDS + 1)
    return optics, touches


def change(
    optics: PhotometricOptics, profiles: Profiles, touch: np.ndarray, axis_mm: np.ndarray, window_mm: float
) -> np.ndarray:
    """Change of the picture due to touch, added to the flat field, [N, N, 3]."""
    slope = photometric.fields(optics, len(axis_mm), window_mm)[1]
    features = _features(profiles, touch, axis_mm[None, :], axis_mm[:, None])
    return np.einsum("fyx,fcyx->yxc", features[:5], slope) + features[5][..., None] * np.array(optics.depth[0])


def near(axis_mm: np.ndarray, touch: np.ndarray) -> np.ndarray:
    """The pixels [N, N] within `NEAR_MM` of the axis of the ball."""
    mask: np.ndarray = np.hypot(axis_mm[None, :] - touch[0], axis_mm[:, None] - touch[1]) < NEAR_MM
    return mask


def points(axis_mm: np.ndarray, touch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y of those pixels, mm, each [n]."""
    row, column = np.nonzero(near(axis_mm, touch))
    return axis_mm[column], axis_mm[row]


def measure_noise(presses: BallPictures, touches: np.ndarray, optics: PhotometricOptics) -> Noise:
    """Noise and grain, high-passed, away from the press, of what the flat field leaves.

    The median over the presses is the fixed part; what is left of each picture is noise, its standard deviation taken
    robustly per pixel over the presses and regressed on √I.

    Args:
      presses: four pictures or more, so that no pixel is near all of them.
      touches: [P, 3].
      optics: fitted to them.
    """
    flat = photometric.fields(optics, len(presses.axis_mm), presses.window_mm)[0].transpose(1, 2, 0)
    fine = np.stack([_high_pass(p - flat) for p in presses.pictures])
    fine[np.stack([near(presses.axis_mm, touch) for touch in touches])] = np.nan
    fixed = np.nanmedian(fine, 0)
    std = _NORMAL_MAD * np.nanmedian(np.abs(fine - fixed), 0).reshape(-1, 3)
    root = np.sqrt(presses.background).reshape(-1, 3)
    lines = [optimize.nnls(np.stack([np.ones(len(root)), root[:, c]], -1), std[:, c])[0] for c in range(3)]
    relative = (fixed / presses.background).reshape(-1, 3)
    grain = _NORMAL_MAD * np.median(np.abs(relative), 0)
    relative = np.clip(relative, -4 * grain, 4 * grain)  # specks and scratches are no grain
    read, shot = np.array(lines).T
    shared = (np.corrcoef(relative.T).sum() - 3) / 6
    return Noise(read=_rgb(read), shot=_rgb(shot), grain=_rgb(grain), shared=float(shared))


def _align_one(
    presses: BallPictures, profiles: Profiles, picture: np.ndarray, touch: np.ndarray, optics: PhotometricOptics
) -> np.ndarray:
    axis = presses.axis_mm
    close, at = near(axis, touch), points(axis, touch)
    seen = ndimage.gaussian_filter(picture - presses.background, (0.7, 0.7, 0))[close].T
    slope = photometric.fields(optics, len(axis), presses.window_mm)[1][..., close]
    depth = np.array(optics.depth[0])[:, None]

    def misfit(candidate: np.ndarray) -> np.ndarray:
        features = _features(profiles, candidate, *at)
        made = np.einsum("fn,fcn->cn", features[:5], slope) + depth * features[5]
        return (made - seen).ravel()

    reach = presses.window_mm / 2 + NEAR_MM
    bounds = ([-reach, -reach, CONTACT_MM[0]], [reach, reach, CONTACT_MM[1]])
    found: np.ndarray = optimize.least_squares(misfit, touch, bounds=bounds, diff_step=1e-3, max_nfev=10).x
    return found


def _features(profiles: Profiles, touch: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """φ_1..φ_5 and the depth of a touch at n points, [6, n]."""
    depth, d_x, d_y = profiles.field(touch, x, y)
    up = 1 / np.sqrt(1 + d_x**2 + d_y**2)
    n_x, n_y = d_x * up, d_y * up
    return np.stack([n_x, n_y, n_x**2, n_x * n_y, n_y**2, depth])


def _ball(r: np.ndarray, radius_mm: float) -> np.ndarray:
    """Height of a ball above its lowest point at distances r from the axis; steep past 0.97 of its radius."""
    inside = np.minimum(r, 0.97 * radius_mm)
    height: np.ndarray = radius_mm - np.sqrt(radius_mm**2 - inside**2) + 4 * (r - inside)
    return height


def _radial_mean(field: np.ndarray, away: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Mean of a field over 400 rings of equally many pixels, at distances r; past the outermost ring its value."""
    rings = np.array_split(np.argsort(away, axis=None), 400)
    centre, value = ([float(f.ravel()[ring].mean()) for ring in rings] for f in (away, field))
    return np.interp(r, centre, value)


def _high_pass(picture: np.ndarray) -> np.ndarray:
    return picture - ndimage.gaussian_filter(picture, (2, 2, 0))


def _least_squares(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(rows, values, rcond=None)[0]


def _rows(values: np.ndarray) -> photometric.Rows:
    """To 5 decimals, which is a hundredth of a grey level."""
    return tuple(_rgb(row) for row in values)


def _rgb(row: np.ndarray) -> tuple[float, float, float]:
    r, g, b = (round(float(value), 5) for value in row)
    return r, g, b
