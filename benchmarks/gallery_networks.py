"""Networks of cameras over a flat bed, and its shape from straight rays. Used by draw_gallery.py."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from refract import FlatWater, PinholeCamera, crossing_point

# 35 mm and pixels of 20 um: 59 by 46 degrees of view.
FOCAL_PX, WIDTH_PX, HEIGHT_PX = 1750.0, 2000, 1500
FLYING_HEIGHT_M, DEPTH_M = 39.0, 3.5


@dataclass(frozen=True)
class Network:
    """Cameras over the bed, with a name for a picture."""

    name: str
    cameras: list[PinholeCamera]

    @property
    def centres(self) -> np.ndarray:
        return np.array([camera.centre for camera in self.cameras])


def look(centre, target) -> PinholeCamera:
    """A camera at `centre` with its axis through `target` (both local, m), its rows level."""
    forward = np.subtract(target, centre) / np.linalg.norm(np.subtract(target, centre))
    right = np.cross(forward, (0.0, 1.0, 0.0) if abs(forward[2]) > 0.999 else (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return PinholeCamera(centre, rotation, FOCAL_PX, FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2, WIDTH_PX, HEIGHT_PX)


def nadir_block() -> Network:
    """Four strips of five views, straight down."""
    places = [(x, y) for y in (-6.0, -2.0, 2.0, 6.0) for x in (-8.0, -4.0, 0.0, 4.0, 8.0)]
    return Network("nadir block", [look((x, y, FLYING_HEIGHT_M), (x, y, 0.0)) for x, y in places])


def convergent_block() -> Network:
    """The nadir block with three rings of twelve views of its middle, 30, 38 and 45 degrees off nadir."""
    rings = []
    for off_nadir in np.radians([30.0, 38.0, 45.0]):
        reach = FLYING_HEIGHT_M * np.tan(off_nadir)
        for azimuth in np.arange(12) * (2.0 * np.pi / 12) + off_nadir:
            centre = (reach * np.cos(azimuth), reach * np.sin(azimuth), FLYING_HEIGHT_M)
            rings.append(look(centre, (0.0, 0.0, -DEPTH_M)))
    return Network("the same with oblique rings", nadir_block().cameras + rings)


def meeting_points(cameras, toward, seen) -> tuple[np.ndarray, np.ndarray]:
    """Where straight rays from the cameras come nearest to each other, in least squares.

    Parameters
    ----------
    cameras : (V, 3) [m]
    toward : (P, V, 3) [m]
        A second point of each ray.
    seen : (P, V) bool
        Rays that count; at least two for each point.

    Returns
    -------
    points : (P, 3) [m]
    misses : (P,) [rad]
        Root mean square of the angles by which the rays miss their meeting point.
    """
    ray = toward - cameras
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    across = (np.eye(3) - ray[..., :, None] * ray[..., None, :]) * seen[..., None, None]
    points = np.linalg.solve(across.sum(axis=1), np.einsum("pvij,vj->pi", across, cameras)[..., None])[..., 0]
    off = points[:, None] - cameras
    misses = np.linalg.norm(np.cross(off, ray), axis=-1) / np.linalg.norm(off, axis=-1)
    return points, np.sqrt((misses**2 * seen).sum(axis=1) / seen.sum(axis=1))


def error_map(network: Network, water: FlatWater, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height error of straight rays [m] and their rms miss [px] at places (P, 2) of a bed 3.5 m deep; NaN unseen."""
    bed = np.concatenate([places, np.full((len(places), 1), -DEPTH_M)], axis=1)
    pixels = np.stack([camera.project(bed, water) for camera in network.cameras], axis=1)
    seen = ((pixels >= 0.0) & (pixels <= (WIDTH_PX, HEIGHT_PX))).all(axis=-1)
    error, miss = np.full((2, len(bed)), np.nan)
    usable = seen.sum(axis=1) >= 3
    toward = crossing_point(bed[usable, None], network.centres, water)
    points, angles = meeting_points(network.centres, toward, seen[usable])
    error[usable], miss[usable] = points[:, 2] + DEPTH_M, FOCAL_PX * angles
    return error, miss
