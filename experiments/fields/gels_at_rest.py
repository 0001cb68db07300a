"""Pictures of marker gels at rest, real and generated, to move by known motion."""

import dataclasses
import pathlib

import cv2
import jax.numpy as jnp
import numpy as np

from sensors_io.scenes import optics
from sensors_io.scenes.sensors import DMTAC_X, XENSE, SensorModel
from sensors_io.scenes.units import unit_of

_WIDEST_PX = 480  # wider pictures are reduced: their pixels are finer than their optics


@dataclasses.dataclass(frozen=True, kw_only=True)
class RestSource:
    """A picture of a gel: its folder in the data directory, its pattern there, and the frame of a video."""

    folder: str
    pattern: str
    frame: int = 0


REAL = {
    "GelSight Mini": RestSource(folder="FOTS", pattern="marker_calib/data/1.png"),
    "GelSlim": RestSource(folder="gelslim", pattern="test_data/sample_13.jpg"),
    "GelSlim 2": RestSource(folder="gelsight_heightmap", pattern="test_data/sample_34.jpg"),
    "GelSight bench": RestSource(folder="gelsight_driver", pattern="track_markers/video.avi", frame=24),
    "GelSight gripper": RestSource(folder="letac_mpc", pattern="hard_rubber/*dp_1_*/*000001.jpg"),
}
"""Gel → picture that stands for it at rest.

The tracker's settings, the windows and the number of rest pictures were chosen on others: `marker_calib/data/3.png`,
the two `ref.jpg`, frame 0 of the video and the first picture of `letac_mpc/gel`.
"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GelAtRest:
    """A gel at rest: its name, RGB uint8 [H, W, 3], whether a camera took it."""

    name: str
    picture: np.ndarray
    real: bool


def gels(data_dir: pathlib.Path | None) -> list[GelAtRest]:
    """The generated gels, and the real ones that lie in the data directory.

    Raises:
      FileNotFoundError: a data directory that holds none of the pictures.
    """
    generated = [
        GelAtRest(name="Xense, generated", picture=_generated(XENSE, 240, 1), real=False),
        GelAtRest(name="DM-Tac, generated", picture=_generated(DMTAC_X, 240, 3), real=False),
    ]
    if data_dir is None:
        return generated
    found = [(name, gel.frame, sorted((data_dir / gel.folder).glob(gel.pattern))) for name, gel in REAL.items()]
    real = [GelAtRest(name=name, picture=load(paths[0], frame), real=True) for name, frame, paths in found if paths]
    if not real:
        wanted = ", ".join(f"{gel.folder}/{gel.pattern}" for gel in REAL.values())
        raise FileNotFoundError(f"data_dir is {data_dir}: must hold one of {wanted}; correct the path")
    return [*real, *generated]


def load(path: pathlib.Path, frame: int = 0) -> np.ndarray:
    """A picture, or one frame of a video, RGB uint8, at most 480 pixels wide by averaging.

    Raises:
      ValueError: a file that OpenCV cannot read.
    """
    picture = cv2.imread(str(path))
    if picture is None:
        reader = cv2.VideoCapture(str(path))
        try:
            for _ in range(frame + 1):
                read, picture = reader.read()
        finally:
            reader.release()
        if not read or picture is None:
            raise ValueError(f"{path} is no picture and no video of {frame + 1} frames that OpenCV reads; replace it")
    return cv2.cvtColor(reduced(picture), cv2.COLOR_BGR2RGB)


def reduced(picture: np.ndarray) -> np.ndarray:
    """A picture [H, W, 3] at most 480 pixels wide, by averaging over whole pixels."""
    factor = -(-picture.shape[1] // _WIDEST_PX)
    if factor == 1:
        return picture
    size = (picture.shape[1] // factor, picture.shape[0] // factor)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def _generated(sensor: SensorModel, side_px: int, order: int) -> np.ndarray:
    """The gel of a generated sensor at rest, without noise."""
    if sensor.render is None:
        raise ValueError(f"{sensor.name} exposes no camera: it has no picture; choose another sensor")
    still = jnp.zeros((side_px, side_px))
    gel = optics.DeformedGel(
        depth_mm=still, marker_x_mm=still, marker_y_mm=still, marker_depth_mm=still, window_mm=sensor.window_mm
    )
    picture = np.asarray(sensor.render(gel, unit_of(0, order, 0).light))
    return np.round(255 * np.clip(picture, 0, 1)).astype(np.uint8)
