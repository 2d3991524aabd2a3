"""Pixels at which a state of the adjustment predicts its tie points, and their derivatives by all parameters.

Seen from a camera C, a point P under water lies in the direction of the crossing S of its ray with the surface, where
the optical length a + n w is least (Fermat), a and w those of the legs:

    E^T (u_a + n u_w) = 0    with unit vectors u from C and from P to S, and tangents E (3, 2) of the surface

Its derivatives give those of S: ``E^T (A + n W) E`` is the Hessian of the length over x and y, with
``A = (I - u_a u_a^T) / a`` and W likewise.

Inside this file arrays have the N observations last, as (3, N), so that each operation runs along them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from refract import FlatWater, crossing_point
from survey.adjust.block.state import NUM_WATER, Layout, State, distort, distorted
from survey.photos.poses import TiePoints

# Four are exact to the last bits in drone geometry (docs/optics.md), two more for lower flights.
_NEWTON_STEPS = 6


def lines_of_sight(centres: np.ndarray, points: np.ndarray, water: FlatWater | None) -> np.ndarray:
    """Lines of sight (N, 3) [m], local, from cameras at centres (N, 3) to points (N, 3).

    To the crossing of the surface; to the point itself where the ray is straight.
    """
    crossing = points if water is None else crossing_point(points, centres, water, steps=_NEWTON_STEPS)
    return crossing - centres


@dataclass(frozen=True)
class Crossing:
    """Crossings of N bent rays with the plane of the water, and what derivatives of lines of sight are made of."""

    at: np.ndarray  # (3, N) [m], local
    of_gradient: np.ndarray  # (3, 2, N): E M^-1, how the crossing follows the gradient of the length, of Hessian M
    tangents: np.ndarray  # (3, 2): E
    air: np.ndarray  # (2, 3, N): E' A, of the derivatives of the unit vector of the leg in air
    water: np.ndarray  # (2, 3, N): n E' W
    up: np.ndarray  # (2, N): E' u_w
    lift: np.ndarray  # (N,): vertical component of u_a + n u_w

    @classmethod
    def of(cls, line: np.ndarray, centres: np.ndarray, points: np.ndarray, water: FlatWater) -> Crossing:
        """Of lines of sight (3, N) [m], local, from centres to points (3, N), all of them bent."""
        tangents = np.array([[1.0, 0.0], [0.0, 1.0], [water.slope_x, water.slope_y]])
        at = centres + line
        (down, air), (up, wet) = (_unit_along(tangents, leg) for leg in (line, at - points))
        wet *= water.n_water
        (xx, xy), (_, yy) = np.einsum("ajn,jb->abn", air + wet, tangents)
        inverse = np.array([[yy, -xy], [-xy, xx]]) / (xx * yy - xy * xy)
        of_gradient = np.einsum("ia,abn->ibn", tangents, inverse)
        return cls(at, of_gradient, tangents, air, wet, tangents.T @ up, down[2] + water.n_water * up[2])

    def by_point(self) -> np.ndarray:
        """Derivatives (3, 3, N) of the line of sight by the point."""
        return _product(self.of_gradient, self.water)

    def by_centre(self) -> np.ndarray:
        """By the centre of the camera, (3, 3, N)."""
        return _product(self.of_gradient, self.air) - np.eye(3)[:, :, None]

    def by_water(self, water: FlatWater) -> np.ndarray:
        """By the height of the plane at its reference point, its slopes and its index, (3, 4, N)."""
        by_height = -np.einsum("ian,an->in", self.of_gradient, self.air[:, 2] + self.water[:, 2])
        by_height[2] += 1.0
        # A slope raises the surface by its distance from the reference point, and turns its tangent.
        by_slopes = (
            by_height * (self.at[axis] - water.point[axis]) - self.of_gradient[:, axis] * self.lift for axis in (0, 1)
        )
        by_index = -np.einsum("ian,an->in", self.of_gradient, self.up)
        return np.stack([by_height, *by_slopes, by_index], axis=1)


def _unit_along(tangents: np.ndarray, leg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (3, N) of legs (3, N), and the part of their derivatives along tangents (3, 2), (2, 3, N)."""
    length = np.sqrt(np.sum(leg * leg, axis=0))
    unit = leg / length
    return unit, (tangents.T[:, :, None] - (tangents.T @ unit)[:, None] * unit) / length


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Products (a, b, N) of matrices (a, i, N) and (i, b, N)."""
    return np.einsum("ain,ibn->abn", first, second)


@dataclass(frozen=True)
class Prediction:
    """Predicted pixels with their derivatives."""

    pixels: np.ndarray  # (N, 2) [px]
    by_point: np.ndarray  # (N, 2, 3)
    by_parameters: np.ndarray  # (N, 2, K): by the parameters of its photograph, see `Layout.columns`


def predict(
    layout: Layout, state: State, ties: TiePoints, rise_design: np.ndarray, rows: np.ndarray | None = None
) -> np.ndarray:
    """Predicted pixels (N, 2); NaN where a point lies behind its camera.

    ``rise_design`` (N, 3) is as of `apparent_rise_design`; ``rows`` (N,) [px] are those of the photographs as they were
    taken, for rolling shutters, by default those of the tie points.
    """
    rays = _Rays(layout, state, ties, rise_design, rows)
    return rays.pixels(distorted(rays.xy, rays.distortion))


def linearise_by_points(
    layout: Layout, state: State, ties: TiePoints, rise_design: np.ndarray, rows: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Predicted pixels (N, 2) and their derivatives by the points alone, (N, 2, 3); see `predict`."""
    seen = _Derivatives(_Rays(layout, state, ties, rise_design, rows), state.water)
    return seen.rays.pixels(seen.distorted_xy), np.moveaxis(seen.by_point(), -1, 0)


