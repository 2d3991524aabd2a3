"""Lines of sight to points under a water plane, with their derivatives, for many cameras at once.

Seen from a camera, a point under water lies in the direction of the crossing of its ray with the surface. In the
vertical plane through both, with

    H    height of the camera over the water plane, h the depth of the point under it
    d    distance of their feet on the plane, s that from the foot of the camera to the crossing

Snell's law is ``g = s / sqrt(s^2 + H^2) - n (d - s) / sqrt((d - s)^2 + h^2) = 0``, whose partial derivatives give those
of s. The line of sight is ``s u - H N``, u the unit vector from foot to foot and N the normal of the plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from refract import FlatWater, crossing_point

# Four are exact to the last bits in drone geometry (docs/optics.md), two more for lower flights.
_NEWTON_STEPS = 6


@dataclass(frozen=True)
class Sight:
    """Lines of sight from N cameras to N points.

    Attributes
    ----------
    line : (N, 3) [m], local
        From the camera to the crossing of the surface; to the point itself where the ray is straight.
    by_point, by_centre : (N, 3, 3)
        Derivatives by the point and by the centre of the camera.
    by_water : (N, 3, 4)
        By the height of the plane at its reference point [m], its slopes along local x and y, and its index.
    wet : (N,) bool
    """

    line: np.ndarray
    by_point: np.ndarray
    by_centre: np.ndarray
    by_water: np.ndarray
    wet: np.ndarray


def lines_of_sight(centres: np.ndarray, points: np.ndarray, water: FlatWater | None) -> np.ndarray:
    """Lines of sight (N, 3) from centres (N, 3) to points (N, 3) [m], local; see `Sight`."""
    return crossing_point(points, centres, water, steps=_NEWTON_STEPS) - centres


def sights(centres: np.ndarray, points: np.ndarray, water: FlatWater | None) -> Sight:
    """Lines of sight from centres (N, 3) to points (N, 3) [m], local, with their derivatives."""
    line = lines_of_sight(centres, points, water)
    by_point = np.tile(np.eye(3), (len(line), 1, 1))
    by_centre, by_water = -by_point, np.zeros((len(line), 3, 4))
    wet = np.zeros(len(line), dtype=bool)
    if water is not None:
        wet = (water.depth(points) > 0.0) & (water.depth(centres) < 0.0)
        bent = _derivatives(line[wet], centres[wet], points[wet], water)
        by_point[wet], by_centre[wet], by_water[wet] = bent
    return Sight(line, by_point, by_centre, by_water, wet)


def _derivatives(line, centres, points, water: FlatWater):
    """Derivatives of bent lines of sight by the point, the centre and the water."""
    slopes = np.array([-water.slope_x, -water.slope_y, 1.0])
    stretch = np.linalg.norm(slopes)
    normal, foot, n = slopes / stretch, np.array(water.point), water.n_water
    apart = points - centres
    across = apart - np.outer(apart @ normal, normal)
    high, deep = (centres - foot) @ normal, (foot - points) @ normal
    d = np.linalg.norm(across, axis=1)
    s = np.linalg.norm(line + high[:, None] * normal, axis=1)
    air, wet = np.hypot(s, high), np.hypot(d - s, deep)
    by_s = high**2 / air**3 + n * deep**2 / wet**3
    s_d = n * deep**2 / wet**3 / by_s
    s_high = s * high / air**3 / by_s
    s_deep = -n * (d - s) * deep / wet**3 / by_s
    s_n = (d - s) / wet / by_s
    # Straight below the camera the direction is undefined, and the ratio of s to d its own limit, s_d.
    vertical = d < 1e-9
    towards = np.where(vertical[:, None], 0.0, across / np.where(vertical, 1.0, d)[:, None])
    share = np.where(vertical, s_d, s / np.where(vertical, 1.0, d))
    both = towards[:, :, None] * towards[:, None, :]
    by_across = share[:, None, None] * (np.eye(3) - both) + s_d[:, None, None] * both
    sideways = by_across @ (np.eye(3) - np.outer(normal, normal))
    by_high = s_high[:, None] * towards - normal
    by_deep = s_deep[:, None] * towards
    by_point = sideways - by_deep[:, :, None] * normal
    by_centre = -sideways + by_high[:, :, None] * normal
    by_height = (by_deep - by_high) / stretch
    columns = [by_height]
    for axis in range(2):
        turn = normal * slopes[axis] / stretch**2 - np.eye(3)[axis] / stretch
        columns.append(
            _by_normal(turn, normal, apart, centres - foot, foot - points, by_across, by_high, by_deep, high)
        )
    columns.append(s_n[:, None] * towards)
    return by_point, by_centre, np.stack(columns, axis=-1)


def _by_normal(turn, normal, apart, up, down, by_across, by_high, by_deep, high):
    """Change of the line of sight as the normal of the plane turns by a small vector about its reference point."""
    across = -np.outer(apart @ normal, turn) - np.outer(apart @ turn, normal)
    moved = np.einsum("nij,nj->ni", by_across, across)
    return moved + by_high * (up @ turn)[:, None] + by_deep * (down @ turn)[:, None] - np.outer(high, turn)
