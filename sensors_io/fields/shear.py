"""Shear and contact force of a gel, frame by frame, from its deformation and its depth.

Shear is the lateral displacement that traction along the surface makes.  What the camera sees is more: pressing alone
spreads the gel, and carries its markers towards the lens, which magnifies the picture.

It is taken as the response of an even layer to the traction that explains the picture best, not as the deformation less
the pressure's part: that keeps the noise of every node.  A layer taken too thick or too stiff in volume cannot be
inferred from what is left unexplained, since some traction always explains it; `inversion` says what guards against it.
"""

import dataclasses

import numpy as np

from sensors_io.fields.compliance import NodeGrid, total_force, total_moment
from sensors_io.fields.inversion import InverseConfig, LayerInverse
from sensors_io.fields.spline import ThinPlate
from sensors_io.layer import Layer


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShearAndForce:
    """One frame on the node grid.

    Args:
      shear_mm: what the traction makes by the layer's compliance [h, w, 2].
      subtracted_mm: deformation less what the pressure makes [h, w, 2]; it keeps the noise of the deformation.
      traction_mpa: on the gel along x, y, z [h, w, 3]; pressing is z < 0.
      force_n: its total [3].
      moment_nmm: about the centre of the window [3].
    """

    shear_mm: np.ndarray
    subtracted_mm: np.ndarray
    traction_mpa: np.ndarray
    force_n: np.ndarray
    moment_nmm: np.ndarray


class ShearReader:
    """Splits deformations of one gel.

    Args:
      layer: the gel; its modulus scales the forces, its Poisson ratio and thickness count for shear.
      grid: nodes.
      config: of the inversion.
      camera_mm: from the pupil to the markers, to undo the magnification that pressing makes; `None` where the
        deformation is free of it.

    Raises:
      ValueError: a depth outside the layer, a camera that is not in front of the markers.
    """

    def __init__(
        self, layer: Layer, grid: NodeGrid, config: InverseConfig | None = None, camera_mm: float | None = None
    ):
        if camera_mm is not None and camera_mm <= 0:
            raise ValueError(f"camera_mm is {camera_mm}: must be > 0; give the distance of the pupil in mm, or None")
        self._grid, self._camera_mm = grid, camera_mm
        self._inverse = LayerInverse(layer, grid, config)
        rows, columns = grid.shape
        y, x = ((np.arange(n) - (n - 1) / 2) * p for n, p in zip(grid.shape, grid.pitch_mm[::-1], strict=True))
        self._place_mm = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1)
        self._spline = ThinPlate(np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2))

    def read(
        self,
        deformation_mm: np.ndarray,
        depth_mm: np.ndarray,
        valid: np.ndarray | None = None,
        touching: np.ndarray | None = None,
    ) -> ShearAndForce:
        """Split one frame.

        Args:
          deformation_mm: apparent lateral displacement [h, w, 2].
          depth_mm: indentation [h, w], positive into the gel.
          valid: bool [h, w]: nodes that are read; the spline of the others stands for the rest.
          touching: bool [h, w]: where the object may touch; found from the fields if `None`.

        Raises:
          ValueError: arrays of another grid, or fewer than four valid nodes.
        """
        if valid is not None and not valid.all():
            both = np.concatenate([deformation_mm, depth_mm[..., None]], -1)
            filled = self._spline.filled(both.reshape(-1, 3), valid.ravel()).reshape(both.shape)
            deformation_mm, depth_mm = filled[..., :2], filled[..., 2]
        if self._camera_mm is not None:
            deformation_mm = deformation_mm - depth_mm[..., None] / self._camera_mm * self._place_mm
        load = self._inverse.contact(deformation_mm, depth_mm, touching)
        return ShearAndForce(
            shear_mm=load.by_traction_mm,
            subtracted_mm=(deformation_mm - load.by_pressure_mm).astype(np.float32),
            traction_mpa=load.traction_mpa,
            force_n=total_force(load.traction_mpa, self._grid.pitch_mm),
            moment_nmm=total_moment(load.traction_mpa, self._grid.pitch_mm),
        )
