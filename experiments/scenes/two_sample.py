"""Distance between two sets of pictures: statistics of intensity, gradient and spectrum, and a classifier's accuracy.

Pictures are RGB uint8 [P, N, N, 3]; picture p of both sets shows the same scene, so that appearance alone differs.
"""

import dataclasses

import numpy as np
from scipy import ndimage, optimize

PATCH_PX = 32
BANDS = ((1, 1), (2, 2), (3, 4), (5, 7), (8, 10), (11, 13), (14, 16))
"""Waves per patch, first and last of each band."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PictureDistances:
    """Between two sets of pictures, in grey levels but for the spectrum.

    Args:
      pixel: rms difference of pictures of the same scene.
      intensity: Wasserstein-1 distance of the intensities, mean over the channels.
      gradient: the same for the magnitudes of the gradient, levels per pixel.
      spectrum_db: rms over rings of wave numbers of 10 log₁₀ of the ratio of the powers, mean over the channels.
    """

    pixel: float
    intensity: float
    gradient: float
    spectrum_db: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class PatchClassifier:
    """A logistic regression on statistics of patches: levels, contrast, spectrum, steps, channels' correlation, peaks.

    Stronger here than a small convolutional network, which a few dozen pictures cannot teach fine texture.

    Args:
      patches: per picture.
      ridge: penalty on the squared weights of the standardised statistics.
    """

    patches: int = 32
    ridge: float = 1e-3


def distances(real: np.ndarray, made: np.ndarray) -> PictureDistances:
    """Statistics of `made` against `real`, both [P, N, N, 3] of the same scenes."""
    a, b = (pictures.astype(np.float64) for pictures in (real, made))
    spectra = 10 * np.log10(_ring_power(a) / _ring_power(b))
    return PictureDistances(
        pixel=float(np.sqrt(np.mean((a - b) ** 2))),
        intensity=_wasserstein(a, b),
        gradient=_wasserstein(_gradient(a), _gradient(b)),
        spectrum_db=float(np.sqrt(np.mean(spectra**2, 0)).mean()),
    )


def accuracy(real: np.ndarray, made: np.ndarray, centres: np.ndarray, judge: PatchClassifier) -> tuple[float, float]:
    """Share of held-out patches that a classifier assigns to the right set, and its standard error over pictures.

    Two folds: trained on the patches of half of the pictures, asked about those of the other half; 0.5 means that the
    sets cannot be told apart (Lopez-Paz & Oquab 2017, classifier two-sample test).

    Args:
      real, made: [P, N, N, 3], P ≥ 4.
      centres: [P, 2], row and column near which patches are cut, the same in both sets.
      judge: the classifier.
    """
    if len(real) < 4:
        raise ValueError(f"real holds {len(real)} pictures: must be ≥ 4 for two folds; give more")
    order = np.random.default_rng(0).permutation(len(real))
    halves = order[: len(order) // 2], order[len(order) // 2 :]
    seen = _statistics(_cut(np.stack([real, made]), centres, judge))
    right = np.zeros(len(real))
    for train, test in (halves, halves[::-1]):
        right[test] = _train_and_ask(seen[:, train], seen[:, test], judge.ridge)
    return float(right.mean()), float(right.std(ddof=1) / np.sqrt(len(real)))


def _train_and_ask(train: np.ndarray, test: np.ndarray, ridge: float) -> np.ndarray:
    """Share of right answers per test picture, [P]; statistics [2, P, K, D], set 0 is real."""
    rows = train.reshape(-1, train.shape[-1])
    centre, scale = rows.mean(0), rows.std(0) + 1e-9
    rows = (rows - centre) / scale
    sign = np.repeat([-1.0, 1.0], len(rows) // 2)

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        margin = sign * (rows @ weights[1:] + weights[0])
        pull = -sign / (1 + np.exp(np.minimum(margin, 700))) / len(rows)
        gradient = np.append(pull.sum(), rows.T @ pull + 2 * ridge * weights[1:])
        return float(np.logaddexp(0, -margin).mean() + ridge * weights[1:] @ weights[1:]), gradient

    weights = optimize.minimize(loss, np.zeros(rows.shape[1] + 1), jac=True, method="L-BFGS-B").x
    says_made = ((test - centre) / scale) @ weights[1:] + weights[0] > 0
    right: np.ndarray = 0.5 * ((~says_made[0]).mean(-1) + says_made[1].mean(-1))
    return right


def _statistics(patches: np.ndarray) -> np.ndarray:
    """Statistics of patches [..., n, n, 3] in grey levels that the classifier uses, [..., D]."""
    flat = patches.reshape(-1, *patches.shape[-3:])
    n = flat.shape[1]
    mean = flat.mean((1, 2))
    window = np.hanning(n)[:, None, None] * np.hanning(n)[:, None]
    waves = np.fft.rfft2((flat - mean[:, None, None]) * window, axes=(1, 2))
    power = np.log(np.abs(waves) ** 2 + 1)
    ring = np.round(np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None]) * n)
    bands = [power[:, (ring >= low) & (ring <= high)].mean(1) for low, high in BANDS]
    steps = [np.log(np.diff(flat, axis=axis).std((1, 2)) + 0.1) for axis in (1, 2)]
    fine = flat - ndimage.uniform_filter(flat, (0, 3, 3, 0))
    pairs = [(fine[..., c] * fine[..., c - 1]).mean((1, 2))[:, None] for c in range(3)]
    peaks = [np.log(np.abs(fine).max((1, 2)) + 1), (fine**4).mean((1, 2)) ** 0.25]
    found = np.concatenate([mean, np.log(flat.std((1, 2)) + 1), *bands, *steps, *pairs, *peaks], -1)
    return found.reshape(*patches.shape[:-3], -1)


def _cut(sets: np.ndarray, centres: np.ndarray, judge: PatchClassifier) -> np.ndarray:
    """Patches [2, P, K, n, n, 3] within a half patch of the centres, at the same places of both sets."""
    rng, side, size = np.random.default_rng(1), PATCH_PX, sets.shape[2]
    found = []
    for picture, centre in zip(np.moveaxis(sets, 1, 0), centres, strict=True):
        corner = centre - side / 2 + rng.uniform(-side / 2, side / 2, (judge.patches, 2))
        corners = np.clip(np.round(corner), 0, size - side).astype(int)
        found.append([picture[:, r : r + side, c : c + side] for r, c in corners])
    return np.moveaxis(np.array(found, np.float64), 2, 0)


def _wasserstein(a: np.ndarray, b: np.ndarray) -> float:
    """Mean over the last axis of the Wasserstein-1 distances of two equally large samples."""
    a, b = (np.sort(x.reshape(-1, x.shape[-1]), 0) for x in (a, b))
    return float(np.abs(a - b).mean())


def _gradient(pictures: np.ndarray) -> np.ndarray:
    d_y, d_x = np.gradient(pictures, axis=(1, 2))
    return np.hypot(d_y, d_x)


def _ring_power(pictures: np.ndarray) -> np.ndarray:
    """Mean power per ring of wave numbers of the windowed pictures, [rings, 3]; a ring is one wave per picture wide."""
    n = pictures.shape[1]
    window = np.hanning(n)[:, None, None] * np.hanning(n)[:, None]
    waves = np.fft.rfft2((pictures - pictures.mean((1, 2), keepdims=True)) * window, axes=(1, 2))
    power = (np.abs(waves) ** 2).mean(0)
    ring = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)[None]) * n
    rings = range(1, n // 2)
    return np.array([power[np.round(ring) == k].mean(0) for k in rings]) + 1e-9
