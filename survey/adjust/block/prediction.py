"""Pixels at which a state of the adjustment predicts its tie points, and their derivatives by all parameters.

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
        by_water[wet] = crossing.by_water(centres[wet], points[wet], water)
    return LinesOfSight(line, by_point, by_centre, by_water, wet)


def _is_wet(centres: np.ndarray, points: np.ndarray, water: FlatWater | None) -> np.ndarray:
    """Which rays (N,) pass through water."""
    if water is None:
        return np.zeros(len(points), dtype=bool)
    return (water.depth(points) > 0.0) & (water.depth(centres) < 0.0)


@dataclass(frozen=True)
class _Crossing:
    """Derivatives of N bent lines of sight by what their crossing depends on."""

    normal: np.ndarray  # (3,): of the plane, upwards
    by_across: np.ndarray  # (N, 3, 3): by the vector from foot to foot
    by_high: np.ndarray  # (N, 3): by the height H of the camera
    by_deep: np.ndarray  # (N, 3): by the depth h of the point
    by_index: np.ndarray  # (N, 3): by the index of the water

    @classmethod
    def of(cls, line: np.ndarray, centres: np.ndarray, points: np.ndarray, water: FlatWater) -> _Crossing:
        """Of lines (N, 3) [m], local, from centres to points (N, 3), all of them bent."""
        normal, foot, n = _normal(water), np.array(water.point), water.n_water
        offset = points - centres
        across = offset - np.outer(offset @ normal, normal)
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
        by_high, by_deep = s_high[:, None] * towards - normal, s_deep[:, None] * towards
        return cls(normal, by_across, by_high, by_deep, s_n[:, None] * towards)

    def by_point(self) -> np.ndarray:
        """By the point, (N, 3, 3)."""
        return self._sideways() - self.by_deep[:, :, None] * self.normal

    def by_centre(self) -> np.ndarray:
        """By the centre of the camera, (N, 3, 3)."""
        return -self._sideways() + self.by_high[:, :, None] * self.normal

    def _sideways(self) -> np.ndarray:
        return self.by_across @ (np.eye(3) - np.outer(self.normal, self.normal))

    def by_water(self, centres: np.ndarray, points: np.ndarray, water: FlatWater) -> np.ndarray:
        """By the height of the plane at its reference point, its slopes and its index, (N, 3, 4)."""
        slopes, foot, offset = _slopes(water), np.array(water.point), points - centres
        stretch = np.linalg.norm(slopes)
        high = (centres - foot) @ self.normal
        columns = [(self.by_deep - self.by_high) / stretch]
        for axis in range(2):
            # As the normal turns by a small vector about the reference point of the plane.
            turn = self.normal * slopes[axis] / stretch**2 - np.eye(3)[axis] / stretch
            across = -np.outer(offset @ self.normal, turn) - np.outer(offset @ turn, self.normal)
            moved = np.einsum("nij,nj->ni", self.by_across, across)
            moved = moved + self.by_high * ((centres - foot) @ turn)[:, None]
            moved = moved + self.by_deep * ((foot - points) @ turn)[:, None]
            columns.append(moved - np.outer(high, turn))
        columns.append(self.by_index)
        return np.stack(columns, axis=-1)


def _slopes(water: FlatWater) -> np.ndarray:
    """Gradient (3,) of the height over the plane, with 1 along z."""
    return np.array([-water.slope_x, -water.slope_y, 1.0])


def _normal(water: FlatWater) -> np.ndarray:
    """Unit normal (3,) of the plane, upwards."""
    slopes = _slopes(water)
    return slopes / np.linalg.norm(slopes)


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
