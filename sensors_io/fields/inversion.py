"""Traction on a gel from the displacement of its markers, through the compliance C of the bonded layer.

With noise σ of the displacements u, the load t = (τ_x, τ_y, p) of all nodes is the minimum of

    ‖(u − Ct)/σ‖² + α tᵀ K⁻¹ t,     K_ij = (1 + √3 r/ℓ) e^{−√3 r/ℓ},  r = |r_i − r_j|,

whose penalty K says that loads of neighbouring nodes are alike over a length ℓ.  It is taken twice:

    linear   over all nodes, α by generalised cross-validation in every frame, since a light touch and a hard one do not
             want the same; one singular value decomposition, made once, leaves two matrix–vector products per frame
    contact  over the nodes that press, the same α: nodes whose pressure comes out negative leave until none does

Nothing acts where nothing touches, and that is what the linear solution lacks: it spreads the load over the window.

What pressure makes along the surface of any even layer is a gradient, so with `gradient_free` u and C lose their
gradients first (`helmholtz.shear_matrix`).  Depth then gives the pressure, the rest gives the traction: thickness and
Poisson ratio, wrong by a third or by .03, then cost little; where they are known well, the whole motion is better.

Sources: Golub, Heath & Wahba, Technometrics 21, 215, 1979 (cross-validation); Wahba 1990, ch. 1 (penalty as covariance,
Matérn's of order 3/2).  Departure from Tikhonov in wave numbers, which is the usual way: the window is finite here, and
its border is where that fails.
"""

import dataclasses

import numpy as np
from scipy import linalg

from sensors_io.fields.compliance import COMPONENTS, NodeGrid, compliance_matrix
from sensors_io.fields.helmholtz import shear_matrix
from sensors_io.layer import Layer

_WEIGHTS = np.geomspace(1e-7, 1e3, 50)  # α over the largest squared singular value: from none to all of the signal
_PRESSING = 0.05  # of the greatest pressure of the linear solution, from which a node may press
_ROUNDS = 6  # in which nodes leave the contact
_JITTER = 1e-6  # added to the penalty's diagonal, which rounding would make indefinite


@dataclasses.dataclass(frozen=True, kw_only=True)
class InverseConfig:
    """Prior assumptions of the inversion.

    Args:
      lateral_noise_mm, depth_noise_mm: of the displacements; only their ratio counts, α takes their size.
      smooth_mm: ℓ; 0 for loads that know nothing of each other.
      gradient_free: whether the lateral displacement is read without its gradient part.
    """

    lateral_noise_mm: float = 0.01
    depth_noise_mm: float = 0.02
    smooth_mm: float = 2.0
    gradient_free: bool = True

    def __post_init__(self) -> None:
        for name in ("lateral_noise_mm", "depth_noise_mm"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} is {getattr(self, name)}: must be > 0; give the noise at rest")
        if self.smooth_mm < 0:
            raise ValueError(f"smooth_mm is {self.smooth_mm}: must be ≥ 0; give a length in mm")


@dataclasses.dataclass(frozen=True, kw_only=True)
class GelLoad:
    """Load on the gel in one frame, and the displacement due to each part of it.

    Args:
      traction_mpa: on the gel along x, y, z [h, w, 3]; pressing is z < 0.
      by_pressure_mm: lateral displacement that the pressure makes [h, w, 2].
      by_traction_mm: lateral displacement that the traction along the surface makes [h, w, 2].
      weight: α over the largest squared singular value.
    """

    traction_mpa: np.ndarray
    by_pressure_mm: np.ndarray
    by_traction_mm: np.ndarray
    weight: float


