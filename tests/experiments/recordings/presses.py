"""Synthetic presses: a gel of even grey, a bump that appears, stays and goes."""

import numpy as np


def press(count=12, depth=40.0, size=(120, 160), texture=0.0, seed=0):
    """uint8 [count, H, W, 3]: rest, a bump in the middle of the video as bright as `depth`, rest."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: size[0], : size[1]]
    bump = np.exp(-(((x - size[1] / 2) / 25) ** 2 + ((y - size[0] / 2) / 25) ** 2))
    bump = bump + texture * bump * rng.standard_normal(size)
    load = np.clip(np.sin(np.linspace(-0.8, np.pi + 0.8, count)), 0, 1)
    frames = 100 + depth * load[:, None, None, None] * bump[..., None] * np.array([1.0, 0.3, -0.5])
    return np.clip(np.rint(frames), 0, 255).astype(np.uint8)
