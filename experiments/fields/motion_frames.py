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

REAL = {
    "GelSight Mini": ("FOTS", "marker_calib/data/3.png"),
    "GelSlim": ("gelslim", "test_data/ref.jpg"),
    "GelSlim 2": ("gelsight_heightmap", "test_data/ref.jpg"),
    "GelSight bench": ("gelsight_driver", "track_markers/video.avi"),
    "GelSight gripper": ("letac_mpc", "gel/*dp_1_*/*000001.jpg"),
}
"""Gel → folder of the data directory, and the picture in it; of a video the first frame."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rest:
    """A gel at rest: its name, RGB uint8 [H, W, 3], whether a camera took it."""

    name: str
    picture: np.ndarray
    real: bool


def gels(data_dir: pathlib.Path | None) -> list[Rest]:
    """The generated gels, and the real ones that lie in the data directory.

    Raises:
      FileNotFoundError: a data directory that holds none of the pictures.
    """
    generated = [
        Rest(name="Xense, generated", picture=_generated(XENSE, 240, 1), real=False),
        Rest(name="DM-Tac, generated", picture=_generated(DMTAC_X, 240, 3), real=False),
    ]
    if data_dir is None:
        return generated
    found = [(name, sorted((data_dir / folder).glob(pattern))) for name, (folder, pattern) in REAL.items()]
    real = [Rest(name=name, picture=load(paths[0]), real=True) for name, paths in found if paths]
    if not real:
        wanted = ", ".join(f"{folder}/{pattern}" for folder, pattern in REAL.values())
        raise FileNotFoundError(f"data_dir is {data_dir}: must hold one of {wanted}; correct the path")
    return [*real, *generated]


def load(path: pathlib.Path) -> np.ndarray:
    """A picture, or the first frame of a video, RGB uint8, at most 480 pixels wide by averaging.

    Raises:
      ValueError: a file that OpenCV cannot read.
    """
    picture = cv2.imread(str(path))
    if picture is None:
        reader = cv2.VideoCapture(str(path))
        try:
            read, picture = reader.read()
        finally:
            reader.release()
        if not read:
            raise ValueError(f"{path} is no picture and no video that OpenCV reads; replace the file")
    factor = -(-picture.shape[1] // _WIDEST_PX)
    if factor > 1:
        size = (picture.shape[1] // factor, picture.shape[0] // factor)
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


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
