"""Pixels at which a state of the adjustment predicts its tie points, and their derivatives by all parameters.

Seen from a camera C, a point P under water lies in the direction of the crossing S of its ray with the surface, where
the optical length a + n w is least (Fermat), a and w those of the legs:

    E^T (u_a + n u_w) = 0    with unit vectors u from C and from P to S, and tangents E (3, 2) of the surface

Its derivatives give those of S: ``E^T (A + n W) E`` is the Hessian of the length over x and y, with
``A = (I - u_a u_a^T) / a`` and W likewise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from refract import FlatWater, crossing_point
from survey.adjust.block.state import NUM_LENS, NUM_POSE, NUM_RELIEF, NUM_WATER, Layout, State, distort, distorted
from survey.photos.poses import TiePoints

# Four are exact to the last bits in drone geometry (docs/optics.md), two more for lower flights.
_NEWTON_STEPS = 6


@dataclass(frozen=True)
class LinesOfSight:
    """Lines of sight from N cameras to N points."""

    # (N, 3) [m], local: from the camera to the crossing of the surface; to the point itself where the ray is straight
    line: np.ndarray
    # by_point, by_centre (N, 3, 3): derivatives by the point and by the centre of the camera
    by_point: np.ndarray
    by_centre: np.ndarray
    # (N, 3, 4): by the height of the plane at its reference point [m], its slopes along local x and y, and its index
    by_water: np.ndarray
    wet: np.ndarray  # (N,) bool


def lines_of_sight(centres: np.ndarray, points: np.ndarray, water: FlatWater | None) -> np.ndarray:
    """Lines of sight (N, 3) from centres (N, 3) to points (N, 3) [m], local; see `LinesOfSight`."""
    return crossing_point(points, centres, water, steps=_NEWTON_STEPS) - centres


def bent_lines_of_sight(centres: np.ndarray, points: np.ndarray, water: FlatWater | None) -> LinesOfSight:
    """Lines of sight from centres (N, 3) to points (N, 3) [m], local, with their derivatives."""
    line = lines_of_sight(centres, points, water)
    by_point = np.tile(np.eye(3), (len(line), 1, 1))
    by_centre, by_water = -by_point, np.zeros((len(line), 3, 4))
    wet = _is_wet(centres, points, water)
    if water is not None:
        crossing = _Crossing.of(line[wet], centres[wet], points[wet], water)
        by_point[wet], by_centre[wet] = crossing.by_point(), crossing.by_centre()
        by_water[wet] = crossing.by_water(water)
    return LinesOfSight(line, by_point, by_centre, by_water, wet)


def _is_wet(centres: np.ndarray, points: np.ndarray, water: FlatWater | None) -> np.ndarray:
    """Which rays (N,) pass through water."""
    if water is None:
        return np.zeros(len(points), dtype=bool)
    return (water.depth(points) > 0.0) & (water.depth(centres) < 0.0)


@dataclass(frozen=True)
class _Crossing:
    """Crossings of N bent rays with the plane of the water, and what their derivatives are made of."""

    at: np.ndarray  # (N, 3) [m], local
    of_gradient: np.ndarray  # (N, 3, 2): E M^-1, how the crossing follows the gradient of the length, of Hessian M
    tangents: np.ndarray  # (3, 2): E
    air: np.ndarray  # (N, 3, 3): A, the derivatives of the unit vector of the leg in air
    water: np.ndarray  # (N, 3, 3): n W
    up: np.ndarray  # (N, 3): u_w
    lift: np.ndarray  # (N,): vertical component of u_a + n u_w

    @classmethod
    def of(cls, line: np.ndarray, centres: np.ndarray, points: np.ndarray, water: FlatWater) -> _Crossing:
        """Of lines of sight (N, 3) [m], local, from centres to points (N, 3), all of them bent."""
        tangents = np.array([[1.0, 0.0], [0.0, 1.0], [water.slope_x, water.slope_y]])
        at = centres + line
        (down, air), (up, wet) = (_unit_with_derivatives(leg) for leg in (line, at - points))
        wet *= water.n_water
        (xx, xy), (_, yy) = np.moveaxis(tangents.T @ (air + wet) @ tangents, 0, -1)
        inverse = np.array([[yy, -xy], [-xy, xx]]) / (xx * yy - xy * xy)
        of_gradient = tangents @ np.moveaxis(inverse, -1, 0)
        return cls(at, of_gradient, tangents, air, wet, up, down[:, 2] + water.n_water * up[:, 2])

    def by_point(self) -> np.ndarray:
        """Derivatives of the line of sight by the point, (N, 3, 3)."""
        return self.of_gradient @ (self.tangents.T @ self.water)

    def by_centre(self) -> np.ndarray:
        """By the centre of the camera, (N, 3, 3)."""
        return self.of_gradient @ (self.tangents.T @ self.air) - np.eye(3)

    def by_water(self, water: FlatWater) -> np.ndarray:
        """By the height of the plane at its reference point, its slopes and its index, (N, 3, 4)."""
        pushed = (self.air[:, :, 2] + self.water[:, :, 2]) @ self.tangents
        by_height = np.array([0.0, 0.0, 1.0]) - np.einsum("nij,nj->ni", self.of_gradient, pushed)
        offset = self.at - np.array(water.point)
        # A slope raises the surface by its distance from the reference point, and turns its tangent.
        by_slopes = (
            by_height * offset[:, axis, None] - self.of_gradient[:, :, axis] * self.lift[:, None] for axis in (0, 1)
        )
        by_index = -np.einsum("nij,nj->ni", self.of_gradient, self.up @ self.tangents)
        return np.stack([by_height, *by_slopes, by_index], axis=-1)


def _unit_with_derivatives(leg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (N, 3) of legs (N, 3), and their derivatives (N, 3, 3)."""
    length = np.linalg.norm(leg, axis=1)
    unit = leg / length[:, None]
    return unit, (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / length[:, None, None]


@dataclass(frozen=True)
class Prediction:
    """Predicted pixels with their derivatives."""

    pixels: np.ndarray  # (N, 2) [px]
    by_point: np.ndarray  # (N, 2, 3)
    by_parameters: csr_array  # (2 N, P) sparse
    wet: np.ndarray  # (N,) bool: which rays pass through water


def predict(
    layout: Layout, state: State, ties: TiePoints, rise_design: np.ndarray, rows: np.ndarray | None = None
) -> np.ndarray:
    """Predicted pixels (N, 2); NaN where a point lies behind its camera.

    Parameters
    ----------
    rise_design : (N, 3)
        As `apparent_rise_design` gives them.
    rows : (N,) [px], optional
        Of the photographs as they were taken, for rolling shutters; default those of the tie points.
    """
    line = lines_of_sight(*_ends(layout, state, ties, rise_design, rows), state.water)
    xy, _ = _at_unit_depth(_in_cam(state, ties, line))
    return _pixels(layout, state, ties, distorted(xy, state.lenses[layout.lens_of[ties.view], 3:]))


def linearise_by_points(
    layout: Layout, state: State, ties: TiePoints, rise_design: np.ndarray, rows: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Predicted pixels (N, 2) and their derivatives by the points alone, (N, 2, 3); see `predict`."""
    centres, points = _ends(layout, state, ties, rise_design, rows)
    line = lines_of_sight(centres, points, state.water)
    imaged = _project(layout, state, ties, line)
    by_points = imaged.by_line(state, ties)
    wet = _is_wet(centres, points, state.water)
    if state.water is not None and wet.any():
        crossing = _Crossing.of(line[wet], centres[wet], points[wet], state.water)
        by_points[wet] = by_points[wet] @ crossing.by_point()
    return imaged.pixels, by_points


def linearise(
    layout: Layout, state: State, ties: TiePoints, rise_design: np.ndarray, rows: np.ndarray | None = None
) -> Prediction:
    """Predicted pixels with their derivatives; see `predict`."""
    lines = bent_lines_of_sight(*_ends(layout, state, ties, rise_design, rows), state.water)
    imaged = _project(layout, state, ties, lines.line)
    by_line = imaged.by_line(state, ties)
    by_point = by_line @ lines.by_point
    by_centre, by_lens = by_line @ lines.by_centre, imaged.by_lens(layout, state, ties)
    by_readout = np.zeros((len(by_lens), 2, 0))
    if layout.velocity_per_row is not None:
        by_middle, by_readout = _shutter_derivatives(layout, state, ties, rows, by_centre)
        by_lens[:, :, 2] += by_middle
    by_water = by_line @ lines.by_water
    # A tide raises the water of its photograph as a higher level does.
    by_rate = (
        by_water[:, :, :0] if layout.hours is None else by_water[:, :, :1] * layout.hours[ties.view][:, None, None]
    )
    by_focal = by_lens[:, :, :0]
    if layout.finds_focals:
        of_lens = state.lenses[layout.lens_of[ties.view], 0]
        by_focal = by_lens[:, :, :1] * (of_lens / _enlarged(state, ties))[:, None, None]
    dense = np.concatenate(
        [
            by_water,
            by_point[:, :, 2, None] * rise_design[:, None, :],
            by_lens,
            by_readout,
            by_rate,
            by_focal,
            by_centre,
            -imaged.by_cam @ _cross(imaged.in_cam),
        ],
        axis=-1,
    )
    return Prediction(imaged.pixels, by_point, _assemble_derivatives(layout, ties, dense), lines.wet)


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


def _ends(
    layout: Layout, state: State, ties: TiePoints, rise_design: np.ndarray, rows: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Cameras and points (N, 3) each, lowered by the tide and by the departure of the water from its plane there."""
    centres, points = _centres(layout, state, ties, rows), _points_of_observations(state, ties, rise_design)
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


def _centres(layout: Layout, state: State, ties: TiePoints, rows: np.ndarray | None) -> np.ndarray:
    """Camera centres (N, 3) at the exposure of the observed rows; a pose is that at the row `cy`."""
    centres = state.centres[ties.view]
    if layout.velocity_per_row is None:
        return centres
    late, readouts = _rows_after_pose(layout, state, ties, rows)
    return centres + (readouts * late)[:, None] * layout.velocity_per_row[ties.view]


def _rows_after_pose(
    layout: Layout, state: State, ties: TiePoints, rows: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (N,) after the row `cy` at which observations are exposed, and readouts (N,) of their photographs."""
    number = layout.lens_of[ties.view]
    rows = ties.pixel[:, 1] if rows is None else rows
    return rows - state.lenses[number, 2], state.readouts[number]


def _shutter_derivatives(layout: Layout, state: State, ties: TiePoints, rows: np.ndarray | None, by_centre: np.ndarray):
    """Derivatives of a rolling shutter: by `cy` as the row of the pose (N, 2), and by the readout (N, 2, 0 or 1)."""
    assert layout.velocity_per_row is not None
    late, readouts = _rows_after_pose(layout, state, ties, rows)
    by_velocity = np.einsum("nai,ni->na", by_centre, layout.velocity_per_row[ties.view])
    by_readout = (late[:, None] * by_velocity)[:, :, None]
    return -readouts[:, None] * by_velocity, by_readout if layout.finds_readouts else by_readout[:, :, :0]


def _points_of_observations(state: State, ties: TiePoints, rise_design: np.ndarray) -> np.ndarray:
    """Points (N, 3) of the observations."""
    points = state.points[ties.point].copy()
    points[:, 2] += rise_design @ state.relief
    return points


def _in_cam(state: State, ties: TiePoints, line: np.ndarray) -> np.ndarray:
    """Lines of sight (N, 3) in the axes of their cameras."""
    return np.einsum("nij,nj->ni", state.rotations[ties.view], line)


def _at_unit_depth(in_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (N, 2) where lines of sight meet the plane at depth 1, and their depths (N,); NaN behind."""
    z = np.where(in_cam[:, 2] > 0.0, in_cam[:, 2], np.nan)
    return in_cam[:, :2] / z[:, None], z


def _focal(layout: Layout, state: State, ties: TiePoints) -> np.ndarray:
    """Focal lengths (N, 2) [px] of the photographs of the observations."""
    number = layout.lens_of[ties.view]
    focal = state.lenses[number, 0]
    return np.column_stack([focal, focal * layout.aspect[number]]) * _enlarged(state, ties)[:, None]


def _pixels(layout: Layout, state: State, ties: TiePoints, distorted_xy: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of distorted coordinates (N, 2)."""
    return distorted_xy * _focal(layout, state, ties) + state.lenses[layout.lens_of[ties.view], 1:3]


@dataclass(frozen=True)
class _Projected:
    """Pixels of lines of sight, with what their derivatives are made of."""

    pixels: np.ndarray  # (N, 2) [px]
    in_cam: np.ndarray  # (N, 3): the lines in cam
    by_cam: np.ndarray  # (N, 2, 3): derivatives by them
    distorted_xy: np.ndarray  # (N, 2)
    by_coefficients: np.ndarray  # (N, 2, 5): derivatives of distorted_xy by the coefficients of distortion

    def by_line(self, state: State, ties: TiePoints) -> np.ndarray:
        """Derivatives (N, 2, 3) by the lines of sight."""
        return np.einsum("nai,nij->naj", self.by_cam, state.rotations[ties.view])

    def by_lens(self, layout: Layout, state: State, ties: TiePoints) -> np.ndarray:
        """Derivatives (N, 2, 8) by the lenses."""
        aspect = layout.aspect[layout.lens_of[ties.view]]
        one = np.ones(len(aspect))
        by_focal = self.distorted_xy * np.column_stack([one, aspect]) * _enlarged(state, ties)[:, None]
        by_middle = np.tile(np.eye(2), (len(aspect), 1, 1))
        by_distortion = _focal(layout, state, ties)[:, :, None] * self.by_coefficients
        return np.concatenate([by_focal[:, :, None], by_middle, by_distortion], axis=-1)


def _project(layout: Layout, state: State, ties: TiePoints, line: np.ndarray) -> _Projected:
    """Pixels of lines of sight (N, 3) [m], local."""
    in_cam = _in_cam(state, ties, line)
    xy, z = _at_unit_depth(in_cam)
    distorted_xy, by_xy, by_coefficients = distort(xy, state.lenses[layout.lens_of[ties.view], 3:])
    zero, one = np.zeros(len(z)), np.ones(len(z))
    flat = np.stack([np.column_stack([one, zero, -xy[:, 0]]), np.column_stack([zero, one, -xy[:, 1]])], axis=1)
    by_cam = _focal(layout, state, ties)[:, :, None] * (by_xy @ flat) / z[:, None, None]
    return _Projected(_pixels(layout, state, ties, distorted_xy), in_cam, by_cam, distorted_xy, by_coefficients)


def _enlarged(state: State, ties: TiePoints) -> np.ndarray:
    """Focal lengths (N,) of the photographs of the observations, over those of their lenses."""
    return 1.0 + state.focals[ties.view] if len(state.focals) else np.ones(len(ties.view))


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Skew-symmetric matrices (N, 3, 3) of vectors (N, 3): the cross product with them."""
    x, y, z = vectors.T
    zero = np.zeros(len(x))
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.column_stack(row) for row in rows], axis=1)


def _assemble_derivatives(layout: Layout, ties: TiePoints, dense: np.ndarray) -> csr_array:
    """Derivatives (N, 2, 4 + 3 + 8 + 6), one more each with readouts, rate and focals, at their places, (2 N, P)."""
    count = len(ties.view)
    shared = np.tile(np.arange(NUM_WATER + NUM_RELIEF), (count, 1))
    number = layout.lens_of[ties.view][:, None]
    lens = layout.first_lens + NUM_LENS * number + np.arange(NUM_LENS)
    readout = layout.first_readout + number[:, : int(layout.finds_readouts)]
    rate = np.tile(np.arange(layout.first_rate, layout.first_focal), (count, 1))
    focal = layout.first_focal + ties.view[:, None][:, : int(layout.finds_focals)]
    pose = layout.first_pose + NUM_POSE * ties.view[:, None] + np.arange(NUM_POSE)
    columns = np.repeat(np.concatenate([shared, lens, readout, rate, focal, pose], axis=1), 2, axis=0)
    ends = np.arange(2 * count + 1) * columns.shape[1]
    return csr_array((dense.reshape(-1), columns.reshape(-1), ends), shape=(2 * count, len(layout)))
