"""Points of the bed from one plane of water to its measured surface.

Sweep and solver bend rays at a plane. Here each point is projected into the photographs that show it, through that
plane; the rays of these pixels are bent where they meet the measured surface, and the point goes to where they come
closest to each other. A surface that is higher by d sinks the bed beneath it by (n - 1) d or more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fields.sweep.bed import BedPoints
from fields.sweep.views import Footprint
from refract import FlatWater, PinholeCamera, kernels
from refract.curved import BicubicWater
from survey.water.surface import Departure

# Steps to where a ray meets the surface: each leaves the square of its slope, a thousandth, of the error.
_STEPS = 2
_AT_ONCE = 100_000
# Rays nearer to parallel than half a degree place nothing.
_LEAST_DETERMINANT = 1.5e-4
# Least cosine of a ray in air to the vertical for which the effect on a height is computed.
_LEAST_COSINE = 0.2


def through_surface(
    bed: BedPoints, cameras: Sequence[PinholeCamera], plane: FlatWater, departure: Departure
) -> BedPoints:
    """Points under the measured surface, found under a plane, with the std that it adds.

    Parameters
    ----------
    bed : BedPoints
        Of the plane.
    """
    if not len(bed):
        return bed
    # Rays enter the water beside their points.
    reach = max(float(np.nanmax(bed.depth)), 0.0) + 1.0
    west, south = (bed.xyz[:, :2].min(axis=0) - reach).tolist()
    east, north = (bed.xyz[:, :2].max(axis=0) + reach).tolist()
    area = (west, south, east, north)
    surface, of_surface = departure.surface(area, plane), departure.interpolated_std(area)
    heights = (bed.xyz - np.array(plane.point)) @ np.array(plane.up)
    grounds = [Footprint.of(camera, plane, (float(heights.min()), float(heights.max()))) for camera in cameras]
    parts = []
    for first in range(0, len(bed), _AT_ONCE):
        points = bed.xyz[first : first + _AT_ONCE]
        here = Footprint(points[:, :2].min(axis=0), points[:, :2].max(axis=0))
        near = [camera for camera, ground in zip(cameras, grounds, strict=True) if ground.meets(here)]
        parts.append(_placed(points, near, plane, surface))
    xyz = np.concatenate(parts)
    depth = surface.height(xyz[:, 0], xyz[:, 1]) - xyz[:, 2]
    wet = depth > 0.0
    added = np.where(wet, by_level(bed.incidence, float(plane.n_water)) * of_surface(bed.xyz[:, :2]), 0.0)
    return replace(
        bed, xyz=xyz, depth=depth.astype(np.float32), wet=wet, std=np.hypot(bed.std, added).astype(np.float32)
    )


def by_level(incidence: np.ndarray, n_water: float) -> np.ndarray:
    """Change of a bed point's height per metre of the water over it [-].

    A ray that enters the water a metre earlier comes out ``tan a - tan b`` aside at the bed, with ``sin a = n sin b``,
    and rays of this incidence meet lower by that over ``tan b``: n - 1 straight down, and more for oblique rays.
    """
    sine = np.minimum(np.sin(incidence), np.sqrt(1.0 - _LEAST_COSINE**2))
    return n_water * np.sqrt((1.0 - (sine / n_water) ** 2) / (1.0 - sine**2)) - 1.0


def _placed(
    points: np.ndarray, cameras: Sequence[PinholeCamera], plane: FlatWater, surface: BicubicWater
) -> np.ndarray:
    """Points (N, 3) where their rays come closest through the surface; as they are where fewer than two are known."""
    count = np.zeros(len(points), dtype=int)
    wet_sums, dry_sums = ((np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))) for _ in range(2))
    for camera in cameras:
        pixels = camera.project(points, plane)
        seen = camera.sees(pixels)
        number, path = np.flatnonzero(seen), camera.paths(pixels[seen], plane)
        crossing, bent = _entered(path.crossing, path.air_direction, surface, camera.tide)
        known = path.wet & np.isfinite(bent).all(axis=1)
        _add(wet_sums, number[known], crossing[known], bent[known])
        _add(dry_sums, number[known], path.origin[known], path.air_direction[known])
        count[number[known]] += 1
    # Of two nearly parallel rays the determinant is twice the square of their angle.
    found = (count >= 2) & (np.linalg.det(wet_sums[0]) > _LEAST_DETERMINANT)
    placed = points.copy()
    under = np.linalg.solve(wet_sums[0][found], wet_sums[1][found][..., None])[..., 0]
    over = np.linalg.solve(dry_sums[0][found], dry_sums[1][found][..., None])[..., 0]
    is_wet = under[:, 2] < surface.height(under[:, 0], under[:, 1])
    placed[found] = np.where(is_wet[:, None], under, over)
    return placed


def _entered(
    crossing: np.ndarray, ray: np.ndarray, surface: BicubicWater, tide: float
) -> tuple[np.ndarray, np.ndarray]:
    """Crossings of rays in air with the surface, near those with a plane, and their directions in water (N, 3)."""
    for _ in range(_STEPS):
        normal = np.column_stack(surface.normal(crossing[:, 0], crossing[:, 1]))
        over = surface.height(crossing[:, 0], crossing[:, 1]) + tide - crossing[:, 2]
        crossing = crossing + (over * normal[:, 2] / np.sum(ray * normal, axis=1))[:, None] * ray
    normals = surface.normal(crossing[:, 0], crossing[:, 1])
    bent = kernels.bend(tuple(ray.T), normals, 1.0, surface.n_water)
    return crossing, np.column_stack(bent)


def _add(sums: tuple[np.ndarray, np.ndarray], number: np.ndarray, through: np.ndarray, along: np.ndarray) -> None:
    """Add lines to the normal equations of the points nearest to them; a point has one line at most here."""
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    sums[0][number] += across
    sums[1][number] += np.einsum("nij,nj->ni", across, through)
