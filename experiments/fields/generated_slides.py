"""Presses, slides and twists on generated gels, with the true fields and the measured ones."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from experiments.mechanics import tangential_scenes as scenes
from experiments.mechanics.tangential_methods import dragged
from sensors_io.fields.inversion import NodeGrid
from sensors_io.scenes import drag
from sensors_io.scenes.sensors import SensorModel
from sensors_io.scenes.traction import shear_displacement

NODES = 20  # rows and columns of the measured fields, as in the records of generated scenes
_PER_NODE = 4  # contact pixels along a node's side
_LOST_NODES = 0.004  # share of nodes that a frame cannot read, as in generated scenes
_LEAST_FORCE_N = 0.5  # frames that press less have hardly any shear


@dataclasses.dataclass(frozen=True, kw_only=True)
class Slide:
    """One sequence of F frames on the node grid [F, h, w, …].

    Deformation, depth and validity are measured in the marker plane, with the sensor's noise and lost nodes; the shear,
    which is the displacement that traction causes, the traction (x, y, z), force and moment [F, 3] are true.
    """

    motion: str
    deformation_mm: np.ndarray
    depth_mm: np.ndarray
    valid: np.ndarray
    shear_mm: np.ndarray
    traction_mpa: np.ndarray
    force_n: np.ndarray
    moment_nmm: np.ndarray

    @property
    def moving(self) -> np.ndarray:
        """Bool [F], frames with any shear."""
        return np.linalg.norm(self.shear_mm, axis=-1).max((1, 2)) > 0


def pressing(slide: Slide) -> np.ndarray:
    """Indices of the frames in which the object presses."""
    return np.flatnonzero(-slide.force_n[:, 2] > _LEAST_FORCE_N)


def node_grid(sensor: SensorModel) -> NodeGrid:
    """The nodes of a sensor's fields; displacement and depth are both those of its marker plane."""
    pitch, depth = sensor.window_mm / NODES, sensor.marker_depth_mm
    if depth is None:
        raise ValueError(f"{sensor.name} has no markers: its lateral field does not exist; choose another sensor")
    return NodeGrid(shape=(NODES, NODES), pitch_mm=(pitch, pitch), marker_depth_mm=depth, depth_mm=depth)


def make_slides(
    sensor: SensorModel, kinds: tuple[str, ...], motions: tuple[str, ...], frames: int, seed: int
) -> list[Slide]:
    """Every motion of the protocol by one object of every kind (`tangential_scenes.KINDS`), on a gel with markers."""
    kernels = scenes.friction_kernels(sensor, NODES * _PER_NODE)
    noise_mm = np.array([sensor.lateral_noise_mm, sensor.lateral_noise_mm, sensor.depth_noise_mm])
    made = []
    for i, (kind, motion) in enumerate(itertools.product(kinds, motions)):
        rng = np.random.default_rng([seed, i])
        true = jax.device_get(_solve(kernels, scenes.make_motion(kernels, scenes.draw(rng, kind), motion, frames)))
        nodes = {key: _node_means(true[key]) for key in ("displacement", "shear", "load")}
        seen = nodes["displacement"] + noise_mm * rng.standard_normal(nodes["displacement"].shape)
        slide = Slide(
            motion=motion,
            deformation_mm=seen[..., :2],
            depth_mm=seen[..., 2],
            valid=rng.uniform(size=seen.shape[:-1]) >= _LOST_NODES,
            shear_mm=nodes["shear"],
            traction_mpa=nodes["load"],
            force_n=true["force"],
            moment_nmm=true["moment"],
        )
        made.append(slide)
    return made


cached_slides = functools.lru_cache(maxsize=8)(make_slides)
"""`make_slides`, computed once for the same arguments within a run."""


@jax.jit
def _solve(kernels: scenes.FrictionKernels, motion: scenes.FrictionSequence) -> dict[str, jax.Array]:
    """Displacement [F, 3, N, N], its part by traction, load and resultants of every frame."""

    def keep(frame: drag.Frame) -> dict[str, jax.Array]:
        traction, sheared = frame.traction_mpa, shear_displacement(frame.traction_mpa, kernels.markers.shear)
        return {
            "displacement": frame.displacement_mm,
            "shear": jnp.stack([sheared.real, sheared.imag]),
            "traction": jnp.stack([traction.real, traction.imag]),
            "force": frame.force_n,
            "moment": frame.moment_nmm,
        }

    found = dragged(motion, kernels, keep)
    return found | {"load": jnp.concatenate([found["traction"], -motion.pressure_mpa[:, None]], 1)}


def _node_means(fields: np.ndarray) -> np.ndarray:
    """Means over the pixels of every node: [F, C, N, N] → [F, h, w, C]."""
    frames, channels, side, _ = fields.shape
    cells = side // _PER_NODE
    blocks = fields.reshape(frames, channels, cells, _PER_NODE, cells, _PER_NODE)
    return np.moveaxis(blocks.mean((3, 5), dtype=np.float64), 1, -1)
