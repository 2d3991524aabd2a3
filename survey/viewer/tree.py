"""The cloud of a run as an octree: each point in one node, coarse nodes hold a thinned cloud of all below them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geo.octree import CELLS, build_octree

# Steps along the largest extent: finer than any cloud, and they fit into 32 bits.
_STEPS = 2**30


@dataclass(frozen=True)
class CloudTree:
    """Nodes over points; a node comes after its parent, the root first.

    Attributes
    ----------
    points : (N, 3) float64 [m], local
        As they were given.
    order : (N,) int
        Rows of the points, node after node.
    starts : (M + 1,) int64
        Node i has the rows ``order[starts[i]:starts[i + 1]]``.
    low : (M, 3) float64 [m], local
        Lowest corners of the cubes.
    side : (M,) [m]
        Of the cubes.
    parent : (M,) int64
        -1 for the root.
    """

    points: np.ndarray
    order: np.ndarray
    starts: np.ndarray
    low: np.ndarray
    side: np.ndarray
    parent: np.ndarray

    def __len__(self) -> int:
        return len(self.side)

    @property
    def counts(self) -> np.ndarray:
        """Points of each node (M,)."""
        return np.diff(self.starts)

    @property
    def spacing(self) -> np.ndarray:
        """Distance of neighbouring points in a node that has children (M,) [m]."""
        return self.side / CELLS

    def rows(self, node: int) -> np.ndarray:
        """Rows (K,) of the points of a node."""
        return self.order[self.starts[node] : self.starts[node + 1]]

    def is_leaf(self) -> np.ndarray:
        """Whether a node has no children (M,) bool."""
        leaf = np.ones(len(self), dtype=bool)
        leaf[self.parent[1:]] = False
        return leaf


def build_tree(points: np.ndarray) -> CloudTree:
    """The octree over points (N, 3) [m], N at least 1."""
    low = points.min(axis=0)
    # Points in one place have an extent too.
    extent = max(float((points.max(axis=0) - low).max()), 1e-6)
    step = extent / _STEPS
    columns = [((points[:, axis] - low[axis]) / step).astype(np.int32) for axis in range(3)]
    octree = build_octree(columns)
    levels, cells = octree.keys[:, 0].astype(np.int64), octree.keys[:, 1:].astype(np.int64)
    side = octree.side * step / 2.0**levels
    starts = np.concatenate([[0], np.cumsum(octree.counts)])
    return CloudTree(points, octree.order, starts, low + cells * side[:, None], side, _parents(levels, cells))


def _parents(levels: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The node (M,) one level above that contains each; -1 for the root."""
    index = {(int(level), *cell): node for node, (level, cell) in enumerate(zip(levels, cells.tolist(), strict=True))}
    above = (cells >> 1).tolist()
    return np.array([index.get((int(level) - 1, *cell), -1) for level, cell in zip(levels, above, strict=True)])
