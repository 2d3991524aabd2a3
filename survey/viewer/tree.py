"""The cloud of a run as an octree: its nodes, picking, and the level of detail for the camera of a screen.

Each point is in one node; coarse nodes hold a thinned cloud of all below them. Picking is done on the server, where all
points are. Drawn are the nodes in the view frustum, refined until their points are a pixel apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geo.copc import CELLS, build_octree
from refract import PinholeCamera
from survey.photos.poses import rotation_from_quaternion

if TYPE_CHECKING:
    import viser

# Steps along the largest extent: finer than any cloud, and they fit into 32 bits.
_STEPS = 2**30
# Points at most this many ray widths behind the first one belong to the same surface; the one nearest to the axis of
# the ray is picked.
_SAME_SURFACE = 2.0
# Points that occlude a ray; fewer are outliers.
_BLOCKING = 3
# Points that a browser draws smoothly.
MOST_POINTS = 3_000_000
# A node is refined until the points of it lie so close on the screen [px].
_FINEST_PX = 1.0


@dataclass(frozen=True)
class CloudTree:
    """Nodes over points; a node comes after its parent, the root first."""

    points: np.ndarray  # (N, 3) float64 [m], local: as they were given
    order: np.ndarray  # (N,) int: rows of the points, node after node
    starts: np.ndarray  # (M + 1,) int64: node i has the rows ``order[starts[i]:starts[i + 1]]``
    low: np.ndarray  # (M, 3) float64 [m], local: lowest corners of the cubes
    side: np.ndarray  # (M,) [m]: of the cubes
    parent: np.ndarray  # (M,) int64: -1 for the root

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

    def nodes_of(self, rows: np.ndarray) -> np.ndarray:
        """The nodes (K,) that hold some of these points."""
        is_one = np.zeros(len(self.points), dtype=bool)
        is_one[rows] = True
        return np.unique(np.searchsorted(self.starts, np.flatnonzero(is_one[self.order]), side="right") - 1)


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


def pick(tree: CloudTree, origin: np.ndarray, direction: np.ndarray, *, angle: float, least_m: float) -> int | None:
    """Row of the first point that a ray from an origin in a direction (3,) [m], local, hits; None where it hits none.

    The ray widens by an angle [rad], a few pixels, and is at least ``least_m`` wide, half the spacing of the points,
    or it would pass between them.
    """
    along = direction / np.linalg.norm(direction)
    met: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    first = np.inf
    for node, entry in _nodes_on(tree, origin, along, angle, least_m):
        if entry > first + _SAME_SURFACE * (least_m + angle * first):
            break
        rows = tree.rows(node)
        t, off = _along_and_off(tree.points[rows], origin, along)
        hit = (t > 0.0) & (off <= least_m + angle * t)
        if hit.any():
            first = min(first, float(t[hit].min()))
            met.append((t[hit], off[hit], rows[hit]))
    if not met:
        return None
    t, off, rows = (np.concatenate(parts) for parts in zip(*met, strict=True))
    near = t <= first + _SAME_SURFACE * (least_m + angle * first)
    return int(rows[near][np.argmin(off[near])])


def is_blocked(tree: CloudTree, start: np.ndarray, end: np.ndarray, *, width_m: float, free_m: float) -> bool:
    """Whether three points or more within ``width_m`` occlude the line between two places (3,) [m], local.

    They count farther than ``free_m`` from its start, which lies on the surface.
    """
    vector = end - start
    length = float(np.linalg.norm(vector))
    if length <= free_m:
        return False
    along, num = vector / length, 0
    for node, entry in _nodes_on(tree, start, along, 0.0, width_m):
        if entry > length:
            break
        t, off = _along_and_off(tree.points[tree.rows(node)], start, along)
        num += int(((t > free_m) & (t < length) & (off <= width_m)).sum())
        if num >= _BLOCKING:
            return True
    return False


def _nodes_on(tree: CloudTree, origin: np.ndarray, along: np.ndarray, angle: float, least_m: float):
    """Nodes whose bounding spheres a widening ray touches, with the distance [m] at which it enters them, in order."""
    radius = 0.5 * np.sqrt(3.0) * tree.side
    t, off = _along_and_off(tree.low + 0.5 * tree.side[:, None], origin, along)
    end = np.maximum(t + radius, 0.0)
    touched = np.flatnonzero((t + radius > 0.0) & (off <= radius + least_m + angle * end))
    entry = np.maximum(t - radius, 0.0)[touched]
    order = np.argsort(entry, kind="stable")
    return zip(touched[order].tolist(), entry[order].tolist(), strict=True)


def _along_and_off(points: np.ndarray, origin: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (N,) [m] of points (N, 3) along a ray from an origin in a unit direction (3,), and from its axis."""
    offset = points - origin
    t = offset @ along
    return t, np.linalg.norm(offset - t[:, None] * along, axis=1)


