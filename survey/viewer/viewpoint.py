"""What of an octree is worth drawing from one viewpoint: what it sees, as fine as its pixels show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from survey.viewer.tree import CloudTree

# Points that a browser draws smoothly.
MOST_POINTS = 3_000_000
# A node is refined until the points of it lie so close on the screen [px].
_FINEST_PX = 1.0


@dataclass(frozen=True)
class Viewpoint:
    """A pinhole without distortion, its principal point in the middle of the screen.

    Attributes
    ----------
    position : (3,) [m], local
    cam_from_local : (3, 3)
        Camera axes are x right, y down, z forward.
    fov : [rad]
        Of the height of the screen.
    aspect : [-]
        Width over height.
    height_px : [px]
    """

    position: np.ndarray
    cam_from_local: np.ndarray
    fov: float
    aspect: float
    height_px: float

    @property
    def focal_px(self) -> float:
        """Focal length [px]."""
        return 0.5 * self.height_px / math.tan(0.5 * self.fov)

    def planes(self) -> np.ndarray:
        """Normals (5, 3), local, of the planes through the camera that bound what it sees, pointing inwards."""
        down = math.tan(0.5 * self.fov)
        right = down * self.aspect
        inwards = np.array(
            [[1.0, 0.0, right], [-1.0, 0.0, right], [0.0, 1.0, down], [0.0, -1.0, down], [0.0, 0.0, 1.0]]
        )
        return inwards / np.linalg.norm(inwards, axis=1, keepdims=True) @ self.cam_from_local


def seen_nodes(tree: CloudTree, view: Viewpoint) -> np.ndarray:
    """Which nodes (M,) bool a viewpoint may see: those whose cube no bounding plane cuts off."""
    half = 0.5 * tree.side
    middle = tree.low + half[:, None] - view.position
    planes = view.planes()
    reach = half[:, None] * np.abs(planes).sum(axis=1)
    return (middle @ planes.T + reach >= 0.0).all(axis=1)


def spacing_px(tree: CloudTree, view: Viewpoint) -> np.ndarray:
    """Distance of neighbouring points of nodes on the screen (M,) [px], at the nearest place of their cubes."""
    nearest = np.clip(view.position, tree.low, tree.low + tree.side[:, None])
    distance = np.linalg.norm(nearest - view.position, axis=1)
    return view.focal_px * tree.spacing / np.maximum(distance, tree.spacing)


def select_nodes(
    tree: CloudTree, view: Viewpoint, most_points: int = MOST_POINTS, finest_px: float = _FINEST_PX
) -> np.ndarray:
    """Nodes (K,) int to draw, the most needed first; with a node come all nodes above it.

    A node is drawn where its parent is too coarse for the screen; a parent is nearer and coarser than its children, so
    that a limit on the number of points cuts off the finest ones.
    """
    coarseness = spacing_px(tree, view)
    needed = np.where(tree.parent < 0, np.inf, coarseness[tree.parent])
    wanted = np.flatnonzero(seen_nodes(tree, view) & (needed > finest_px))
    # Stable: of equals, parents come first as they do in the tree.
    wanted = wanted[np.argsort(-needed[wanted], kind="stable")]
    return wanted[np.cumsum(tree.counts[wanted]) <= most_points]


def point_sizes(tree: CloudTree, nodes: np.ndarray, view: Viewpoint, finest_m: float) -> np.ndarray:
    """Sizes (M,) [m] of points that leave no gap, where some nodes are drawn: the spacing of the finest ones there.

    Leaves have the spacing of the cloud, ``finest_m``. Of nodes that are not drawn the size means nothing.
    """
    drawn = np.zeros(len(tree), dtype=bool)
    drawn[nodes] = True
    size = np.where(tree.is_leaf(), finest_m, np.maximum(tree.spacing, finest_m))
    misses = np.zeros(len(tree), dtype=bool)
    seen = seen_nodes(tree, view)
    children = np.flatnonzero(tree.parent >= 0)
    misses[tree.parent[children[seen[children] & ~drawn[children]]]] = True
    finer = np.full(len(tree), finest_m)
    # Children first: they come after their parents.
    for node in nodes[np.argsort(-nodes)]:
        if not misses[node]:
            size[node] = min(size[node], finer[node])
        above = tree.parent[node]
        if above >= 0:
            finer[above] = max(finer[above], size[node])
    return size
