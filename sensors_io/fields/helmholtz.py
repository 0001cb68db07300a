"""Helmholtz–Hodge decomposition of a displacement field: the usual reading of shear, kept as a baseline.

    u = ∇φ + rot ψ + h,   ∇·h = 0 = ∇×h

Pressing spreads the gel, which is a gradient; so what has no divergence is taken for shear.  But a tangential load is
partly a gradient itself, and a pressure's field is one only where the window sees all of it.
"""

import dataclasses

import numpy as np
from scipy import fft


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hodge:
    """The three parts of a field, each [h, w, 2] in its unit."""

    gradient: np.ndarray
    rotation: np.ndarray
    harmonic: np.ndarray

    @property
    def shear(self) -> np.ndarray:
        """Shear part of the decomposition: the component without divergence."""
        return self.rotation + self.harmonic


def decompose(displacement: np.ndarray, pitch: tuple[float, float]) -> Hodge:
    """The natural decomposition of a field on a grid, by free-space Green's functions.

        φ(r) = ∫ G(r − r') ∇·u(r') dr',   ψ(r) = −∫ G(r − r') ∇×u(r') dr',   G(r) = ln|r| / 2π

    Args:
      displacement: [h, w, 2].
      pitch: of the nodes along x and y.

    Source: Bhatia, Pascucci & Bremer, IEEE TVCG 20, 1566, 2014: no boundary condition is imposed, the harmonic part
    takes what flows through the border.
    """
    u, v = displacement[..., 0].astype(np.float64), displacement[..., 1].astype(np.float64)
    u_y, u_x = np.gradient(u, pitch[1], pitch[0])
    v_y, v_x = np.gradient(v, pitch[1], pitch[0])
    potential = _convolved(np.add(u_x, v_y), pitch)
    stream = -_convolved(np.subtract(v_x, u_y), pitch)
    phi_y, phi_x = np.gradient(potential, pitch[1], pitch[0])
    psi_y, psi_x = np.gradient(stream, pitch[1], pitch[0])
    gradient = np.stack([phi_x, phi_y], -1)
    rotation = np.stack([psi_y, -psi_x], -1)
    return Hodge(gradient=gradient, rotation=rotation, harmonic=displacement - gradient - rotation)


def shear_matrix(shape: tuple[int, int], pitch: tuple[float, float]) -> np.ndarray:
    """`Hodge.shear` as one matrix: displacements (u_x, u_y) of all nodes → what of them has no divergence.

    Args:
      shape: rows and columns.
      pitch: of the nodes along x and y.

    Returns:
      float64 [2 h w, 2 h w].
    """
    size = 2 * shape[0] * shape[1]
    matrix = np.empty((size, size))
    for column, unit in enumerate(np.eye(size)):
        shear = decompose(np.moveaxis(unit.reshape(2, *shape), 0, -1), pitch).shear
        matrix[:, column] = np.moveaxis(shear, -1, 0).ravel()
    return matrix


def _convolved(source: np.ndarray, pitch: tuple[float, float]) -> np.ndarray:
    """∫ ln|r − r'| / 2π source dr' on the nodes, zero-padded."""
    rows, columns = source.shape
    size = [fft.next_fast_len(2 * n - 1, real=True) for n in source.shape]
    y = np.arange(-rows + 1, rows)[:, None] * pitch[1]
    x = np.arange(-columns + 1, columns)[None, :] * pitch[0]
    away = np.hypot(x, y)
    # the mean of ln r over the cell at the origin, as over a disk of its area: ln a − 1/2
    away[rows - 1, columns - 1] = np.sqrt(pitch[0] * pitch[1] / np.pi) * np.exp(-0.5)
    green = np.log(away) / (2 * np.pi) * pitch[0] * pitch[1]
    full = fft.irfft2(fft.rfft2(source, size) * fft.rfft2(green, size), size)
    # the kernel's origin lies at (rows − 1, columns − 1); what wraps around does not reach the window
    return full[rows - 1 : 2 * rows - 1, columns - 1 : 2 * columns - 1]
