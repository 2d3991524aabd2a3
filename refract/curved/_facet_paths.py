"""Projection through plane triangles: all locally shortest paths, exact and counted.

Over one plane the optical length is convex, so each triangle has one shortest path, in closed form through its plane;
it counts where it lies inside the triangle. Between triangles the length has a kink. At a ridge both sides lead away
from it; at a trough, where the bed has a strip that no ray of either side reaches, the edge itself or a corner may be
the shortest way: it represents the rays that a rounded trough would send there, and counts as well.

Only triangles that reach into the disc of `refract.curved._disc.search_disc` are examined. All in numpy float64; torch
gets the gradients of the plane that was found, and none on an edge, where the derivative jumps.
"""

from __future__ import annotations

import math

import numpy as np

from refract import kernels
from refract._array import namespace
from refract._numbers import read
from refract._solvers import solver
from refract.curved import _triangulation, fermat
from refract.curved._disc import search_disc

# A crossing this near an edge [m] belongs to both sides; found twice, it counts once.
_ON_EDGE = 1e-11
_SAME = 1e-9
# Pairs of points and triangles at a time: some 40 arrays of them, 100 MB.
_PAIRS = 300_000
_FLAT_STEPS = 4


def crossing(surface, camera, point):
    """`refract.surfaces.WaterSurface.crossing` of a `HeightFieldWater`; NaN and 0 where there is no path."""
    camera, point = fermat.together(camera, point)
    xp = namespace(*point)
    depth = surface.height(point[0], point[1]) - point[2]
    over = camera[2] - surface.height(camera[0], camera[1])
    bent = (depth > 0.0) & ~(over <= kernels.CONTACT)  # a camera beside the water, where it has no height, is over it
    x, y, z, count, triangle, inside = read(shortest_path, surface, (*camera, *point, depth, xp.like(bent, depth)))
    at = x, y, z
    if xp.name == "torch":
        exact = _through(surface, triangle.long(), camera, point, inside > 0.0)
        at = tuple(xp.where(inside > 0.0, e, c) for e, c in zip(exact, at, strict=True))
    seen = tuple(xp.where(bent, a, p) for a, p in zip(at, point, strict=True))
    return seen, depth, xp.where(bent, xp.integer(count), 1)


@solver(outputs=6)
def shortest_path(surface, *arrays):
    """Crossing x, y, z, number of paths, a triangle, and whether the shortest leads through its inside.

    In numpy, of arrays as `refract.curved.fermat.located` takes them; NaN and 0 where not bent.
    """
    *ends, depth, bent = (array.ravel() for array in arrays)
    wet = bent != 0.0
    camera, point = (tuple(c[wet] for c in end) for end in (ends[:3], ends[3:]))
    results = [np.full(wet.shape, fill) for fill in (math.nan, math.nan, math.nan, 0, -1)]
    for array, values in zip(results, _found(surface, camera, point, depth[wet]), strict=True):
        array[wet] = values
    *at, triangle = (array.reshape(arrays[0].shape) for array in results)
    return *at, surface.or_any(triangle), triangle >= 0


def _through(surface, triangle, camera, point, some):
    """The crossing through the planes of triangles, with gradients; finite placeholders where there is no path."""
    xp = namespace(*camera)
    corner, (slope_x, slope_y) = surface.planes(triangle, camera[0])
    up = 1.0 / xp.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
    normal = -slope_x * up, -slope_y * up, up
    camera, point = (
        tuple(xp.where(some, c, q + shift) for c, q, shift in zip(end, corner, (0.0, 0.0, side), strict=True))
        for end, side in ((camera, 1.0), (point, -1.0))
    )
    plane = kernels.WaterPlane(corner, normal, surface.n_water)
    return kernels.crossing_of_point(camera, point, plane, _FLAT_STEPS)[0]


def _found(surface, camera, point, depth):
    """Crossing x, y, z, number of paths, and triangle (-1 on an edge) of each point; in chunks of pairs."""
    results = [np.full(depth.size, fill) for fill in (math.nan, math.nan, math.nan, 0, -1)]
    if depth.size == 0:
        return results
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # an infinite disc is cut to all triangles
        disc = search_disc(surface, camera, point, depth)
    mesh = surface.mesh
    middle = np.stack([disc.x, disc.y], axis=-1)
    radius = np.where(np.isfinite(disc.radius), disc.radius, 2.0 * mesh.size) + mesh.reach
    near = mesh.middles.query_ball_point(middle, radius, return_length=True)
    part = np.cumsum(near) // _PAIRS
    for number in np.unique(part):
        members = np.flatnonzero(part == number)
        lists = mesh.middles.query_ball_point(middle[members], radius[members])
        owner = np.repeat(np.arange(members.size), near[members])
        triangle = np.concatenate([np.asarray(found, dtype=np.int64) for found in lists])
        wet = surface.wet_triangles[triangle]
        ends = tuple(c[members] for c in camera), tuple(p[members] for p in point)
        for array, values in zip(results, _shortest(surface, *ends, owner[wet], triangle[wet]), strict=True):
            array[members] = values
    return results


