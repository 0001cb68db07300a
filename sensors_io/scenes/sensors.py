"""The four sensors as data: gel, window, what they measure, how noisily.

Every window is the square that the generator images; what is published, and where the model departs from it:

    gelsight_mini  20.3 × 15.2 mm after the crop, 25 Hz, 4.5 mm pad: the central 15.2 mm.  Optics, noise and grain are
                   fitted to presses of a real unit (`fitting`); 15.2 mm / 112 px = 0.136 mm/px, 2.14 of its pixels
    xense          19.4 × 30.8 mm (one user's note), printed grid of 14 × 26 or 20 × 35, 30–60 Hz: the central 19.4 mm
                   with the 14 × 26 grid.  Its pitch is the area over the grid; the margins are not published
    tac3d          19–21 mm square, 20 × 20 markers at 1.00 mm (AD2), 32.7 ms between frames of the vendor's recordings:
                   20 mm, the markers at the nodes of the field.  It exposes no camera
    dmtac_x        no sheet of the X; of the W: 24 × 18, 20 × 15 or 16 × 12 mm, 120 Hz, field of 320 × 240: the central
                   18 mm of the largest

Gel moduli (0.2–0.44 MPa), ν = 0.48, thicknesses but the Mini's (3–5 mm), and all noise but the Mini's camera's are
assumptions, not measured on real units.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from sensors_io.layer import Layer
from sensors_io.scenes import mini_optics, optics, photometric
from sensors_io.schema import SENSORS

Renderer = Callable[[optics.DeformedGel, optics.Light], optics.Array]
Texture = Callable[[np.random.Generator], np.ndarray]

BODY = Layer(modulus_mpa=1.0, poisson=0.4, thickness_mm=20.0)
"""The object in series, per MPa of its effective modulus."""


def no_texture(rng: np.random.Generator) -> np.ndarray:
    """A gel that is the same everywhere; draws nothing."""
    return np.zeros((2, 2), np.float32)


def mini_grain(rng: np.random.Generator) -> np.ndarray:
    """Grain of one GelSight Mini."""
    return photometric.grain(rng, 112, mini_optics.GRAIN, mini_optics.GRAIN_SHARED)


def dense_pattern(rng: np.random.Generator) -> np.ndarray:
    """Printed pattern of one DM-Tac, over one and a half windows."""
    return optics.speckle_texture(rng, 288, 5.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorModel:
    """One sensor type.

    `render` is `None` for a sensor that exposes no camera; `draw_texture` draws what `Light.texture` holds for one
    unit.  `marker_depth_mm` is the depth of the marker plane below the surface, `None` without markers: lateral
    displacement is then not observable.  The noise in mm is per field node; that of the camera is per channel,
    read + shot √I of pictures in 0..1.
    """

    name: str
    gel: Layer
    window_mm: float
    render: Renderer | None
    marker_depth_mm: float | None
    lateral_noise_mm: float
    depth_noise_mm: float
    frame_period_ms: float
    draw_texture: Texture = no_texture
    read_noise: optics.Rgb = (0.004, 0.004, 0.004)
    shot_noise: optics.Rgb = (0.008, 0.008, 0.008)

    def __post_init__(self) -> None:
        if self.window_mm <= 0:
            raise ValueError(f"{self.name}: window_mm is {self.window_mm}: must be > 0; give the side of the window")


GELSIGHT_MINI = SensorModel(
    name="gelsight_mini",
    gel=Layer(modulus_mpa=0.37, poisson=0.48, thickness_mm=4.5),
    window_mm=15.2,
    render=photometric.gelsight_mini,
    marker_depth_mm=None,
    lateral_noise_mm=0.0,
    depth_noise_mm=0.012,
    frame_period_ms=40.0,
    draw_texture=mini_grain,
    read_noise=mini_optics.READ_NOISE,
    shot_noise=mini_optics.SHOT_NOISE,
)
XENSE = SensorModel(
    name="xense",
    gel=Layer(modulus_mpa=0.25, poisson=0.48, thickness_mm=4.0),
    window_mm=19.4,
    render=optics.dots,
    marker_depth_mm=0.5,
    lateral_noise_mm=0.012,
    depth_noise_mm=0.03,
    frame_period_ms=1000 / 60,
)
TAC3D = SensorModel(
    name="tac3d",
    gel=Layer(modulus_mpa=0.3, poisson=0.48, thickness_mm=3.5),
    window_mm=20.0,
    render=None,
    marker_depth_mm=0.3,
    lateral_noise_mm=0.008,
    depth_noise_mm=0.015,
    frame_period_ms=32.7,
)
DMTAC_X = SensorModel(
    name="dmtac_x",
    gel=Layer(modulus_mpa=0.4, poisson=0.48, thickness_mm=3.0),
    window_mm=18.0,
    render=optics.speckle,
    marker_depth_mm=0.3,
    lateral_noise_mm=0.012,
    depth_noise_mm=0.025,
    frame_period_ms=1000 / 120,
    draw_texture=dense_pattern,
)

MODELS = (GELSIGHT_MINI, XENSE, TAC3D, DMTAC_X)
if tuple(m.name for m in MODELS) != SENSORS:
    raise ImportError(
        f"sensor models {[m.name for m in MODELS]} must follow schema.SENSORS {list(SENSORS)}; reorder them"
    )