def linearise(
    layout: Layout, state: State, ties: TiePoints, rise_design: np.ndarray, rows: np.ndarray | None = None
) -> Prediction:
    """Predicted pixels with their derivatives; see `predict`."""
    rays = _Rays(layout, state, ties, rise_design, rows)
    seen = _Derivatives(rays, state.water)
    by_point, by_centre, by_water = seen.by_point(), seen.by_centre(), seen.by_water(state.water)
    by_lens, by_readout = seen.by_lens(), np.zeros((2, 0, len(ties.view)))
    if layout.velocity_per_row is not None:
        late, readouts = _rows_after_pose(layout, state, ties, rows)
        by_velocity = np.einsum("ain,in->an", by_centre, np.take(layout.velocity_per_row.T, ties.view, axis=-1))
        # The pose is that at the row `cy`.
        by_lens[:, 2] -= readouts * by_velocity
        if layout.finds_readouts:
            by_readout = (late * by_velocity)[:, None]
    # A tide raises the water of its photograph as a higher level does.
    by_rate = by_water[:, :0] if layout.hours is None else by_water[:, :1] * layout.hours[ties.view]
    by_focal = by_lens[:, :1] * (rays.of_lens / rays.enlarged) if layout.finds_focals else by_lens[:, :0]
    x, y, z = rays.in_cam
    by_x, by_y, by_z = np.moveaxis(seen.by_cam, 1, 0)
    by_turn = np.stack([by_z * y - by_y * z, by_x * z - by_z * x, by_y * x - by_x * y], axis=1)
    parts = by_water, by_point[:, 2:] * rise_design.T, by_lens, by_readout, by_rate, by_focal, by_centre, by_turn
    by_parameters = np.empty((len(ties.view), 2, sum(part.shape[1] for part in parts)))
    np.concatenate([part.transpose(2, 0, 1) for part in parts], axis=2, out=by_parameters)
    return Prediction(rays.pixels(seen.distorted_xy), np.moveaxis(by_point, -1, 0), by_parameters)


def design_matrix(layout: Layout, view: np.ndarray, by_parameters: np.ndarray) -> csr_array:
    """Derivatives (N, 2, K) of observations in photographs (N,) by all parameters, (2 N, P)."""
    columns = np.repeat(layout.columns[view], 2, axis=0)
    ends = np.arange(len(columns) + 1) * columns.shape[1]
    return csr_array((by_parameters.ravel(), columns.ravel(), ends), shape=(len(columns), len(layout)))


def apparent_rise_design(state: State, ties: TiePoints) -> np.ndarray:
    """Derivatives (N, 3) of point heights by the apparent rise of a rough bed: t^2 from all sides, t_east, t_north.

    t is the tangent of the leg at the bed to the vertical. Hollows of a rough bed hide from oblique views, and the bed
    looks different from each side; both seem to lift it (docs/adjustment.md). The angles hardly change in an adjustment
    and are taken from its start.
    """
    points, centres = state.points[ties.point], state.centres[ties.view]
    crossing = lines_of_sight(centres, points, state.water) + centres
    leg = crossing - points
    leg = np.where((leg[:, 2] > 1e-9)[:, None], leg, centres - points)
    tangent = leg[:, :2] / leg[:, 2:]
    return np.column_stack([np.sum(tangent**2, axis=1), tangent])