def _shortest(surface, camera, point, owner, triangle):
    """The shortest of all local paths of each point, as in `_found`."""
    paths = [
        _in_triangles(surface, camera, point, owner, triangle),
        _on_edges(surface, camera, point, owner, triangle),
        _on_corners(surface, camera, point, owner, triangle),
    ]
    owner, x, y, z, triangle = (np.concatenate(parts) for parts in zip(*paths, strict=True))
    ends = tuple(c[owner] for c in camera), tuple(p[owner] for p in point)
    clear = _triangulation.clear(surface, ends[0], (x, y, z), ends[1])
    owner, x, y, z, triangle = (a[clear] for a in (owner, x, y, z, triangle))
    to_camera, to_point = (kernels.minus(tuple(c[owner] for c in end), (x, y, z)) for end in (camera, point))
    length = np.sqrt(kernels.dot(to_camera, to_camera)) + surface.n_water * np.sqrt(kernels.dot(to_point, to_point))
    # Sorted by point and place, paths that two triangles share are adjacent; a triangle precedes an edge.
    order = np.lexsort((-triangle, np.round(y / _SAME), np.round(x / _SAME), owner))
    owner, x, y, z, triangle, length = (a[order] for a in (owner, x, y, z, triangle, length))
    is_duplicate = (np.diff(owner) == 0) & (np.hypot(np.diff(x), np.diff(y)) < _SAME)
    keep = np.concatenate([np.ones(min(owner.size, 1), dtype=bool), ~is_duplicate])
    owner, x, y, z, triangle, length = (a[keep] for a in (owner, x, y, z, triangle, length))
    order = np.lexsort((length, owner))
    first = order[np.unique(owner[order], return_index=True)[1]]
    size = camera[0].size
    best = [np.full(size, math.nan) for _ in range(3)]
    which = np.full(size, -1)
    for array, values in zip((*best, which), (x, y, z, triangle), strict=True):
        array[owner[first]] = values[first]
    return *best, np.bincount(owner, minlength=size), which


def _in_triangles(surface, camera, point, owner, triangle):
    """Paths through the insides of triangles: where that through their plane falls inside."""
    camera, point = tuple(c[owner] for c in camera), tuple(p[owner] for p in point)
    (x, y, z), (slope_x, slope_y) = surface.planes(triangle, camera[0])
    over, under = (end[2] - z - slope_x * (end[0] - x) - slope_y * (end[1] - y) for end in (camera, point))
    at = _through(surface, triangle, camera, point, triangle >= 0)
    inside = (surface.mesh.offsets(triangle, *at[:2]).min(axis=-1) >= -_ON_EDGE) & (over > 0.0) & (under < 0.0)
    return tuple(a[inside] for a in (owner, *at, triangle))


def _gradient(n, camera, point, at):
    """Sum of the unit vectors from both ends, that from the point n times: the slope of the optical length."""
    from_camera, from_point = kernels.minus(at, camera), kernels.minus(at, point)
    a, w = (np.sqrt(kernels.dot(v, v)) for v in (from_camera, from_point))
    return tuple(c / a + n * p / w for c, p in zip(from_camera, from_point, strict=True))


def _on_edges(surface, camera, point, owner, triangle):
    """Paths through edges in troughs: shortest along the edge, and not shorter into either side.

    Turned about the edge into one plane, camera and point lie as over flat water: their distances from the edge
    are height and depth.
    """
    kinks = surface.kinks
    owner, edge = _pairs(owner, kinks.trough[triangle])
    camera, point = tuple(c[owner] for c in camera), tuple(p[owner] for p in point)
    start, unit = (tuple(c[edge] for c in v) for v in (kinks.start, kinks.unit))
    along, distances = [], []
    for end in (camera, point):
        from_start = kernels.minus(end, start)
        along.append(kernels.dot(from_start, unit))
        distances.append(np.sqrt(np.maximum(kernels.dot(from_start, from_start) - along[-1] ** 2, 0.0)))
    run = along[1] - along[0]
    H, h = distances
    tau = along[0] + run * kernels.air_share(run * run, H, h, surface.n_water, _FLAT_STEPS)
    at = kernels.point_at_distance(start, unit, tau)
    gradient = _gradient(surface.n_water, camera, point, at)
    keep = (tau >= 0.0) & (tau <= kinks.length[edge])
    for side in kinks.sides:
        keep &= kernels.dot(gradient, tuple(c[edge] for c in side)) >= 0.0
    return tuple(a[keep] for a in (owner, *at, np.full(owner.size, -1)))


