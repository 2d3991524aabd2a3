"""A block of photographs over known water, as exact tie points with noise: the oracle of the self-calibration."""

from __future__ import annotations

import numpy as np

from refract import PinholeCamera
from survey.photos.poses import TiePoints
from tests.drawn_block import water_plane

TRUTH = np.array([0.3, 0.002, -0.001, 1.335])
SIZE, FOCAL, HEIGHT = (1024, 768), 1750.0, 40.0


def looking_at_origin(centre, turn: float) -> PinholeCamera:
    """A camera whose axis meets the origin, turned about it."""
    forward = -np.asarray(centre) / np.linalg.norm(centre)
    right = np.cross(forward, [np.sin(turn), np.cos(turn), 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return PinholeCamera(np.asarray(centre), rotation, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, *SIZE)


def convergent() -> list[PinholeCamera]:
    """Five views from above and two rings of eight, 25 and 45 degrees off nadir."""
    cameras = nadir()[:5]
    for off in np.radians([25.0, 45.0]):
        for azimuth in 2.0 * np.pi * np.arange(8) / 8:
            side = HEIGHT * np.tan(off)
            centre = (side * np.cos(azimuth), side * np.sin(azimuth), HEIGHT)
            cameras.append(looking_at_origin(centre, azimuth))
    return cameras


def nadir() -> list[PinholeCamera]:
    """Nine views straight down, 5 m apart."""
    rotation = np.diag([1.0, -1.0, -1.0])
    places = [(0, 0), (5, 0), (-5, 0), (0, 5), (0, -5), (5, 5), (-5, 5), (5, -5), (-5, -5)]
    return [
        PinholeCamera(np.array([x, y, HEIGHT]), rotation, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, *SIZE)
        for x, y in places
    ]


def meeting_of_straight_rays(cameras, ties: TiePoints) -> np.ndarray:
    """Points (M, 3) nearest to their lines of sight, as if there were no water."""
    normal, right = np.zeros((len(ties), 3, 3)), np.zeros((len(ties), 3))
    for view, camera in enumerate(cameras):
        mine = ties.view == view
        ray = (ties.pixel[mine] - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        ray = np.column_stack([ray, np.ones(len(ray))]) @ camera.cam_from_local
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        np.add.at(normal, ties.point[mine], across)
        np.add.at(right, ties.point[mine], across @ camera.centre)
    return np.linalg.solve(normal, right[..., None])[..., 0]


def tie_points(cameras, rng, *, count=300, std_px=0.1, low=-5.0, high=-0.5, wrong=0.0) -> TiePoints:
    """Points of a bed between two heights [m], seen by every camera that has them in its image.

    ``wrong`` is the share of measurements that are up to 20 px off.
    """
    points = np.column_stack([rng.uniform(-9.0, 9.0, (count, 2)), rng.uniform(low, high, count)])
    rows = []
    for view, camera in enumerate(cameras):
        pixels = camera.project(points, water_plane(TRUTH))
        seen = np.flatnonzero((pixels > 0.0).all(axis=1) & (pixels < SIZE).all(axis=1))
        noise = std_px * rng.normal(size=(len(seen), 2))
        noise += (rng.random((len(seen), 1)) < wrong) * rng.uniform(-20.0, 20.0, (len(seen), 2))
        rows.append((seen, np.full(len(seen), view), pixels[seen] + noise))
    point, view, pixel = (np.concatenate(column) for column in zip(*rows, strict=True))
    order = np.argsort(point, kind="stable")
    start = points + rng.normal(0.0, 0.2, points.shape)
    ties = TiePoints(start, point[order], view[order], pixel[order])
    return ties.only(np.ones(len(ties.view), dtype=bool))
