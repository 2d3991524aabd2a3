"""Where warped photographs fail, by the true surface: beside steps of depth, and where few photographs see a place.

Distances run along the bent path from the camera; the true surface is a mesh.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

from refract import FlatWater, PinholeCamera
from survey.simulate.ground.shapes import TriangleMesh

# Neighbouring pixels whose points are further apart along the path than this many times their distance across it: a
# surface that rises by 79 degrees from the picture, or a step.
STEP = 5.0
REACH_PX = 5
FEW = 3
# A place is hidden from a photograph that sees something this much nearer [m]; its distances are known at every so many
# pixels.
HIDDEN_M, STRIDE = 0.05, 4


def true_points(
    camera: PinholeCamera, water: FlatWater | None, surface: TriangleMesh, stride: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (rows, columns) [m] and points (rows, columns, 3) of one pixel in so many each way; NaN for none."""
    pixels = camera.pixel_centres()[stride // 2 :: stride, stride // 2 :: stride]
    flat = pixels.reshape(-1, 2)
    origin, direction = camera.centres(flat), camera.directions(flat)
    origin = np.broadcast_to(origin, direction.shape)
    before = np.full(len(flat), np.inf)
    if water is not None:
        paths = camera.paths(flat, water)
        before = np.where(paths.wet, paths.air_length, np.inf)
    distance, _ = surface.hit(origin, direction, before)
    points = origin + np.where(np.isfinite(distance), distance, np.nan)[:, None] * direction
    under = np.flatnonzero(~np.isfinite(distance) & np.isfinite(before))
    if under.size and water is not None:
        start, bent = paths.crossing[under], paths.water_direction[under]
        further, _ = surface.hit(start, bent, np.full(len(under), np.inf))
        points[under] = start + np.where(np.isfinite(further), further, np.nan)[:, None] * bent
        distance[under] = before[under] + further
    distance = np.where(np.isfinite(distance), distance, np.nan)
    return distance.reshape(pixels.shape[:2]), points.reshape(*pixels.shape[:2], 3)


def near_steps(distance: np.ndarray, focal_px: float, reach_px: int = REACH_PX) -> np.ndarray:
    """Which pixels (height, width) lie within ``reach_px`` of a step between neighbours."""
    step = np.zeros(distance.shape, dtype=bool)
    for before, after in (((slice(None), slice(-1)), (slice(None), slice(1, None))),
                          ((slice(-1), slice(None)), (slice(1, None), slice(None)))):  # fmt: skip
        near, far = distance[before], distance[after]
        jump = np.abs(far - near) > STEP * np.fmin(near, far) / focal_px
        step[before] |= jump
        step[after] |= jump
    return step if not step.any() else distance_transform_edt(~step) <= reach_px


def sightings(
    points: np.ndarray, cameras: Sequence[PinholeCamera], water: FlatWater | None, surface: TriangleMesh
) -> np.ndarray:
    """How many cameras see each of points (..., 3)."""
    flat, count = points.reshape(-1, 3), np.zeros(points[..., 0].size, dtype=int)
    known = np.flatnonzero(np.isfinite(flat).all(axis=1))
    for camera in cameras:
        pixels = camera.project(flat[known], water)
        inside = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=1)
        rows = known[inside]
        if not rows.size:
            continue
        seen, _ = true_points(camera, water, surface, STRIDE)
        at = (pixels[inside].T[::-1] - 0.5 - STRIDE // 2) / STRIDE
        found = map_coordinates(seen, at, order=1, mode="nearest")
        count[rows] += found > _distances(camera, water, flat[rows]) - HIDDEN_M
    return count.reshape(points.shape[:-1])


def _distances(camera: PinholeCamera, water: FlatWater | None, points: np.ndarray) -> np.ndarray:
    """Path lengths (N,) [m] from a camera to points (N, 3) [m] that it sees."""
    if water is None:
        return np.linalg.norm(points - camera.centre, axis=1)
    paths = camera.paths(camera.project(points, water), water)
    return np.where(
        paths.wet,
        paths.air_length + np.linalg.norm(points - paths.crossing, axis=1),
        np.linalg.norm(points - camera.centre, axis=1),
    )
