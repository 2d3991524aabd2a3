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
from survey.adjust.block.state import NUM_LENS, NUM_POSE, NUM_RELIEF, NUM_WATER, Layout, State, distort
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
    wet = np.zeros(len(line), dtype=bool)
    if water is not None:
        wet = (water.depth(points) > 0.0) & (water.depth(centres) < 0.0)
        bent = _derivatives(line[wet], centres[wet], points[wet], water)
        by_point[wet], by_centre[wet], by_water[wet] = bent
    return LinesOfSight(line, by_point, by_centre, by_water, wet)


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
        # As the normal turns by a small vector about the reference point of the plane.
        turn = normal * slopes[axis] / stretch**2 - np.eye(3)[axis] / stretch
        moved = np.einsum("nij,nj->ni", by_across, -np.outer(apart @ normal, turn) - np.outer(apart @ turn, normal))
        moved = moved + by_high * ((centres - foot) @ turn)[:, None] + by_deep * ((foot - points) @ turn)[:, None]
        columns.append(moved - np.outer(high, turn))
    columns.append(s_n[:, None] * towards)
    return by_point, by_centre, np.stack(columns, axis=-1)


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
    pixels, _ = _project(layout, state, ties, line)
    return pixels


def linearise(
    layout: Layout, state: State, ties: TiePoints, rise_design: np.ndarray, rows: np.ndarray | None = None
) -> Prediction:
    """Predicted pixels with their derivatives; see `predict`."""
    lines = bent_lines_of_sight(*_ends(layout, state, ties, rise_design, rows), state.water)
    pixels, imaged = _project(layout, state, ties, lines.line)
    rotations = state.rotations[ties.view]
    by_line = np.einsum("nai,nij->naj", imaged.by_cam, rotations)
    by_point = by_line @ lines.by_point
    by_centre, by_lens = by_line @ lines.by_centre, imaged.by_lens
    by_readout = np.zeros((len(pixels), 2, 0))
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
    return Prediction(pixels, by_point, _assemble_derivatives(layout, ties, dense), lines.wet)


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


@dataclass(frozen=True)
class _Projected:
    in_cam: np.ndarray
    by_cam: np.ndarray
    by_lens: np.ndarray


def _project(layout: Layout, state: State, ties: TiePoints, line: np.ndarray) -> tuple[np.ndarray, _Projected]:
    """Pixels of lines of sight in the photographs, with derivatives by the line in cam and by the lens."""
    number = layout.lens_of[ties.view]
    lens, aspect = state.lenses[number], layout.aspect[number]
    in_cam = np.einsum("nij,nj->ni", state.rotations[ties.view], line)
    z = np.where(in_cam[:, 2] > 0.0, in_cam[:, 2], np.nan)
    xy = in_cam[:, :2] / z[:, None]
    distorted, by_xy, by_coefficients = distort(xy, lens[:, 3:])
    enlarged = _enlarged(state, ties)
    focal = np.column_stack([lens[:, 0], lens[:, 0] * aspect]) * enlarged[:, None]
    pixels = distorted * focal + lens[:, 1:3]
    zero, one = np.zeros(len(z)), np.ones(len(z))
    flat = np.stack([np.column_stack([one, zero, -xy[:, 0]]), np.column_stack([zero, one, -xy[:, 1]])], axis=1)
    by_cam = focal[:, :, None] * (by_xy @ flat) / z[:, None, None]
    by_focal = distorted * np.column_stack([one, aspect]) * enlarged[:, None]
    by_middle = np.tile(np.eye(2), (len(z), 1, 1))
    by_lens = np.concatenate([by_focal[:, :, None], by_middle, focal[:, :, None] * by_coefficients], axis=-1)
    return pixels, _Projected(in_cam, by_cam, by_lens)


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
