"""Which point of an octree a ray meets: picking on the server, where all points are."""

from __future__ import annotations

import numpy as np

from survey.viewer.tree import CloudTree

# Points behind the first one by so many widths of the ray are of the same surface, and the one nearest to its middle
# is meant.
_SAME_SURFACE = 2.0


def pick(tree: CloudTree, origin: np.ndarray, direction: np.ndarray, *, angle: float, least_m: float) -> int | None:
    """The row of the point that a ray meets first; None where it meets none.

    Parameters
    ----------
    tree : CloudTree
    origin, direction : (3,) [m], local
        The direction of any length.
    angle : [rad]
        By which the ray widens: a few pixels.
    least_m : [m]
        How wide it is at least: half the spacing of the points, or it would pass between them.
    """
    along = direction / np.linalg.norm(direction)
    found_t, found_off, found_rows = [], [], []
    first = np.inf
    for node, entry in _nodes_on(tree, origin, along, angle, least_m):
        if entry > first + _SAME_SURFACE * (least_m + angle * first):
            break
        rows = tree.rows(node)
        away = tree.points[rows] - origin
        t = away @ along
        off = np.linalg.norm(away - t[:, None] * along, axis=1)
        hit = (t > 0.0) & (off <= least_m + angle * t)
        if hit.any():
            first = min(first, float(t[hit].min()))
            found_t.append(t[hit])
            found_off.append(off[hit])
            found_rows.append(rows[hit])
    if not found_rows:
        return None
    t, off, rows = np.concatenate(found_t), np.concatenate(found_off), np.concatenate(found_rows)
    near = t <= first + _SAME_SURFACE * (least_m + angle * first)
    return int(rows[near][np.argmin(off[near])])


def _nodes_on(tree: CloudTree, origin: np.ndarray, along: np.ndarray, angle: float, least_m: float):
    """Nodes whose bounding spheres a widening ray touches, with the distance [m] at which it enters them, in order."""
    radius = 0.5 * np.sqrt(3.0) * tree.side
    away = tree.low + 0.5 * tree.side[:, None] - origin
    t = away @ along
    off = np.linalg.norm(away - t[:, None] * along, axis=1)
    end = np.maximum(t + radius, 0.0)
    touched = np.flatnonzero((t + radius > 0.0) & (off <= radius + least_m + angle * end))
    entry = np.maximum(t - radius, 0.0)[touched]
    order = np.argsort(entry, kind="stable")
    return zip(touched[order].tolist(), entry[order].tolist(), strict=True)
