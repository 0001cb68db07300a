"""Consistency of tracked points: a graph of near neighbours and the strain along its edges.

A printed lattice looks the same one pitch further on.  A tracker that takes one dot for the next makes no error that
the picture shows, but it tears the gel: along the border of the mistaken points the strain is near one.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

_DEGREE = 6  # nearest neighbours of each point: a ring of a lattice and some more
_LONGEST = 1.8  # edge over the typical nearest distance: at two pitches a mistaken dot strains by half of it only


class Neighbours:
    """The graph of P points at rest.

    Args:
      points_px: (x, y) [P, 2], P ≥ 2.
    """

    def __init__(self, points_px: np.ndarray):
        degree = min(_DEGREE, len(points_px) - 1)
        away, near = (a[:, 1:] for a in KDTree(points_px).query(points_px, degree + 1))
        kept = away <= _LONGEST * np.median(away[:, 0])
        kept[:, 0] = True  # a lonely point keeps its nearest
        pairs = np.sort(np.column_stack([np.repeat(np.arange(len(points_px)), kept.sum(1)), near[kept]]), 1)
        self._first, self._second = np.unique(pairs, axis=0).T
        self._length = np.hypot(*(points_px[self._first] - points_px[self._second]).T)
        self._count = len(points_px)

    def torn(self, displacement: np.ndarray, found: np.ndarray, strain: float) -> bool:
        """True if displacements [P, 2] strain any edge between found points [P] past a limit."""
        return bool(np.any(~self._whole(displacement, strain) & found[self._first] & found[self._second]))

    def pieces(self, displacement: np.ndarray, found: np.ndarray, strain: float) -> list[np.ndarray]:
        """The found points by what hangs together below a strain, the largest piece first; masks [P] each."""
        edge = self._whole(displacement, strain) & found[self._first] & found[self._second]
        ends = (self._first[edge], self._second[edge])
        graph = coo_array((np.ones(edge.sum()), ends), shape=(self._count, self._count))
        label = np.where(found, connected_components(graph, directed=False)[1], -1)
        names, size = np.unique(label[found], return_counts=True)
        return [label == name for name in names[np.argsort(-size, kind="stable")]]

    def adjacent(self, inner: np.ndarray) -> np.ndarray:
        """Points [P] that are not in a set but have a neighbour in it."""
        adjacent = np.zeros(self._count, bool)
        adjacent[self._first[inner[self._second]]] = True
        adjacent[self._second[inner[self._first]]] = True
        return adjacent & ~inner

    def _whole(self, displacement: np.ndarray, strain: float) -> np.ndarray:
        """Mask of the edges within the limit."""
        apart = displacement[self._first] - displacement[self._second]
        return np.hypot(apart[:, 0], apart[:, 1]) <= strain * self._length
