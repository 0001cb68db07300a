"""How similar are generated pictures of a GelSight Mini to real ones?

    python -m experiments scene_realism --data-dir DIR

DIR holds the ball presses of the gelslam repository (MIT): `background.png` and `6.310mm/<i>/gelsight.png`, 320 × 240
pixels of 0.0634 mm.  The optics of `sensors_io.scenes.photometric` are fitted to every other press.  The remaining ones
are rendered at their own touch, three numbers found from each picture, and compared with it by statistics and by a
classifier that was trained on other presses.  The run writes the fitted constants as `mini_optics.py`, in the form in
which the generator keeps them.

Cost: a minute on two cores.

Expected: pictures by lamps set by eye are always distinguished from real ones and deviate by 13 grey levels; those by
fitted optics deviate by 2, most of it noise.  Shadows explain little of the rest.  The classifier still finds the fine
texture of a pressed real gel, which a contact grid does not resolve.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy import ndimage, optimize

from experiments.core.artifacts import write_text
from experiments.core.context import Context
from experiments.core.pictures import image_grid
from experiments.core.results import Cell, Picture, Results, Table, at_most, named_table
from experiments.core.runner import Experiment
from experiments.scenes import realism_fit
from sensors_io.scenes import fitting, photometric

PATCH_PX = 32
BANDS = ((1, 1), (2, 2), (3, 4), (5, 7), (8, 10), (11, 13), (14, 16))  # waves per patch, first and last of each band

RIDGE = 1e-3  # penalty on the squared weights of the standardised statistics of patches


@dataclasses.dataclass(frozen=True, kw_only=True)
class RealismConfig:
    """Recordings, pictures and classifier of the comparison."""

    data_dir: Path | None = None  # the recordings
    image_px: int = 112  # side of the compared pictures, to which the square middle of each recording is shrunk
    patches: int = 32  # of each picture, for the classifier


def run(config: RealismConfig, context: Context) -> Results:
    """Fit, render the held-out presses, compare."""
    study = realism_fit.fit(realism_fit.read(config.data_dir, config.image_px), context)
    write_text(context.directory / "mini_optics.py", realism_fit.source(study.fitted, study.noise, study.presses))
    real = np.round(255 * study.presses.pictures[study.held_out]).astype(np.uint8)
    pixels = np.arange(len(study.presses.axis_mm))
    centres = [np.interp(study.touches[study.held_out, i], study.presses.axis_mm, pixels) for i in (1, 0)]
    rendered, rows = {}, {}
    for name, candidate in context.each("candidates", realism_fit.candidates(study).items()):
        rendered[name] = realism_fit.render(study, candidate)
        mean, error = accuracy(real, rendered[name], np.stack(centres, -1), config.patches)
        rows[name] = {**distances(real, rendered[name]), "right": 100 * mean, "±": 100 * error}
    shadows = realism_fit.shadow_gain(study, context)
    clean, stored = (realism_fit.clean(study, optics) for optics in (study.fitted, photometric.MINI))
    drift = float(np.sqrt(np.mean((clean - stored) ** 2)))
    before, after = rows["lamps by eye"], rows["fitted, with grain"]
    return Results(
        verdict=(
            f"Fitted optics bring pictures from {before['difference']:.1f} to {after['difference']:.1f} grey levels of "
            f"real ones; a classifier assigns {after['right']:.0f} ± {after['±']:.0f} % of the patches to the right "
            "set, 50 % would be chance.",
            f"Cast shadows would explain {100 * shadows['explained']:.1f} % of the residual of the fit.",
        ),
        requirements=(
            at_most(
                "stored constants against this fit, rms over held-out presses",
                255 * drift,
                0.5,
                "levels",
                "if not met, copy mini_optics.py of this run over the generator's and raise its version",
            ),
        ),
        tables=(_distance_table(rows), _fit_table(study)),
        pictures=(_side_by_side(real, rendered),),
        settings={"picture": f"{config.image_px} px", "held-out presses": len(study.held_out)},
        data={"presses": len(study.touches), "ball_diameter_mm": realism_fit.DIAMETER_MM, "shadows": shadows},
    )


def _distance_table(rows: Mapping[str, Mapping[str, float]]) -> Table:
    return named_table(
        "Distance of generated from real held-out presses",
        [{"pictures": name, **row} for name, row in rows.items()],
        formats={"right": ".1f", "±": ".1f"},
        units={
            **{"difference": "levels", "intensity": "levels", "gradient": "levels/px"},
            **{"spectrum": "dB", "right": "%", "±": "%"},
        },
        meanings={
            "difference": "rms difference of pictures of the same touch",
            "intensity": "Wasserstein-1 distance of the intensities",
            "gradient": "the same for the magnitude of the gradient",
            "spectrum": "rms of the ratio of the powers over rings of wave numbers",
            "right": "patches assigned to the right set; 50 is chance",
            "±": "its standard error over presses",
        },
    )


def _fit_table(study: realism_fit.PressFit) -> Table:
    """Share of the change near the contact that the fit explains, and the residual."""
    presses = study.presses
    change = lambda i: (presses.pictures[i] - presses.background)[fitting.near(presses.axis_mm, study.touches[i])]
    rows: list[dict[str, Cell]] = []
    for name, held_out in (("fitted", False), ("held out", True)):
        chosen = [i for i in range(len(study.touches)) if (i in study.held_out) == held_out]
        a = np.concatenate([realism_fit.residual(study, i) for i in chosen])
        b = np.concatenate([change(i) for i in chosen])
        explained, levels = 100 * (1 - a.var(0) / b.var(0)), 255 * a.std(0)
        row = {f"{c} explained": float(v) for c, v in zip("RGB", explained, strict=True)}
        rows.append({"presses": name, **row, **{f"{c} left": float(v) for c, v in zip("RGB", levels, strict=True)}})
    return named_table(
        "The fit",
        rows,
        units={**{f"{c} explained": "%" for c in "RGB"}, **{f"{c} left": "levels" for c in "RGB"}},
        note=f"Variance of the change within {fitting.NEAR_MM} mm of the ball's axis.",
    )


def _side_by_side(real: np.ndarray, rendered: Mapping[str, np.ndarray]) -> Picture:
    some = np.linspace(0, len(real) - 1, min(6, len(real))).astype(int)
    names = ("lamps by eye", "fitted, with grain")
    rows = {"real": real[some]} | {name: rendered[name][some] for name in names}
    return Picture(
        name="presses",
        title="Held-out presses",
        caption="One column per press: the recording, the same touch by lamps set by eye, and by the fitted optics.",
        content=image_grid(rows),
        kind="png",
    )


# Distances of two sets of pictures -----------------------------------------------------------------------------------


def distances(real: np.ndarray, made: np.ndarray) -> dict[str, float]:
    """Distances of `made` from `real`, both [P, N, N, 3] of the same scenes, in grey levels but for the spectrum.

    Root mean square difference; Wasserstein-1 distances of intensities and of gradients (levels per pixel), means over
    the channels; root mean square over rings of wave numbers of 10 log₁₀ of the ratio of the powers, mean over them.
    """
    a, b = (pictures.astype(np.float64) for pictures in (real, made))
    spectra = 10 * np.log10(_ring_power(a) / _ring_power(b))
    return {
        "difference": float(np.sqrt(np.mean((a - b) ** 2))),
        "intensity": _wasserstein(a, b),
        "gradient": _wasserstein(_gradient(a), _gradient(b)),
        "spectrum": float(np.sqrt(np.mean(spectra**2, 0)).mean()),
    }


def accuracy(real: np.ndarray, made: np.ndarray, centres: np.ndarray, patches: int) -> tuple[float, float]:
    """Share of held-out patches that a classifier assigns to the right set, and its standard error over pictures.

    A logistic regression on statistics of patches: levels, contrast, spectrum, steps, channels' correlation, peaks.
    Stronger here than a small convolutional network, which cannot learn fine texture from a few dozen pictures.

    Two folds: trained on the patches of half of the pictures, tested on those of the other half; 0.5 means that the
    sets cannot be distinguished (Lopez-Paz & Oquab 2017, classifier two-sample test).  Patches are cut near the same
    centres (row, column) [P, 2] of both sets [P, N, N, 3], P ≥ 4.
    """
    if len(real) < 4:
        raise ValueError(f"real holds {len(real)} pictures: must be ≥ 4 for two folds; give more")
    order = np.random.default_rng(0).permutation(len(real))
    halves = order[: len(order) // 2], order[len(order) // 2 :]
    seen = _statistics(_cut(np.stack([real, made]), centres, patches))
    right = np.zeros(len(real))
    for train, test in (halves, halves[::-1]):
        right[test] = _train_and_test(seen[:, train], seen[:, test])
    return float(right.mean()), float(right.std(ddof=1) / np.sqrt(len(real)))


def _train_and_test(train: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Share of right answers per test picture, [P]; statistics [2, P, K, D], set 0 is real."""
    rows = train.reshape(-1, train.shape[-1])
    centre, scale = rows.mean(0), rows.std(0) + 1e-9
    rows = (rows - centre) / scale
    sign = np.repeat([-1.0, 1.0], len(rows) // 2)

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        margin = sign * (rows @ weights[1:] + weights[0])
        pull = -sign / (1 + np.exp(np.minimum(margin, 700))) / len(rows)
        gradient = np.append(pull.sum(), rows.T @ pull + 2 * RIDGE * weights[1:])
        return float(np.logaddexp(0, -margin).mean() + RIDGE * weights[1:] @ weights[1:]), gradient

    weights = optimize.minimize(loss, np.zeros(rows.shape[1] + 1), jac=True, method="L-BFGS-B").x
    called_made = ((test - centre) / scale) @ weights[1:] + weights[0] > 0
    right: np.ndarray = 0.5 * ((~called_made[0]).mean(-1) + called_made[1].mean(-1))
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


def _cut(sets: np.ndarray, centres: np.ndarray, patches: int) -> np.ndarray:
    """Patches [2, P, K, n, n, 3] within a half patch of the centres, at the same places of both sets."""
    rng, side, size = np.random.default_rng(1), PATCH_PX, sets.shape[2]
    found = []
    for picture, centre in zip(np.moveaxis(sets, 1, 0), centres, strict=True):
        corner = centre - side / 2 + rng.uniform(-side / 2, side / 2, (patches, 2))
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


SMOKE = RealismConfig(patches=8)

EXPERIMENT = Experiment(name="scene_realism", config=RealismConfig(), scales={"smoke": SMOKE}, run=run)
