"""The bonded layer's compliance between the nodes of a window, as one matrix.

The layer's response to a traction (τ_x, τ_y) along its surface and a pressure p is, per wave vector q = q e,

    û_i = [G_l e_i e_j + G_t (δ_ij − e_i e_j)] τ̂_j + i U e_i p̂,     û_z = N p̂ − i S e_j τ̂_j,

the five functions of `layer.DepthResponse`.  Its impulse responses fill a matrix from the tractions of all nodes
to the displacements of all nodes, so that nothing need vanish outside the window and nothing is periodic in it.
"""

import dataclasses

import numpy as np
from scipy import fft

from sensors_io.layer import DepthResponse, Layer, depth_response

COMPONENTS = 3
"""Of displacement (x, y, into the gel) and of load (τ_x, τ_y, p)."""

_PADDING = 12.0  # layer thicknesses between periodic images: near ν = ½ pressure reaches far along the layer


@dataclasses.dataclass(frozen=True, kw_only=True)
class NodeGrid:
    """Grid on which displacements are given and tractions are computed.

    Args:
      shape: rows and columns.
      pitch_mm: distance of nodes along x and y.
      marker_depth_mm: of the plane whose lateral displacement is read, below the surface.
      depth_mm: of the plane whose indentation is read; 0 for the surface.
    """

    shape: tuple[int, int]
    pitch_mm: tuple[float, float]
    marker_depth_mm: float
    depth_mm: float

    def __post_init__(self) -> None:
        if min(self.shape) < 2:
            raise ValueError(f"shape is {self.shape}: must be at least 2 × 2; give rows and columns")
        if min(self.pitch_mm) <= 0:
            raise ValueError(f"pitch_mm is {self.pitch_mm}: must be > 0; give the distance of nodes in mm")


def total_force(traction_mpa: np.ndarray, pitch_mm: tuple[float, float]) -> np.ndarray:
    """Σ τ dA, N, [3] of a traction field [h, w, 3] in MPa on nodes `pitch_mm` apart along x and y."""
    return traction_mpa.sum((0, 1), dtype=np.float64) * pitch_mm[0] * pitch_mm[1]


def total_moment(traction_mpa: np.ndarray, pitch_mm: tuple[float, float]) -> np.ndarray:
    """Σ r × τ dA about the centre of the window, N mm, [3] of a traction field [h, w, 3] in MPa, r in the plane."""
    rows, columns, _ = traction_mpa.shape
    x, y = ((np.arange(n) - (n - 1) / 2) * p for n, p in ((columns, pitch_mm[0]), (rows, pitch_mm[1])))
    tx, ty, tz = np.moveaxis(traction_mpa.astype(np.float64), -1, 0)
    about = (y[:, None] * tz, -x * tz, x * ty - y[:, None] * tx)
    return np.array([a.sum() for a in about]) * pitch_mm[0] * pitch_mm[1]


def compliance_matrix(layer: Layer, grid: NodeGrid) -> np.ndarray:
    """C: tractions (τ_x, τ_y, p) of all nodes → displacements (u_x, u_y, u_z) of all nodes, mm/MPa, [3 h w, 3 h w].

    A node's traction is the band-limited pulse of its grid, as in the generated scenes.
    """
    kernels = _impulse_responses(layer, grid)
    rows, columns = grid.shape
    y, x = (a.ravel() for a in np.mgrid[:rows, :columns])
    down, right = y[:, None] - y, x[:, None] - x  # negative offsets index from the end: the responses are periodic
    return np.block([[kernels[i, j][down, right] for j in range(COMPONENTS)] for i in range(COMPONENTS)])


def _impulse_responses(layer: Layer, grid: NodeGrid) -> np.ndarray:
    """Displacement i around a unit of traction j at the origin, [3, 3, My, Mx], periodic."""
    sizes = [
        fft.next_fast_len(2 * n + int(np.ceil(_PADDING * layer.thickness_mm / p)), real=True)
        for n, p in zip(grid.shape, grid.pitch_mm[::-1], strict=True)
    ]
    q_x = 2 * np.pi * fft.rfftfreq(sizes[1], grid.pitch_mm[0])[None, :]
    q_y = 2 * np.pi * fft.fftfreq(sizes[0], grid.pitch_mm[1])[:, None]
    q = np.hypot(q_x, q_y)
    # odd kernels have no real field at the Nyquist wave number
    odd_exists = (q > 0) & (np.abs(q_x) < np.pi / grid.pitch_mm[0]) & (np.abs(q_y) < np.pi / grid.pitch_mm[1])
    along = [np.divide(c, q, out=np.zeros_like(q), where=odd_exists) for c in np.broadcast_arrays(q_x, q_y)]
    markers, surface = (depth_response(q, layer, depth) for depth in (grid.marker_depth_mm, grid.depth_mm))
    return np.array([[fft.irfft2(entry, sizes) for entry in row] for row in _tensor(along, markers, surface)])


def _tensor(along: list[np.ndarray], markers: DepthResponse, surface: DepthResponse) -> list[list[np.ndarray]]:
    """Green's tensor per wave vector: rows u_x, u_y, u_z, columns τ_x, τ_y, p."""
    lateral = [
        [
            markers.lateral_shear * along[i] * along[j] + markers.transverse * (float(i == j) - along[i] * along[j])
            for j in range(2)
        ]
        + [1j * markers.lateral_pressure * along[i]]
        for i in range(2)
    ]
    normal = [-1j * surface.normal_shear * along[j] for j in range(2)] + [surface.normal_pressure + 0j]
    return [*lateral, normal]