def camera_of_screen(
    position: np.ndarray, cam_from_local: np.ndarray, fov: float, aspect: float, height_px: float
) -> PinholeCamera:
    """The camera of a screen by the field of view of its height [rad] and width over height."""
    height = max(round(height_px), 1)
    width, focal = max(round(height * aspect), 1), 0.5 * height / math.tan(0.5 * fov)
    return PinholeCamera(position, cam_from_local, focal, focal, 0.5 * width, 0.5 * height, width, height)


def camera_in_browser(camera: viser.CameraHandle) -> PinholeCamera:
    rotation = rotation_from_quaternion(*(float(v) for v in camera.wxyz))
    return camera_of_screen(np.asarray(camera.position), rotation.T, camera.fov, camera.aspect, camera.image_height)


def _bounding_planes(camera: PinholeCamera) -> np.ndarray:
    """Normals (5, 3), local, of the planes through a camera that bound what it sees, pointing inwards."""
    right, down = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    inwards = np.array([[1.0, 0.0, right], [-1.0, 0.0, right], [0.0, 1.0, down], [0.0, -1.0, down], [0.0, 0.0, 1.0]])
    return inwards / np.linalg.norm(inwards, axis=1, keepdims=True) @ camera.cam_from_local


def seen_nodes(tree: CloudTree, camera: PinholeCamera) -> np.ndarray:
    """Mask (M,) bool of the nodes in the view frustum: those whose cube no bounding plane cuts off."""
    half = 0.5 * tree.side
    middle = tree.low + half[:, None] - camera.centre
    planes = _bounding_planes(camera)
    reach = half[:, None] * np.abs(planes).sum(axis=1)
    return (middle @ planes.T + reach >= 0.0).all(axis=1)


def spacing_px(tree: CloudTree, camera: PinholeCamera) -> np.ndarray:
    """Distance of neighbouring points of nodes on the screen (M,) [px], at the nearest place of their cubes."""
    nearest = np.clip(camera.centre, tree.low, tree.low + tree.side[:, None])
    distance = np.linalg.norm(nearest - camera.centre, axis=1)
    return camera.fy * tree.spacing / np.maximum(distance, tree.spacing)


def select_nodes(tree: CloudTree, camera: PinholeCamera, most_points: int = MOST_POINTS) -> np.ndarray:
    """Nodes (K,) int to draw, the most needed first; with a node come all nodes above it.

    A node is drawn where its parent is too coarse for the screen; a limit on the points cuts off the finest ones.
    """
    coarseness = spacing_px(tree, camera)
    needed = np.where(tree.parent < 0, np.inf, coarseness[tree.parent])
    selected = np.flatnonzero(seen_nodes(tree, camera) & (needed > _FINEST_PX))
    # Stable: of equals, parents come first as they do in the tree.
    selected = selected[np.argsort(-needed[selected], kind="stable")]
    return selected[np.cumsum(tree.counts[selected]) <= most_points]


def point_sizes(tree: CloudTree, nodes: np.ndarray, camera: PinholeCamera, finest_m: float) -> np.ndarray:
    """Sizes (M,) [m] of points that leave no gap: the spacing of the finest nodes there, of leaves ``finest_m``."""
    drawn = np.zeros(len(tree), dtype=bool)
    drawn[nodes] = True
    size = np.maximum(tree.spacing, finest_m)
    size[np.setdiff1d(np.arange(len(tree)), tree.parent)] = finest_m
    misses = np.zeros(len(tree), dtype=bool)
    seen = seen_nodes(tree, camera)
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
