"""Points of the bed under another surface of the water than the plane that they were found under.

Sweep and solver bend rays at a plane. Where the water was measured as a surface, or its level or the poses change
afterwards, each point is projected into the photographs that show it, through that plane; the rays of these pixels are
bent where they meet the other surface, and the point goes to where they come closest to each other. A surface that is
higher by d sinks the bed beneath it by (n - 1) d or more.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from fields.sweep.bed import BedPoints
from fields.sweep.views import Footprint
from geo.shapes import portions
from refract import FlatWater, PinholeCamera, kernels
from refract.curved import BicubicWater
from survey.folder.survey import Survey
from survey.photos.cameras import equations_of_lines
from survey.water.surface import Departure

# Steps to where a ray meets the surface: each leaves the square of its slope, a thousandth, of the error.
_STEPS = 2
_AT_ONCE = 100_000
# Rays nearer to parallel than half a degree place nothing.
_LEAST_DETERMINANT = 1.5e-4
# Least cosine of a ray in air to the vertical for which the effect on a height is computed.
_LEAST_COSINE = 0.2
# Std of the height of a raised plane that stands for what the search for the bed would do otherwise under it.
_RAISED_SHARE = 0.07
# Points whose rays are bent anew at it.
_RAISED_SAMPLE = 20_000
# Points whose coordinates are worked out at a time, of 200 bytes each.
_PORTION = 200_000


def through_surface(
    bed: BedPoints, cameras: Sequence[PinholeCamera], plane: FlatWater, departure: Departure
) -> BedPoints:
    """Points under the measured surface, with the std that it adds, from those of a bed found under a plane."""
    if not len(bed):
        return bed
    # Rays enter the water beside their points.
    reach = max(float(np.nanmax(bed.depth)), 0.0) + 1.0
    west, south = (bed.xyz[:, :2].min(axis=0) - reach).tolist()
    east, north = (bed.xyz[:, :2].max(axis=0) + reach).tolist()
    area = (west, south, east, north)
    surface, of_surface = departure.surface(area, plane), departure.interpolated_std(area)
    placed = _intersected(bed.xyz, (cameras, cameras), plane, surface)
    return _at(bed, placed, surface, of_surface(bed.xyz[:, :2]))


def through_raised(bed: BedPoints, before: Survey, after: Survey) -> BedPoints:
    """Points by the plane and poses of a survey that has changed a little, with the std that this adds.

    How far they go depends on the photographs around them, hardly on their depth: each goes as far as the nearest of
    its kind, wet or dry, of those whose rays are bent anew.
    """
    (plane, _), (raised, _), xyz = before.require_water(), after.require_water(), bed.xyz.copy()
    cameras = [[view.camera for view in survey.views] for survey in (before, after)]
    for kind in (bed.wet, ~bed.wet):
        chosen = np.flatnonzero(kind)
        sample = bed.xyz[chosen[:: max(len(chosen) // _RAISED_SAMPLE, 1)]]
        if not len(sample):
            continue
        moves, tree = _intersected(sample, cameras, plane, raised) - sample, cKDTree(sample)
        for rows in portions(len(chosen), _PORTION):
            xyz[chosen[rows]] += moves[tree.query(bed.xyz[chosen[rows]])[1]]
    std = _RAISED_SHARE * abs(float(raised.point[2] - plane.height(*raised.point[:2])))
    return _at(bed, xyz, raised, np.full(len(bed), std))


def _intersected(
    xyz: np.ndarray, cameras: Sequence[Sequence[PinholeCamera]], plane: FlatWater, surface: BicubicWater | FlatWater
) -> np.ndarray:
    """Places (N, 3) by cameras under a surface of points (N, 3) found by others, the first, under a plane."""
    heights = (xyz - np.array(plane.point)) @ np.array(plane.up)
    grounds = [Footprint.of(camera, plane, (float(heights.min()), float(heights.max()))) for camera in cameras[0]]
    parts = []
    for first in range(0, len(xyz), _AT_ONCE):
        points = xyz[first : first + _AT_ONCE]
        footprint = Footprint(points[:, :2].min(axis=0), points[:, :2].max(axis=0))
        near = [both for *both, ground in zip(*cameras, grounds, strict=True) if ground.meets(footprint)]
        parts.append(_placed(points, near, plane, surface))
    return np.concatenate(parts)


def _at(bed: BedPoints, xyz: np.ndarray, surface: BicubicWater | FlatWater, of_surface: np.ndarray) -> BedPoints:
    """Points at other places under a surface whose height has a std (N,) [m] over them."""
    depth = surface.height(xyz[:, 0], xyz[:, 1]) - xyz[:, 2]
    wet = depth > 0.0
    added = np.where(wet, bed_per_level(bed.incidence, float(surface.n_water)) * of_surface, 0.0)
    return replace(
        bed, xyz=xyz, depth=depth.astype(np.float32), wet=wet, std=np.hypot(bed.std, added).astype(np.float32)
    )


def bed_per_level(incidence: np.ndarray, n_water: float) -> np.ndarray:
    """Change of a bed point's height per metre of the water over it [-].

    A ray that enters the water a metre earlier comes out ``tan a - tan b`` aside at the bed, with ``sin a = n sin b``,
    and rays of this incidence meet lower by that over ``tan b``: n - 1 straight down, and more for oblique rays.
    """
    sine = np.minimum(np.sin(incidence), np.sqrt(1.0 - _LEAST_COSINE**2))
    return n_water * np.sqrt((1.0 - (sine / n_water) ** 2) / (1.0 - sine**2)) - 1.0


def _placed(
    points: np.ndarray, cameras: Sequence[Sequence[PinholeCamera]], plane: FlatWater, surface: BicubicWater | FlatWater
) -> np.ndarray:
    """Points (N, 3) where their rays, weighted by px/m, meet through the surface; as they are with fewer than two."""
    count = np.zeros(len(points), dtype=int)
    wet_sums, dry_sums = ((np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))) for _ in range(2))
    for before, camera in cameras:
        pixels = before.project(points, plane)
        seen = before.sees(pixels)
        number, path = np.flatnonzero(seen), camera.paths(pixels[seen], plane)
        crossing, bent = _entered(path.crossing, path.air_direction, surface, camera.tide)
        known = path.wet & np.isfinite(bent).all(axis=1)
        # Of distances in air, and of those in water beside them.
        px_per_m = camera.fx / np.linalg.norm(points[seen] - camera.centre, axis=1)[known]
        at_bed = px_per_m * path.air_direction[known, 2] / bent[known, 2]
        _add(wet_sums, number[known], crossing[known], bent[known], at_bed**2)
        _add(dry_sums, number[known], path.origin[known], path.air_direction[known], px_per_m**2)
        count[number[known]] += 1
    # Of two nearly parallel rays the determinant is twice the square of their angle, times the cube of their weight.
    weight = np.trace(wet_sums[0], axis1=1, axis2=2) / (2.0 * np.maximum(count, 1))
    found = (count >= 2) & (np.linalg.det(wet_sums[0]) > _LEAST_DETERMINANT * weight**3)
    placed = points.copy()
    under = np.linalg.solve(wet_sums[0][found], wet_sums[1][found][..., None])[..., 0]
    over = np.linalg.solve(dry_sums[0][found], dry_sums[1][found][..., None])[..., 0]
    is_wet = under[:, 2] < surface.height(under[:, 0], under[:, 1])
    placed[found] = np.where(is_wet[:, None], under, over)
    return placed


def _entered(
    crossing: np.ndarray, ray: np.ndarray, surface: BicubicWater | FlatWater, tide: float
) -> tuple[np.ndarray, np.ndarray]:
    """Crossings of rays in air with the surface, near those with a plane, and their directions in water (N, 3)."""
    for _ in range(_STEPS):
        normal = np.column_stack(_normals(surface, crossing))
        over = surface.height(crossing[:, 0], crossing[:, 1]) + tide - crossing[:, 2]
        crossing = crossing + (over * normal[:, 2] / np.sum(ray * normal, axis=1))[:, None] * ray
    bent = kernels.bend(tuple(ray.T), _normals(surface, crossing), 1.0, surface.n_water)
    return crossing, np.column_stack(bent)


def _normals(surface: BicubicWater | FlatWater, crossing: np.ndarray) -> tuple[np.ndarray, ...]:
    """Components (N,) of the normals at crossings (N, 3); those of a plane are numbers."""
    x, y = crossing[:, :2].T
    return tuple(np.broadcast_to(each, x.shape) for each in surface.normal(x, y))


def _add(
    sums: tuple[np.ndarray, np.ndarray], number: np.ndarray, through: np.ndarray, along: np.ndarray, weight: np.ndarray
) -> None:
    """Add lines to the normal equations of the points nearest to them; a point has one line at most here."""
    normals, rights = equations_of_lines(through, along)
    sums[0][number] += weight[:, None, None] * normals
    sums[1][number] += weight[:, None] * rights
