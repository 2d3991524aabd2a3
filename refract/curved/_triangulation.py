"""Triangulation of a convex outline in x, y: the triangle of a point, and those that a ray passes.

A walk from triangle to triangle under the ray leads to where it first meets one; in numpy float64, the surface a
`HeightFieldWater` without gradients. scipy is imported where it is used: `import refract.curved` takes
half the time without it.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from refract import kernels
from refract._solvers import solver

# A point this far outside of a triangle, as part of the outline's size, is on its edge.
_ON_EDGE = 1e-12
# Rounding of a clearance [m], as part of its size.
_ROUNDING = 1e-12
# A leg that has this part of its length to go has arrived.
_ARRIVED = 1e-9


def cross(ax, ay, bx, by):
    """z component of the cross product of vectors in the plane."""
    return ax * by - ay * bx


class Triangulation:
    """Points in x, y and the triangles between them, turned counter-clockwise.

    Parameters
    ----------
    points : (points, 2) [m]
    triangles : (triangles, 3) int
        Together they fill the convex hull of the points, once.

    Raises
    ------
    ValueError
        If they do not, or a triangle has no area.
    """

    def __init__(self, points, triangles):
        from scipy.spatial import ConvexHull

        self.points = np.asarray(points, dtype=np.float64)
        triangles = np.array(triangles, dtype=np.int64)
        a, b, c = (self.points[triangles[:, k]] for k in range(3))
        area = 0.5 * cross(*(b - a).T, *(c - a).T)
        hull = ConvexHull(self.points)
        # In two dimensions scipy calls the area "volume". The sum of a million areas is good to 1e-10 of it.
        if not np.all(area != 0.0) or abs(np.abs(area).sum() - hull.volume) > 1e-9 * hull.volume:
            raise ValueError(
                f"expected triangles with area that fill the convex hull of the points ({hull.volume:.6g} m2) once, "
                f"got {np.abs(area).sum():.6g} m2 and a smallest triangle of {np.abs(area).min():.3g} m2; "
                "mark missing water by NaN heights instead of leaving triangles out"
            )
        triangles[area < 0.0] = triangles[area < 0.0][:, ::-1]
        self.triangles = triangles
        # A point is inside where n . p + d <= 0 for all of these.
        self.outline = hull.equations
        self.size = float(np.ptp(self.points, axis=0).max())

    @cached_property
    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Ends (edges, 2) of all edges, and the triangles (edges, 2) left and right of each; -1 outside."""
        first, second = self.triangles.ravel(), self.triangles[:, [1, 2, 0]].ravel()
        owner = np.repeat(np.arange(len(self.triangles)), 3)
        key = np.minimum(first, second) * len(self.points) + np.maximum(first, second)
        _, where, back, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
        sides = np.full((where.size, 2), -1)
        sides[:, 0] = owner[where]
        others = np.setdiff1d(np.arange(key.size), where)
        sides[back[others], 1] = owner[others]
        if count.max() > 2:
            raise ValueError("expected triangles that meet at most two at an edge, got three or more at one")
        return np.stack([first[where], second[where]], axis=-1), sides

    @cached_property
    def neighbours(self) -> np.ndarray:
        """(triangles, 3): the triangle across the edge from corner k to k + 1; -1 outside."""
        ends, sides = self.edges
        first, second = self.triangles, self.triangles[:, [1, 2, 0]]
        keys = np.minimum(ends[:, 0], ends[:, 1]) * len(self.points) + np.maximum(ends[:, 0], ends[:, 1])
        order = np.argsort(keys)
        own = np.minimum(first, second) * len(self.points) + np.maximum(first, second)
        both = sides[order[np.searchsorted(keys[order], own)]]
        own_number = np.arange(len(self.triangles))[:, None]
        return np.where(both[..., 0] == own_number, both[..., 1], both[..., 0])

    @cached_property
    def middles(self):
        """The centroids, in a cKDTree."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points[self.triangles].mean(axis=1))

    @cached_property
    def reach(self) -> float:
        """Largest distance of a corner from the centroid of its triangle [m]."""
        return float(np.linalg.norm(self.points[self.triangles] - self.middles.data[:, None], axis=-1).max())

    def offsets(self, triangle, x, y) -> np.ndarray:
        """Signed distances (..., 3) [m] of points from the edges of triangles, positive inside."""
        a = self.points[self.triangles[triangle]]
        edge = np.roll(a, -1, axis=-2) - a
        double_area = cross(edge[..., 0], edge[..., 1], x[..., None] - a[..., 0], y[..., None] - a[..., 1])
        return double_area / np.hypot(edge[..., 0], edge[..., 1])

    def locate(self, x, y) -> tuple[np.ndarray, np.ndarray]:
        """The triangle of each point (points,), and True where it holds it; outside, some triangle at the rim.

        A walk from the nearest centroid, each time through the edge that the point lies farthest beyond.
        """
        finite = np.isfinite(x) & np.isfinite(y)
        x, y = np.where(finite, x, self.points[0, 0]), np.where(finite, y, self.points[0, 1])
        triangle = self.middles.query(np.stack([x, y], axis=-1))[1]
        left = np.arange(x.size)
        inside = np.zeros(x.size, dtype=bool)
        for _ in range(len(self.triangles)):
            offset = self.offsets(triangle[left], x[left], y[left])
            inside[left] = offset.min(axis=-1) >= -_ON_EDGE * self.size
            across = self.neighbours[triangle[left], offset.argmin(axis=-1)]
            moves = ~inside[left] & (across >= 0)
            left = left[moves]
            if left.size == 0:
                break
            triangle[left] = across[moves]
        return triangle, inside & finite

    def span(self, x, y, dx, dy) -> tuple[np.ndarray, np.ndarray]:
        """Distances along rays where they enter and leave the outline; the first is larger where they miss it."""
        enter, leave = np.zeros(x.shape), np.full(x.shape, np.inf)
        for nx, ny, d in self.outline:
            over, rate = nx * x + ny * y + d, nx * dx + ny * dy
            t = -over / np.where(rate == 0.0, 1.0, rate)
            leave = np.where(rate > 0.0, np.minimum(leave, t), leave)
            enter = np.where(rate < 0.0, np.maximum(enter, t), enter)
            leave = np.where((rate == 0.0) & (over > 0.0), -1.0, leave)
        return enter, leave

    def exit(self, triangle, x, y, dx, dy) -> tuple[np.ndarray, np.ndarray]:
        """Distance at which rays leave a triangle, and the triangle behind; infinite for a ray without dx and dy."""
        a = self.points[self.triangles[triangle]]
        sides = np.roll(a, -1, axis=-2) - a
        over = cross(sides[..., 0], sides[..., 1], x[:, None] - a[..., 0], y[:, None] - a[..., 1])
        rate = cross(sides[..., 0], sides[..., 1], dx[:, None], dy[:, None])
        t = np.where(rate < 0.0, over / np.where(rate < 0.0, -rate, 1.0), np.inf)
        edge = t.argmin(axis=-1)
        rows = np.arange(edge.size)
        return t[rows, edge], np.where(np.isfinite(t[rows, edge]), self.neighbours[triangle, edge], -1)


@solver(outputs=2)
def triangle_at(surface, x, y):
    """The wet triangle at places x, y (...), any wet one where there is none there, and whether there is."""
    triangle, inside = surface.mesh.locate(x.ravel(), y.ravel())
    triangle = np.where(inside & surface.wet_triangles[triangle], triangle, -1).reshape(x.shape)
    return surface.or_any(triangle), triangle >= 0


@solver(outputs=2)
def triangle_met(surface, *ends):
    """The triangle where rays from above (...) first meet the surface, any wet one where none, and whether they do."""
    origin, direction = (tuple(c.ravel() for c in v) for v in (ends[:3], ends[3:]))
    triangle = first_triangle(surface, origin, direction, 1.0).reshape(ends[0].shape)
    return surface.or_any(triangle), triangle >= 0


def first_triangle(surface, origin, direction, side):
    """The triangle where rays from above (side 1) or below (-1) first meet the surface; -1 for none."""
    first = np.full(origin[0].shape, -1)
    wet = surface.plain_heights[surface.triangles[surface.wet_triangles]]
    level = wet.max() if side > 0.0 else wet.min()
    rise = side * direction[2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        start, end = surface.mesh.span(*origin[:2], *direction[:2])
        over = side * (origin[2] - level)
        start = np.maximum(start, np.where(over > 0.0, np.where(rise < 0.0, over / -rise, np.inf), 0.0))
        left = np.flatnonzero((start <= end) & np.isfinite(start))
        xy = tuple((o + start * d)[left] for o, d in zip(origin[:2], direction[:2], strict=True))
        triangle, _ = surface.mesh.locate(*xy)
        enters = np.ones(left.size, dtype=bool)
        t = start[left]
        for _ in range(len(surface.triangles)):
            o, d = (tuple(c[left] for c in v) for v in (origin, direction))
            leave, behind = surface.mesh.exit(triangle, *o[:2], *d[:2])
            leave = np.maximum(leave, t)
            corner, slopes = surface.planes(triangle, t)
            over, rate = (side * v for v in clearance(corner, slopes, o, d))
            hit = (over + np.where(np.isfinite(leave), leave, 0.0) * rate <= 0.0) & np.isfinite(leave)
            hit |= np.isinf(leave) & (rate < 0.0)
            # A ray that comes in from dry land below the level of the water never meets it from its own side.
            sunk = enters & (over + t * rate < -_ROUNDING * (1.0 + np.abs(over)))
            first[left[hit & ~sunk]] = triangle[hit & ~sunk]
            enters = ~surface.wet_triangles[triangle]
            active = ~hit & ~sunk & (behind >= 0)
            left, triangle, enters, t = left[active], behind[active], enters[active], leave[active]
            if left.size == 0:
                break
    return first


def clear(surface, camera, crossing, point):
    """True where neither leg meets the surface before the crossing."""
    clear = np.ones(crossing[0].shape, dtype=bool)
    for end, side in ((camera, 1.0), (point, -1.0)):
        leg = kernels.minus(crossing, end)
        length = np.sqrt(kernels.dot(leg, leg))
        flat = np.abs(leg[2]) <= surface._steepest * np.hypot(leg[0], leg[1])
        origin, direction = tuple(c[flat] for c in end), tuple((w / length)[flat] for w in leg)
        triangle = first_triangle(surface, origin, direction, side)
        corner, slopes = surface.planes(surface.or_any(triangle), origin[0])
        over, rate = clearance(corner, slopes, origin, direction)
        with np.errstate(divide="ignore", invalid="ignore"):
            first = np.where(triangle >= 0, -over / rate, np.inf)
        clear[flat] = first >= length[flat] * (1.0 - _ARRIVED)
    return clear


def clearance(corner, slopes, origin, direction):
    """Height [m] of the start of rays over planes, and its rate along the ray [-]."""
    over = origin[2] - corner[2] - slopes[0] * (origin[0] - corner[0]) - slopes[1] * (origin[1] - corner[1])
    return over, direction[2] - slopes[0] * direction[0] - slopes[1] * direction[1]
