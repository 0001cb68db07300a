"""The four sensors as data: gel, window, what they measure and how noisily.

Window, marker pitch and the Mini's pad follow the vendors' public sheets where these exist; gel moduli (0.2–0.44 MPa),
ν = 0.48, the other thicknesses (3–5 mm) and every noise level are assumptions, not measured on real units.
"""

import dataclasses
from collections.abc import Callable

from sensors_io.scenes import optics
from sensors_io.scenes.layer import Layer
from sensors_io.schema import SENSORS

Renderer = Callable[[optics.DeformedGel, optics.Light], optics.Array]

BODY = Layer(modulus_mpa=1.0, poisson=0.4, thickness_mm=20.0)
"""The object in series, per MPa of its effective modulus."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SensorModel:
    """One sensor type.

    `render` is `None` for a sensor that exposes no camera.  `marker_depth_mm` is the depth of the marker plane below
    the surface, `None` without markers: lateral displacement is then not observable.  Noise is per field node.
    """

    name: str
    gel: Layer
    window_mm: float
    render: Renderer | None
    marker_depth_mm: float | None
    lateral_noise_mm: float
    depth_noise_mm: float
    frame_period_ms: float
    read_noise: float = 0.004
    shot_noise: float = 0.008

    def __post_init__(self) -> None:
        if self.window_mm <= 0:
            raise ValueError(f"{self.name}: window_mm is {self.window_mm}: must be > 0; give the side of the window")


GELSIGHT_MINI = SensorModel(
    name="gelsight_mini",
    gel=Layer(modulus_mpa=0.37, poisson=0.48, thickness_mm=4.5),
    window_mm=15.2,
    render=optics.photometric,
    marker_depth_mm=None,
    lateral_noise_mm=0.0,
    depth_noise_mm=0.012,
    frame_period_ms=40.0,
)
XENSE = SensorModel(
    name="xense",
    gel=Layer(modulus_mpa=0.25, poisson=0.48, thickness_mm=4.0),
    window_mm=18.0,
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
    window_mm=16.0,
    render=optics.speckle,
    marker_depth_mm=0.3,
    lateral_noise_mm=0.012,
    depth_noise_mm=0.025,
    frame_period_ms=1000 / 120,
)

MODELS = (GELSIGHT_MINI, XENSE, TAC3D, DMTAC_X)
if tuple(m.name for m in MODELS) != SENSORS:
    raise ImportError(
        f"sensor models {[m.name for m in MODELS]} must follow schema.SENSORS {list(SENSORS)}; reorder them"
    )
