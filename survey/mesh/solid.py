"""A surface closed with walls and a bottom, for programs that want a body: 3D printing, volumes."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def solid_of(vertices: np.ndarray, faces: np.ndarray, thickness_m: float) -> tuple[np.ndarray, np.ndarray]:
    """The surface on a block: walls down from every rim, to a bottom below the lowest vertex.

    Parameters
    ----------
    vertices : (V, 3) [m]
    faces : (F, 3) int
        At most two of them share an edge, with opposite directions.
    thickness_m : [m]
        Of the block under the lowest vertex.

    Returns
    -------
    vertices : (2 V', 3) [m]
        Those of the surface first, doubled where two parts of it met in one vertex only.
    faces : (F', 3) int
        Each edge has exactly two, with opposite directions. Holes of the surface become shafts.
    """
    faces, kept = _parted(faces)
    top = vertices[kept]
    bottom = top.copy()
    bottom[:, 2] = vertices[:, 2].min() - thickness_m
    number = len(top)
    rim = _rim(faces)
    a, b = rim.T
    walls = np.concatenate([np.stack([b, a, a + number], 1), np.stack([b, a + number, b + number], 1)])
    return np.concatenate([top, bottom]), np.concatenate([faces, faces[:, ::-1] + number, walls])


def _rim(faces: np.ndarray) -> np.ndarray:
    """Edges (E, 2), in the direction of their face, that one face alone has."""
    edges = _edges(faces)
    _, place, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return edges[place[count == 1]]


def _edges(faces: np.ndarray) -> np.ndarray:
    return np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)


def _parted(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces whose vertices have one fan of faces each; the old number of each new vertex.

    Corners of faces are one vertex where a chain of faces with common edges joins them.
    """
    edges, corner = _edges(faces), np.arange(faces.size)
    following = corner // 3 * 3 + (corner + 1) % 3
    order = np.lexsort((edges.max(axis=1), edges.min(axis=1)))
    sorted_edges = np.sort(edges, axis=1)[order]
    pair = np.flatnonzero((sorted_edges[1:] == sorted_edges[:-1]).all(axis=1))
    one, other = order[pair], order[pair + 1]
    # The two faces run along their common edge in opposite directions: one's first corner is the other's second.
    rows, columns = np.concatenate([one, following[one]]), np.concatenate([following[other], other])
    links = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(faces.size, faces.size))
    _, fan = connected_components(links, directed=False)
    _, first, numbers = np.unique(fan, return_index=True, return_inverse=True)
    return numbers.reshape(-1, 3), faces.ravel()[first]
