"""Synthetic presses: a gel of even grey, a bump that appears, stays and goes."""

import json

import cv2
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


def film(path, frames):
    """Write frames as a Motion-JPEG video."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, frames.shape[2:0:-1])
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    writer.release()


def source(path, objects=6, videos=2):
    """A folder in PhysiCLeAR's layout whose rougher objects have more texture, and one object without labels."""
    (path / "videos").mkdir(parents=True)
    entries = []
    for i in range(objects + 1):
        known, level = i < objects, i % 3
        names = [f"thing{i}_{k}.avi" for k in range(videos)]
        for k, name in enumerate(names):
            film(path / "videos" / name, press(depth=25.0 + 15 * level, texture=0.3 * level, seed=10 * i + k))
        labels = dict.fromkeys(("hardness", "roughness", "bumps"), level if known else None)
        split = "train" if known else "unlabelled"
        material = "plastic" if known else None
        entries.append(
            {"object": f"thing{i}", "name": None, "split": split, "material": material, "videos": names} | labels
        )
    (path / "labels.json").write_text(json.dumps({"levels": {}, "objects": entries}))
    return path
