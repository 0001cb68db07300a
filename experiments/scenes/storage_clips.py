"""What is stored: clips of generated scenes, and of recordings where they are present."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from experiments.core.context import Context
from sensors_io.importers.keep import Keep
from sensors_io.importers.pictures import numbered, read_picture
from sensors_io.importers.video import read_video
from sensors_io.live import LiveScenes
from sensors_io.scenes.config import SceneConfig

GENERATED, IMPORTED, WHOLE, STILLS = "generated", "videos as imported", "videos, whole frames", "camera stills"
"""Kinds of clips, and what is found where: `<data_dir>/physiclear/videos`, `<data_dir>/gelslam/6.310mm`."""


def generated_clips(config: SceneConfig, contacts: Iterable[int]) -> list[np.ndarray]:
    """Camera frames of each sensor of some contacts, uint8 [N, H, W, 3]."""
    scenes = LiveScenes(config)
    sequences = [sequence for i in contacts for sequence in scenes.contact(i).values()]
    return [sequence.frames for sequence in sequences if sequence.frames is not None]


def recorded_clips(data_dir: Path, videos: int, frames: int, context: Context) -> dict[str, list[np.ndarray]]:
    """Clips of recordings by kind; a kind that is not there is left out.

    Videos are evenly spread over the folder.  They were compressed with loss before; the stills were not.

    Args:
      data_dir: folder of recordings.
      videos: how many are read.
      frames: at most so many of each video in whole frames.
      context: shows how far it is.
    """
    found: dict[str, list[np.ndarray]] = {}
    files = sorted((data_dir / "physiclear" / "videos").glob("*.mov"))
    if files:
        chosen = [files[i] for i in np.linspace(0, len(files) - 1, videos).astype(int)]
        found |= {IMPORTED: [], WHOLE: []}
        for file in context.each("reading videos", chosen):
            found[IMPORTED].append(read_video(file, Keep()).frames)
            found[WHOLE].append(read_video(file, Keep(height=0, max_frames=0)).frames[:frames])
    folders = (data_dir / "gelslam" / "6.310mm").glob("*")
    stills = [picture for folder in sorted(folders) for picture in numbered(folder)]
    if stills:
        found[STILLS] = [read_picture(picture)[None] for picture in context.each("reading stills", stills)]
    return found
