"""Everything solid in a scene: the bed, the bodies on it, their appearance, the first hit of a ray, and the extent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from refract import PinholeCamera
from survey.simulate.ground.shapes import BedGrid, Solid, near_solids
from survey.simulate.ground.skin import ImageSkin, VertexSkin, look_up
from survey.simulate.ground.triangles import TriangleMesh
from survey.simulate.light import Light

# The body of a hit on the bed, and of a ray that meets nothing.
BED, NOTHING = -1, -2

Shape = BedGrid | Solid | TriangleMesh
Shade = Callable[[np.ndarray, np.ndarray], np.ndarray]
# Margin beyond the view of the outermost pixels [m].
_MARGIN_M = 0.5


@dataclass(frozen=True)
class Material:
    """Material of a body."""

    skin: ImageSkin | VertexSkin  # Its albedo
    shade: Shade  # callable: light (N,) at points (N, 3) on faces (N,) in the mode without light transport


@dataclass(frozen=True)
class Ground:
    """Everything solid in a scene; its appearance does not depend on the viewer."""

    bed: BedGrid | TriangleMesh
    solids: tuple[Solid | TriangleMesh, ...]  # tuple of Solid or TriangleMesh: the bodies on the bed
    looks: tuple[Material, ...]  # Of the bed, then of each body

    def first(self, origin: np.ndarray, direction: np.ndarray, t_end: np.ndarray):
        """First hits of rays up to ``t_end``: distance (N,) [m], body (N,) and face (N,).

        The distance is infinite, and the body `NOTHING`, where a ray meets nothing.
        """
        t, face = self.bed.hit(origin, direction, t_end)
        body = np.where(np.isfinite(t), BED, NOTHING)
        ends = np.minimum(t, t_end)
        top = max((solid.centre[2] + solid.radius for solid in self.solids), default=-np.inf)
        # Most rays through air end above all bodies.
        low = np.flatnonzero(origin[:, 2] + ends * direction[:, 2] < top)
        if not low.size:
            return t, body, face
        near = near_solids(self.solids, origin[low], direction[low], ends[low])
        for index, solid in enumerate(self.solids):
            rays = low[near[:, index]]
            t_solid, face_solid = solid.hit(origin[rays], direction[rays], t_end[rays])
            nearer = t_solid < t[rays]
            rays = rays[nearer]
            t[rays], body[rays], face[rays] = t_solid[nearer], index, face_solid[nearer]
        return t, body, face

    def colour(self, points: np.ndarray, body: np.ndarray, face: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) of points (N, 3) [m] in dry air; black where there is nothing."""
        colour = np.zeros((len(points), 3))
        for index, look in enumerate(self.looks, start=BED):
            on = np.flatnonzero(body == index)
            if on.size:
                shade = look.shade(points[on], face[on])
                colour[on] = look.skin.albedo(points[on], face[on]) * shade[:, None]
        return colour


def shade_of_map(bed: BedGrid, lit: np.ndarray) -> Shade:
    """Light from values (ny, nx) at the vertices of a bed."""
    lit = np.ascontiguousarray(lit, dtype=np.float32)

    def shade(points: np.ndarray, face: np.ndarray) -> np.ndarray:
        return look_up(lit, (points[:, :2] - (bed.west, bed.south)) / bed.cell)[:, 0]

    return shade


def shade_of_normals(normals: np.ndarray, light: Light) -> Shade:
    """Light by the normals (F, 3) of faces."""
    lit = light.on(normals)
    return lambda points, face: lit[face]


def shade_beside_bed(solid: Solid | TriangleMesh, bed: BedGrid | TriangleMesh, light: Light) -> Shade:
    """Light by the normals of a body, darker near the corner between it and the bed."""
    lit = light.on(solid.normals)

    def shade(points: np.ndarray, face: np.ndarray) -> np.ndarray:
        over_bed = (points[:, 2] - bed.height(points[:, 0], points[:, 1])) / (0.6 * solid.radius)
        # Beside a bed of limited extent there is no corner.
        over_bed = np.nan_to_num(over_bed, nan=1.0)
        return lit[face] * (0.6 + 0.4 * np.clip(over_bed, 0.0, 1.0))

    return shade


def seen_area(
    cameras: Sequence[PinholeCamera], size_m: tuple[float, float], lowest: float
) -> tuple[float, float, float, float]:
    """West, south, east and north [m], local, of an area about the origin and all that cameras see of a plane.

    Parameters
    ----------
    size_m : (east, north) [m]
        Of the area.
    lowest : [m]
        Height of a plane below all of the bed; rays count as straight, which reaches further than under water.
    """
    corners = [0.5 * np.array(size_m), -0.5 * np.array(size_m)]
    for camera in cameras:
        u, v = np.meshgrid([0.0, camera.width], [0.0, camera.height])
        rays = camera.directions(np.stack([u.ravel(), v.ravel()], axis=-1))
        t = (camera.centre[2] - lowest) / -rays[:, 2]
        corners.extend((camera.centre + t[:, None] * rays)[:, :2])
    low, high = np.min(corners, axis=0) - _MARGIN_M, np.max(corners, axis=0) + _MARGIN_M
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
