"""Ghost points beneath overhangs: few maps hold them, and they stand off a flat surface that many maps hold.

Windows of the sweep that cover an edge and what lies behind it leave heights between both.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from fields.image_store import LazyImages, Masks
from fields.sweep.beneath import are_beneath, beside_steps
from fields.sweep.block import Block
from fields.sweep.kernels.stack import ViewStack, largest
from fields.sweep.map_points import MapPoints
from fields.sweep.maps import HeightMap, trusted

# How much higher a kept point of the same cell of the ground, or of one beside it, is: in ground sampling distances.
_OVER_GSD = 6.0
# A point of a surface is held by so many other maps. A piece of the surface has so many of them at least, and at most,
# within so many ground sampling distances.
_WELL_HELD, _LEAST_POINTS, _MOST_POINTS, _REACH_GSD = 4, 8, 30, 6.0
# The piece is flat where its standard deviation from its plane is less than this, and a surface, not a line, where that
# along its shorter side is more: in ground sampling distances.
_FLAT_GSD, _WIDE_GSD = 0.8, 0.8
# A ghost stands off the plane by more than the first, and lies beside the middle of the piece by less than the second.
_OFF_GSD, _BESIDE_GSD = 1.5, 2.5
# It is held by less than this share of the maps that hold the points of the piece, in the mean.
_SHARE_HELD = 0.25


def without_ghosts(block: Block, maps: Sequence[HeightMap], kept: Masks, gsd: float) -> Masks:
    """Pixels ``kept`` of each map less those beneath others that are ghosts.

    Parameters
    ----------
    block : Block
    maps : sequence of HeightMap
        With the heights of the solver: they tell ghosts apart better than those of the sweep.
    kept : Masks (height, width), in the order of `maps`
    gsd : [m]
        Ground sampling distance.
    """
    cameras = [block.cameras[m.view] for m in maps]
    shapes = [(camera.height, camera.width) for camera in cameras]
    sure, beside, left = (Masks(list(shapes)) for _ in range(3))
    for index, m in enumerate(maps):
        sure[index], left[index] = trusted(m), kept[index]
        beside[index] = left[index] & beside_steps(m.height, gsd)
    images = LazyImages(lambda index: maps[index].height, len(cameras), largest(cameras), 1)
    stack = ViewStack.build(block.device, cameras, images, block.water)
    points = MapPoints.of(stack, beside)
    points = points[are_beneath(stack, kept, points.xyz, gsd, _OVER_GSD, around=1)]
    holding = points.votes(stack, sure, gsd)[2]
    points, holding = points[holding < _WELL_HELD], holding[holding < _WELL_HELD]
    if len(holding):
        about = MapPoints.about(stack, kept, points.xyz, _REACH_GSD * gsd)
        held = about.votes(stack, sure, gsd)[2]
        points[stand_off(points.xyz.T / gsd, holding, about.xyz.T / gsd, held)].mark(left, False)
    return left


def stand_off(points: np.ndarray, holding: np.ndarray, about: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Points (N, 3) that stand off a flat piece of those about them, which far more maps hold: (N,) bool.

    Parameters
    ----------
    points, about : (N, 3), (M, 3)
        In ground sampling distances.
    holding, held : (N,), (M,)
        Number of other maps that hold them.
    """
    surface, held = about[held >= _WELL_HELD].astype(np.float64), held[held >= _WELL_HELD]
    if len(surface) < _LEAST_POINTS:
        return np.zeros(len(points), dtype=bool)
    most = min(_MOST_POINTS, len(surface))
    distance, near = cKDTree(surface).query(points, k=most, distance_upper_bound=_REACH_GSD)
    known = np.isfinite(distance)
    near[~known] = 0
    weight = known * np.exp(-((np.where(known, distance, 0.0) / (0.5 * _REACH_GSD)) ** 2))
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    middle = np.einsum("nk,nka->na", weight, surface[near])
    spread = surface[near] - middle[:, None]
    variances, axes = np.linalg.eigh(np.einsum("nk,nka,nkb->nab", weight, spread, spread))
    thick, wide = np.sqrt(np.maximum(variances[:, :2], 0.0)).T
    aside, normal = points - middle, axes[:, :, 0]
    off = np.einsum("na,na->n", aside, normal)
    beside = np.linalg.norm(aside - off[:, None] * normal, axis=1)
    is_piece = (known.sum(axis=1) >= _LEAST_POINTS) & (thick < _FLAT_GSD) & (wide > _WIDE_GSD)
    few = holding < _SHARE_HELD * np.einsum("nk,nk->n", weight, held[near])
    return is_piece & few & (np.abs(off) > _OFF_GSD) & (beside < _BESIDE_GSD)