class LayerInverse:
    """From displacement to load on one grid.

    Args:
      layer: the gel; its modulus scales the loads and nothing else.
      grid: nodes.
      config: noise and smoothness.

    Raises:
      ValueError: a depth outside the layer.
    """

    def __init__(self, layer: Layer, grid: NodeGrid, config: InverseConfig | None = None):
        config = config or InverseConfig()
        self._grid, self._nodes = grid, grid.shape[0] * grid.shape[1]
        noise = (config.lateral_noise_mm, config.lateral_noise_mm, config.depth_noise_mm)
        self._noise = np.repeat(noise, self._nodes)
        compliance = compliance_matrix(layer, grid)
        self._lateral = compliance[: 2 * self._nodes].astype(np.float32)
        self._seen = shear_matrix(grid.shape, grid.pitch_mm) if config.gradient_free else None
        if self._seen is not None:
            compliance = np.concatenate([self._seen @ compliance[: 2 * self._nodes], compliance[2 * self._nodes :]])
        self._whitened = compliance / self._noise[:, None]
        self._gram = self._whitened.T @ self._whitened
        self._penalty = _covariance(grid, config.smooth_mm)
        self._decompose()

    def linear(self, displacement_mm: np.ndarray, depth_mm: np.ndarray) -> GelLoad:
        """The linear solution.

        Args:
          displacement_mm: lateral displacement [h, w, 2].
          depth_mm: indentation, positive into the gel [h, w].

        Raises:
          ValueError: arrays of another grid, or with a NaN.
        """
        load, weight = self._linear(self._observed(displacement_mm, depth_mm))
        return self._describe(load, weight)

    def contact(self, displacement_mm: np.ndarray, depth_mm: np.ndarray, touching: np.ndarray | None = None) -> GelLoad:
        """The solution in which only pressing nodes carry a load: arguments as for `linear`.

        Args:
          touching: bool [h, w], where the object may touch; by the linear solution's pressure if `None`.
        """
        observed = self._observed(displacement_mm, depth_mm)
        load, weight = self._linear(observed)
        if touching is None:
            pressure = load[2 * self._nodes :]
            pressing = pressure > _PRESSING * max(float(pressure.max()), 0.0)
        else:
            pressing = touching.ravel()
        return self._describe(self._contact(observed, pressing, weight), weight)

    def _decompose(self) -> None:
        root = linalg.block_diag(*[np.linalg.cholesky(self._penalty)] * COMPONENTS)
        left, self._singular, right = linalg.svd(self._whitened @ root)
        self._to_modes = np.ascontiguousarray(left.T, np.float32)
        self._from_modes = (root @ right.T).astype(np.float32)
        self._filters = self._singular**2 / (self._singular**2 + _WEIGHTS[:, None] * self._singular[0] ** 2)

    def _linear(self, observed: np.ndarray) -> tuple[np.ndarray, float]:
        modes = self._to_modes @ observed.astype(np.float32)
        best = self._cross_validated(modes)
        load = self._from_modes @ (self._filters[best] * modes / self._singular).astype(np.float32)
        return load, float(_WEIGHTS[best])

    def _cross_validated(self, modes: np.ndarray) -> int:
        """Index of the α of least ‖(1 − F) β‖² / (n − Σ F)²."""
        left = (1 - self._filters) ** 2 @ modes.astype(np.float64) ** 2
        return int(np.argmin(left / (modes.size - self._filters.sum(1)) ** 2))

    def _contact(self, observed: np.ndarray, pressing: np.ndarray, weight: float) -> np.ndarray:
        """Load [3 h w] of the pressing nodes, 0 elsewhere."""
        pull = self._whitened.T @ observed
        alpha = weight * self._singular[0] ** 2
        load = np.zeros(COMPONENTS * self._nodes)
        for _ in range(_ROUNDS):
            nodes = np.flatnonzero(pressing)
            if nodes.size == 0:
                break
            at = (nodes + self._nodes * np.arange(COMPONENTS)[:, None]).ravel()
            stiff = linalg.cho_solve(linalg.cho_factor(self._penalty[np.ix_(nodes, nodes)]), np.eye(nodes.size))
            normal = self._gram[np.ix_(at, at)] + alpha * linalg.block_diag(*[stiff] * COMPONENTS)
            load[:] = 0
            load[at] = linalg.cho_solve(linalg.cho_factor(normal, overwrite_a=True), pull[at])
            pulling = load[2 * self._nodes :] < 0
            if not pulling.any():
                break
            pressing = pressing & ~pulling
        load[2 * self._nodes :] = np.maximum(load[2 * self._nodes :], 0)
        return load

    def _describe(self, load: np.ndarray, weight: float) -> GelLoad:
        half = 2 * self._nodes
        load = load.astype(np.float32)
        return GelLoad(
            traction_mpa=self._fields(np.concatenate([load[:half], -load[half:]])),
            by_pressure_mm=self._fields(self._lateral[:, half:] @ load[half:]),
            by_traction_mm=self._fields(self._lateral[:, :half] @ load[:half]),
            weight=weight,
        )

    def _observed(self, displacement_mm: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
        """All displacements over their noise, [3 h w]."""
        shape = self._grid.shape
        if displacement_mm.shape != (*shape, 2) or depth_mm.shape != shape:
            raise ValueError(
                f"displacement_mm is {list(displacement_mm.shape)} and depth_mm {list(depth_mm.shape)}: must be "
                f"{[*shape, 2]} and {list(shape)}; resample them to the grid of the inverse"
            )
        lateral = np.concatenate([displacement_mm[..., 0].ravel(), displacement_mm[..., 1].ravel()])
        if not (np.all(np.isfinite(lateral)) and np.all(np.isfinite(depth_mm))):
            raise ValueError("displacement_mm or depth_mm holds a NaN: must be finite; fill unread nodes first")
        if self._seen is not None:
            lateral = self._seen @ lateral
        return np.concatenate([lateral, depth_mm.ravel()]) / self._noise

    def _fields(self, flat: np.ndarray) -> np.ndarray:
        return np.moveaxis(flat.reshape(-1, *self._grid.shape), 0, -1)


def _covariance(grid: NodeGrid, smooth_mm: float) -> np.ndarray:
    """K of one component, [h w, h w]."""
    rows, columns = grid.shape
    nodes = np.eye(rows * columns)
    if smooth_mm == 0:
        return nodes
    y, x = (a.ravel() * p for a, p in zip(np.mgrid[:rows, :columns], grid.pitch_mm[::-1], strict=True))
    away = np.sqrt(3) * np.hypot(y[:, None] - y, x[:, None] - x) / smooth_mm
    return (1 + away) * np.exp(-away) + _JITTER * nodes