def _on_corners(surface, camera, point, owner, triangle):
    """Paths through corners: not shorter along any edge that ends there."""
    kinks = surface.kinks
    corners = surface.triangles[triangle]
    owner, corner = _pairs(owner, np.where(kinks.inner[corners], corners, -1))
    at = (*surface.points[corner].T, surface.plain_heights[corner])
    gradient = _gradient(surface.n_water, tuple(c[owner] for c in camera), tuple(p[owner] for p in point), at)
    keep = np.ones(owner.size, dtype=bool)
    for number in range(kinks.spokes_of.shape[1]):
        spoke = kinks.spokes_of[corner, number]
        keep &= (spoke < 0) | (kernels.dot(gradient, tuple(c[spoke] for c in kinks.spokes)) >= 0.0)
    return tuple(a[keep] for a in (owner, *at, np.full(owner.size, -1)))


def _pairs(owner, parts):
    """The distinct pairs of an owner and one of its parts (pairs, 3), less those that are -1."""
    pairs = np.stack([np.repeat(owner, 3), parts.ravel()], axis=-1)
    pairs = np.unique(pairs[pairs[:, 1] >= 0], axis=0)
    return pairs[:, 0], pairs[:, 1]


class Kinks:
    """Edges in troughs and inner corners of a surface.

    Attributes
    ----------
    trough : (triangles, 3) int
        Indices of the edges of each triangle that lie in a trough, into the arrays below; -1 for the others.
    start, unit : triples of (edges,) [m], unit
        Where the edges begin, and their directions.
    length : (edges,) [m]
    sides : two triples of (edges,) [m]
        Across each edge, in the planes of its two triangles and into them.
    inner : (points,) bool
        Corners with water all around.
    spokes : triple of (spokes,) unit
        Directions of all edges, from both ends.
    spokes_of : (points, most) int
        Those that leave each corner; filled up with -1.
    """

    def __init__(self, surface):
        place = np.column_stack([surface.points, surface.plain_heights])
        ends, sides = surface.mesh.edges
        wet = np.append(surface.wet_triangles, False)[sides].all(axis=-1)  # False for -1, outside
        self._collect_troughs(surface, place, ends, sides, wet)
        self.inner = np.isfinite(surface.plain_heights)
        self.inner[ends[~wet].ravel()] = False
        self._collect_spokes(place, ends)

    def _collect_troughs(self, surface, place, ends, sides, wet):
        """A trough: the far corner of one side lies above the plane of the other, by more than rounding."""
        edge = np.flatnonzero(wet)
        ends, sides = ends[edge], sides[edge]
        start, unit = place[ends[:, 0]], place[ends[:, 1]] - place[ends[:, 0]]
        length = np.linalg.norm(unit, axis=-1)
        unit = unit / length[:, None]
        corners = surface.triangles[sides]
        far = corners.sum(axis=-1) - ends.sum(axis=-1)[:, None]  # of three corners, the one that is not on the edge
        across = place[far] - start[:, None]
        across = across - (across @ unit[..., None]) * unit[:, None]
        normal = np.cross(unit, across[:, 0])
        normal *= np.sign(normal[:, 2:])
        lift = np.sum(normal * across[:, 1], axis=-1)
        trough = lift > 1e-12 * np.linalg.norm(across[:, 0], axis=-1) * np.linalg.norm(across[:, 1], axis=-1)
        self.start, self.unit, self.length = start[trough].T, unit[trough].T, length[trough]
        self.sides = tuple(across[trough].transpose(1, 2, 0))
        self.trough = np.full((len(surface.triangles), 3), -1)
        for side in range(2):
            own = sides[trough, side]
            # The edge from corner k to k + 1 lies opposite corner k + 2.
            opposite = (surface.triangles[own] == far[trough, side, None]).argmax(axis=-1)
            self.trough[own, (opposite + 1) % 3] = np.arange(own.size)

    def _collect_spokes(self, place, ends):
        source, target = np.concatenate([ends, ends[:, ::-1]]).T
        order = np.argsort(source, kind="stable")
        source, target = source[order], target[order]
        vector = place[target] - place[source]
        self.spokes = (vector / np.linalg.norm(vector, axis=-1, keepdims=True)).T
        count = np.bincount(source, minlength=len(place))
        self.spokes_of = np.full((len(place), count.max()), -1)
        self.spokes_of[source, np.arange(source.size) - np.repeat(np.cumsum(count) - count, count)] = np.arange(
            source.size
        )
