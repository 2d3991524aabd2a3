"""Normals of points from the planes through their neighbours, turned to the side that cameras see."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

_NEIGHBOURS = 12
_CHUNK = 50_000
# The side goes from a point to its neighbours in each: enough for walls a hundred points high.
_ROUNDS = 100


def oriented_normals(points: np.ndarray) -> np.ndarray:
    """Unit normals (N, 3) of points (N, 3) [m], z up, N at least 13.

    Cameras look down through the water, so normals point up. On walls that says little, and neighbours decide: in
    rounds, each point takes the side of those around it, the more the more level they lie and the more parallel they
    are.
    """
    tree = cKDTree(points)
    count = min(_NEIGHBOURS + 1, len(points))
    near = np.empty((len(points), count - 1), dtype=np.int32)
    normals = np.empty((len(points), 3))
    for first in range(0, len(points), _CHUNK):
        part = slice(first, first + _CHUNK)
        found = tree.query(points[part], k=count, workers=-1)[1]
        near[part] = found[:, 1:]
        local = points[found] - points[found].mean(axis=1, keepdims=True)
        normals[part] = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]
    normals[normals[:, 2] < 0.0] *= -1.0
    own = normals[:, 2] ** 2
    vote, voters = own, _agreements(normals, near)
    for _ in range(_ROUNDS):
        vote = np.clip(own + voters @ vote, -1.0, 1.0)
    normals[vote < 0.0] *= -1.0
    return normals


def _agreements(normals: np.ndarray, near: np.ndarray) -> csr_array:
    """How much (N, N) points weigh in each other's vote: signed squares of the cosine between their normals."""
    point = np.repeat(np.arange(len(near), dtype=np.int32), near.shape[1])
    other = near.ravel()
    cosine = np.einsum("ij,ij->i", normals[point], normals[other])
    weights = csr_array((cosine * np.abs(cosine) / near.shape[1], (point, other)), shape=(len(near), len(near)))
    return 0.5 * (weights + weights.T)
