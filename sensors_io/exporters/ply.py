"""Depth maps as surfaces: a PLY mesh or point cloud of the gel, in mm, x right, y down, z out of the gel.

A PLY file of each sequence, of its deepest frame; programs such as MeshLab, Blender and Open3D open it.
"""

import pathlib

import cv2
import numpy as np

from sensors_io.arrays import load_arrays
from sensors_io.errors import MALFORMED
from sensors_io.exporters.selection import ExportError, Progress, Selected, published
from sensors_io.schema import Sequence


def export_ply(selected: Selected, out: pathlib.Path, points: bool, progress: Progress) -> None:
    """Write the deepest frame of every sequence to a folder, whole or not at all.

    Args:
      selected: contacts.
      out: folder to write.
      points: whether faces are left out.
      progress: called with the number of contacts done and their total.

    Raises:
      ExportError: `out` exists, no sequence has depth, or one has no pitch.
    """
    found = 0
    with published(out) as temporary:
        temporary.mkdir()
        for number, contact in selected.contacts(progress):
            for sensor, sequence in contact.items():
                if sequence.depth_mm is not None:
                    key, frame = sequence.key, int(sequence.depth_mm.max((1, 2)).argmax())
                    name = f"{number:06d}-{key.object_id}-{key.motion}-{sensor}-{frame:05d}.ply"
                    colours = None if sequence.frames is None else sequence.frames[frame]
                    written = surface(sequence.depth_mm[frame], _pitch_mm(sequence), colours, points)
                    (temporary / name).write_bytes(written)
                    found += 1
        if not found:
            raise ExportError(
                f"{selected.store.path} holds no depth: must have depth_mm; write it by `python -m sensors_io extract`"
            )


def ply_of_file(path: pathlib.Path, out: pathlib.Path, points: bool) -> int:
    """Write every depth map of a file that `extract` wrote to a folder, whole or not at all; their number.

    Raises:
      ExportError: it is no such file, its depth was refused, or `out` exists.
    """
    try:
        file = load_arrays(path)
        depth, pitch, names = file["depth_mm"], float(file["mm_per_px"]), file["names"]
        stems = [pathlib.PurePosixPath(str(name).replace("\0", "_")).stem for name in names]
        if depth.ndim != 3 or len(stems) != len(depth) or not pitch > 0:
            raise ValueError(f"depth_mm {list(depth.shape)}, {len(stems)} names, {pitch:g} mm per px")
        finite = bool(np.isfinite(depth.astype(np.float32)).all())
    except (OSError, *MALFORMED) as error:
        raise ExportError(f"{path} is no file of `extract` ({error!r}); extract the pictures again") from error
    if not finite or not depth.size:
        raise ExportError(f"{path} holds no depth: must be extracted with a calibration; give --calibration there")
    with published(out) as temporary:
        temporary.mkdir()
        for n, (one, stem) in enumerate(zip(depth, stems, strict=True)):
            (temporary / f"{n:05d}-{stem}.ply").write_bytes(surface(one, pitch, None, points))
    return len(depth)


def surface(depth_mm: np.ndarray, mm_per_px: float, colours: np.ndarray | None = None, points: bool = False) -> bytes:
    """A binary PLY of one depth map.

    Args:
      depth_mm: float32 [h, w], indentation; z is its negative.
      mm_per_px: pitch of its grid.
      colours: uint8 [H, W, 3] of the same window; `None` leaves the surface grey.
      points: whether faces are left out.
    """
    height, width = depth_mm.shape
    y, x = np.mgrid[:height, :width].astype(np.float32) * np.float32(mm_per_px)
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.zeros(height * width, kinds)
    for name, values in (("x", x), ("y", y), ("z", -depth_mm)):
        vertices[name] = values.ravel()
    grey = np.full((height, width, 3), 128, np.uint8)
    seen = grey if colours is None else cv2.resize(colours, (width, height), interpolation=cv2.INTER_AREA)
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = seen[..., channel].ravel()
    head = ["ply", "format binary_little_endian 1.0", "comment units mm", f"element vertex {len(vertices)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"property uchar {name}" for name in ("red", "green", "blue")]
    faces = np.zeros(0, [("count", "u1"), ("corners", "<i4", 3)]) if points else _triangles(height, width)
    if len(faces):
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    return "\n".join([*head, "end_header", ""]).encode() + vertices.tobytes() + faces.tobytes()


def _triangles(height: int, width: int) -> np.ndarray:
    """Two for each cell of the grid; their outside is z, out of the gel."""
    corner = np.arange(height * width, dtype=np.int32).reshape(height, width)
    first, right, below, across = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    corners = np.concatenate([np.stack([first, right, below], -1), np.stack([right, across, below], -1)]).reshape(-1, 3)
    faces = np.zeros(len(corners), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, corners
    return faces


def _pitch_mm(sequence: Sequence) -> float:
    """Of the depth's grid, which covers the window of the pictures."""
    assert sequence.depth_mm is not None
    if sequence.mm_per_px is None:
        raise ExportError(
            f"{sequence.name}: mm_per_px is None: the size of the surface hangs on it; import or record with it"
        )
    rows = sequence.depth_mm.shape[1] if sequence.frames is None else sequence.frames.shape[1]
    return sequence.mm_per_px * rows / sequence.depth_mm.shape[1]