class _Rays:
    """Lines of sight of N observations, in cam, with the lenses that see them."""

    def __init__(self, layout: Layout, state: State, ties: TiePoints, rise_design: np.ndarray, rows: np.ndarray | None):
        number = layout.lens_of[ties.view]
        self.of_lens, *others = np.take(state.lenses.T, number, axis=1)  # (N,) [px]: focal length of the lens along x
        self.middle, self.distortion = np.split(np.array(others), [2])  # (2, N) [px], (5, N)
        one = np.ones(len(number))
        # (N,): focal length of the photograph over that of the lens; (2, N): that along x and y over that along x
        self.enlarged = one + state.focals[ties.view] if len(state.focals) else one
        self.aspect = np.stack([one, layout.aspect[number]])
        self.focal = self.aspect * (self.of_lens * self.enlarged)  # (2, N) [px]
        self.ends = _ends(layout, state, ties, rise_design, rows)
        self.line = np.ascontiguousarray(lines_of_sight(*self.ends, state.water).T)  # (3, N) [m], local
        rotations = np.ascontiguousarray(np.moveaxis(state.rotations, 0, -1))
        self.rotations = np.take(rotations, ties.view, axis=-1)  # (3, 3, N)
        self.in_cam = np.einsum("ijn,jn->in", self.rotations, self.line)
        # Where they meet the plane at depth 1; NaN behind the camera.
        self.depth = np.where(self.in_cam[2] > 0.0, self.in_cam[2], np.nan)
        self.xy = self.in_cam[:2] / self.depth

    def pixels(self, distorted_xy: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of distorted coordinates (2, N)."""
        return (distorted_xy * self.focal + self.middle).T


class _Derivatives:
    """Derivatives of the pixels of rays, (2, K, N) by K unknowns."""

    def __init__(self, rays: _Rays, water: FlatWater | None):
        self.rays, self.num = rays, rays.line.shape[1]
        self.distorted_xy, by_xy, self.by_coefficients = distort(rays.xy, rays.distortion)
        by_plane = rays.focal[:, None] * by_xy / rays.depth
        # By the lines of sight, in cam and in local.
        self.by_cam = np.concatenate([by_plane, -np.einsum("ain,in->an", by_plane, rays.xy)[:, None]], axis=1)
        self.by_line = _product(self.by_cam, rays.rotations)
        self.wet, self.crossing = np.zeros(0, dtype=np.int64), None
        if water is not None:
            over, under = (water.depth(end) for end in rays.ends)
            self.wet = np.flatnonzero((under > 0.0) & (over < 0.0))
            line, centres, points = (np.take(a, self.wet, axis=-1) for a in (rays.line, rays.ends[0].T, rays.ends[1].T))
            self.crossing = Crossing.of(line, centres, points, water)

    def _through(self, found: np.ndarray, by_unknown: np.ndarray) -> np.ndarray:
        """Derivatives of straight rays, with those of bent ones by what moves their line of sight, (3, K, W)."""
        found[..., self.wet] = _product(np.take(self.by_line, self.wet, axis=-1), by_unknown)
        return found

    def by_point(self) -> np.ndarray:
        straight = self.by_line.copy()
        return straight if self.crossing is None else self._through(straight, self.crossing.by_point())

    def by_centre(self) -> np.ndarray:
        straight = -self.by_line
        return straight if self.crossing is None else self._through(straight, self.crossing.by_centre())

    def by_water(self, water: FlatWater | None) -> np.ndarray:
        dry = np.zeros((2, NUM_WATER, self.num))
        return dry if self.crossing is None or water is None else self._through(dry, self.crossing.by_water(water))

    def by_lens(self) -> np.ndarray:
        by_focal = self.distorted_xy * self.rays.aspect * self.rays.enlarged
        by_middle = np.broadcast_to(np.eye(2)[:, :, None], (2, 2, self.num))
        return np.concatenate([by_focal[:, None], by_middle, self.rays.focal[:, None] * self.by_coefficients], axis=1)


def _ends(
    layout: Layout, state: State, ties: TiePoints, rise_design: np.ndarray, rows: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Cameras and points (N, 3) each, lowered by the tide and by the departure of the water from its plane there."""
    centres, points = state.centres[ties.view], state.points[ties.point]
    points[:, 2] += rise_design @ state.relief
    if layout.velocity_per_row is not None:
        late, readouts = _rows_after_pose(layout, state, ties, rows)
        centres = centres + (readouts * late)[:, None] * layout.velocity_per_row[ties.view]
    tides = state.tides(layout)
    if (tides is None and layout.departure is None) or state.water is None:
        return centres, points
    down = np.zeros_like(points)
    if tides is not None:
        down[:, 2] = tides[ties.view]
    if layout.departure is not None:
        down[:, 2] += layout.departure(_near_crossing(centres, points, state.water))
    return centres - down, points - down


def _near_crossing(centres: np.ndarray, points: np.ndarray, water: FlatWater) -> np.ndarray:
    """Places (N, 2) near those where rays cross the water: exact straight down, where tan a is n tan b."""
    deep = np.maximum(water.depth(points), 0.0) / water.n_water
    share = deep / (deep + np.maximum(-water.depth(centres), 1e-9))
    return points[:, :2] + share[:, None] * (centres - points)[:, :2]


def _rows_after_pose(
    layout: Layout, state: State, ties: TiePoints, rows: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (N,) after the row `cy` at which observations are exposed, and readouts (N,) of their photographs."""
    number = layout.lens_of[ties.view]
    rows = ties.pixel[:, 1] if rows is None else rows
    return rows - state.lenses[number, 2], state.readouts[number]
