"""Changes of a recording that physics allows, drawn at random for training.

Mirroring and quarter turns form the group of the square.  An element acts on a picture by moving its pixels, on a
vector (deformation, shear, force) by the matrix R, and on the moment, an axial vector, by det(R) R:

    mirror      R = [[−1, 0, 0], [0, 1, 0], [0, 0, 1]]      x → −x, the columns reversed
    turn        R = [[0, −1, 0], [1, 0, 0], [0, 0, 1]]      a quarter turn clockwise in the picture: x → y, y → −x

Depth and normal force are not changed, nor is the view of the object, whose camera stands elsewhere.  All sensors of a
contact are changed by one element, so that their tangential forces still agree.  What a mirrored picture shows is a
sensor whose lamps are mirrored too: its calibration no longer holds and is dropped.

Exposure and white balance act on camera counts alone; fields, which are measured in mm, stay.
"""

import dataclasses
from typing import Any

import cv2
import numpy as np

from sensors_io.schema import SchemaError, Sequence


@dataclasses.dataclass(frozen=True, kw_only=True)
class AugmentConfig:
    """Random changes of recordings; by default none.

    Args:
      mirror: probability of a mirror image.
      turn: probability of a turn by 90, 180 or 270 degrees, each equally likely.
      exposure_stops: exposure of each stream changes by a factor 2^u, u uniform in ± this, in all frames alike.
      white_balance_stops: the same for each colour of each stream.
      frame_dropout: probability with which each frame of a clip is masked but the first one of each stream, against
        which the change of all others is measured.
    """

    mirror: float = 0.0
    turn: float = 0.0
    exposure_stops: float = 0.0
    white_balance_stops: float = 0.0
    frame_dropout: float = 0.0

    def __post_init__(self) -> None:
        for name in ("mirror", "turn", "frame_dropout"):
            if not 0 <= getattr(self, name) <= 1:
                raise SchemaError(f"{name} is {getattr(self, name)}: must lie in 0..1; it is a probability")
        for name in ("exposure_stops", "white_balance_stops"):
            if not 0 <= getattr(self, name) <= 4:  # a factor of 16 leaves nothing of 8 bits
                raise SchemaError(f"{name} is {getattr(self, name)}: must lie in 0..4 stops; lower it")

    @property
    def active(self) -> bool:
        """True if anything can change."""
        return self != AugmentConfig()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Symmetry:
    """One element of the group of the square: first mirrored or not, then so many quarter turns clockwise."""

    mirrored: bool = False
    quarters: int = 0

    @property
    def matrix(self) -> np.ndarray:
        """R, float32 [3, 3], acting on (x, y, z) with x right, y down."""
        mirror = np.diag([-1, 1, 1]) if self.mirrored else np.eye(3, dtype=int)
        turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
        return (np.linalg.matrix_power(turn, self.quarters % 4) @ mirror).astype(np.float32)

    def image(self, x: np.ndarray) -> np.ndarray:
        """Pictures or scalar fields [N, H, W, …] with their pixels moved; a view."""
        if self.mirrored:
            x = x[:, :, ::-1]
        return np.rot90(x, -self.quarters, axes=(1, 2))

    def vectors(self, x: np.ndarray) -> np.ndarray:
        """Vector fields [N, h, w, 2]: pixels moved, vectors changed."""
        return self.image(x) @ self.matrix[:2, :2].T


def draw_symmetry(config: AugmentConfig, rng: np.random.Generator) -> Symmetry:
    """A random element, by the probabilities of the config."""
    mirrored = bool(rng.random() < config.mirror)
    quarters = int(rng.integers(1, 4)) if rng.random() < config.turn else 0
    return Symmetry(mirrored=mirrored, quarters=quarters)


def apply_symmetry(sequence: Sequence, element: Symmetry) -> Sequence:
    """The sequence as it would have been recorded of the mirrored or turned contact.

    Args:
      sequence: N frames.
      element: applied to every array; the identity gives the sequence back.
    """
    if element == Symmetry():
        return sequence
    rotation, axial = element.matrix, np.linalg.det(element.matrix).round() * element.matrix
    arrays = {name: getattr(sequence, name) for name in _ACTIONS if getattr(sequence, name) is not None}
    changed: dict[str, Any] = {n: np.ascontiguousarray(_ACTIONS[n](element, x)) for n, x in arrays.items()}
    if sequence.force_n is not None:
        changed["force_n"] = sequence.force_n @ rotation.T
    if sequence.moment_nmm is not None:
        changed["moment_nmm"] = sequence.moment_nmm @ axial.T.astype(np.float32)
    return dataclasses.replace(sequence, calibration="", **changed)


_ACTIONS = {
    "frames": Symmetry.image,
    "depth_mm": Symmetry.image,
    "valid": Symmetry.image,
    "deformation_mm": Symmetry.vectors,
    "shear_mm": Symmetry.vectors,
}


def jitter_exposure(images: np.ndarray, config: AugmentConfig, rng: np.random.Generator) -> np.ndarray:
    """Camera pictures under another exposure and white balance, counts = min(255, round(gain · counts)).

    The gain is drawn once: a camera's settings are locked during a recording.

    Args:
      images: uint8 [F, H, W, 3], of one stream.
      config: gives the ranges.
      rng: four numbers are drawn from it in any case.
    """
    common, colours = rng.uniform(-1, 1), rng.uniform(-1, 1, 3)
    gain = 2.0 ** (config.exposure_stops * common + config.white_balance_stops * colours)
    if not (config.exposure_stops or config.white_balance_stops):
        return images
    table = np.minimum(np.rint(np.arange(256)[:, None] * gain), 255).astype(np.uint8)
    rows = images.reshape(-1, images.shape[2], 3)  # OpenCV looks up one picture, however tall
    return cv2.LUT(rows, table[None]).reshape(images.shape)


def draw_kept(present: np.ndarray, config: AugmentConfig, rng: np.random.Generator) -> np.ndarray:
    """Draw the frames of each stream that stay, bool [S, F]: the first one that is present, and a part of the others.

    Args:
      present: bool [S, F].
      config: gives the probability.
      rng: source of randomness.
    """
    first = np.arange(present.shape[1]) == present.argmax(1, keepdims=True)
    return present & ((rng.random(present.shape) >= config.frame_dropout) | first)
