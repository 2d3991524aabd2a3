"""Pixels at which a state of the adjustment predicts its tie points, and their derivatives by all parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from survey.adjust.brown import distort
from survey.adjust.sight import lines_of_sight, sights
from survey.adjust.state import LENS, POSE, RELIEF, WATER, Layout, State
from survey.photos.tie_points import TiePoints


@dataclass(frozen=True)
class Linear:
    """Predicted pixels (N, 2), and their derivatives.

    Attributes
    ----------
    pixels : (N, 2) [px]
    by_point : (N, 2, 3)
    by_parameters : (2 N, P) sparse
    wet : (N,) bool
        Which rays pass through water.
    """

    pixels: np.ndarray
    by_point: np.ndarray
    by_parameters: csr_array
    wet: np.ndarray


def predict(
    layout: Layout, state: State, ties: TiePoints, sides: np.ndarray, rows: np.ndarray | None = None
) -> np.ndarray:
    """Predicted pixels (N, 2); NaN where a point lies behind its camera.

    Parameters
    ----------
    layout, state, ties
    sides : (N, 3)
        As `relief_sides` gives them.
    rows : (N,) [px], optional
        Of the photographs as they were taken, for rolling shutters; default those of the tie points.
    """
    line = lines_of_sight(*_ends(layout, state, ties, sides, rows), state.water)
    pixels, _ = _imaged(layout, state, ties, line)
    return pixels


def linearise(
    layout: Layout, state: State, ties: TiePoints, sides: np.ndarray, rows: np.ndarray | None = None
) -> Linear:
    """Predicted pixels with their derivatives; see `predict`."""
    sight = sights(*_ends(layout, state, ties, sides, rows), state.water)
    pixels, imaged = _imaged(layout, state, ties, sight.line)
    rotations = state.rotations[ties.view]
    by_line = np.einsum("nai,nij->naj", imaged.by_cam, rotations)
    by_point = by_line @ sight.by_point
    by_centre, by_lens = by_line @ sight.by_centre, imaged.by_lens
    by_readout = np.zeros((len(pixels), 2, 0))
    if layout.flow is not None:
        by_middle, by_readout = _by_shutter(layout, state, ties, rows, by_centre)
        by_lens[:, :, 2] += by_middle
    by_water = by_line @ sight.by_water
    # A tide raises the water of its photograph as a higher level does.
    by_rate = (
        by_water[:, :, :0] if layout.hours is None else by_water[:, :, :1] * layout.hours[ties.view][:, None, None]
    )
    dense = np.concatenate(
        [
            by_water,
            by_point[:, :, 2, None] * sides[:, None, :],
            by_lens,
            by_readout,
            by_rate,
            by_centre,
            -imaged.by_cam @ _cross(imaged.in_cam),
        ],
        axis=-1,
    )
    return Linear(pixels, by_point, _placed(layout, ties, dense), sight.wet)


def relief_sides(state: State, ties: TiePoints) -> np.ndarray:
    """By what three apparent rises of a rough bed raise points (N, 3): t^2 for all sides, and t east and north.

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
    layout: Layout, state: State, ties: TiePoints, sides: np.ndarray, rows: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Cameras and points (N, 3) each, where they would be if the water had stayed and all else sunk by the tide."""
    centres, points = _centres(layout, state, ties, rows), _seen(state, ties, sides)
    tides = state.tides(layout)
    if tides is None:
        return centres, points
    down = np.zeros_like(points)
    down[:, 2] = tides[ties.view]
    return centres - down, points - down


def _centres(layout: Layout, state: State, ties: TiePoints, rows: np.ndarray | None) -> np.ndarray:
    """Where the cameras are (N, 3) when they take the rows of the observations; a pose is that at the row `cy`."""
    centres = state.centres[ties.view]
    if layout.flow is None:
        return centres
    late, readouts = _late(layout, state, ties, rows)
    return centres + (readouts * late)[:, None] * layout.flow[ties.view]


def _late(layout: Layout, state: State, ties: TiePoints, rows: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """By how many rows (N,) observations are taken after the row `cy`, and readouts (N,) of their photographs."""
    number = layout.lens_of[ties.view]
    rows = ties.pixel[:, 1] if rows is None else rows
    return rows - state.lenses[number, 2], state.readouts[number]


def _by_shutter(layout: Layout, state: State, ties: TiePoints, rows: np.ndarray | None, by_centre: np.ndarray):
    """What `cy`, as the row of the pose, adds to its derivative (N, 2); derivatives by the readout (N, 2, 0 or 1)."""
    assert layout.flow is not None
    late, readouts = _late(layout, state, ties, rows)
    by_flow = np.einsum("nai,ni->na", by_centre, layout.flow[ties.view])
    by_readout = (late[:, None] * by_flow)[:, :, None]
    return -readouts[:, None] * by_flow, by_readout if layout.finds_readouts else by_readout[:, :, :0]


def _seen(state: State, ties: TiePoints, sides: np.ndarray) -> np.ndarray:
    """Points (N, 3) that the observations show."""
    points = state.points[ties.point].copy()
    points[:, 2] += sides @ state.relief
    return points


@dataclass(frozen=True)
class _Imaged:
    in_cam: np.ndarray
    by_cam: np.ndarray
    by_lens: np.ndarray


def _imaged(layout: Layout, state: State, ties: TiePoints, line: np.ndarray) -> tuple[np.ndarray, _Imaged]:
    """Pixels of lines of sight in the photographs, with derivatives by the line in cam and by the lens."""
    number = layout.lens_of[ties.view]
    lens, aspect = state.lenses[number], layout.aspect[number]
    in_cam = np.einsum("nij,nj->ni", state.rotations[ties.view], line)
    z = np.where(in_cam[:, 2] > 0.0, in_cam[:, 2], np.nan)
    xy = in_cam[:, :2] / z[:, None]
    distorted, by_xy, by_coefficients = distort(xy, lens[:, 3:])
    focal = np.column_stack([lens[:, 0], lens[:, 0] * aspect])
    pixels = distorted * focal + lens[:, 1:3]
    zero, one = np.zeros(len(z)), np.ones(len(z))
    flat = np.stack([np.column_stack([one, zero, -xy[:, 0]]), np.column_stack([zero, one, -xy[:, 1]])], axis=1)
    by_cam = focal[:, :, None] * (by_xy @ flat) / z[:, None, None]
    by_focal = distorted * np.column_stack([one, aspect])
    by_middle = np.tile(np.eye(2), (len(z), 1, 1))
    by_lens = np.concatenate([by_focal[:, :, None], by_middle, focal[:, :, None] * by_coefficients], axis=-1)
    return pixels, _Imaged(in_cam, by_cam, by_lens)


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, 3) whose product with w is the vector product of (N, 3) vectors and w."""
    x, y, z = vectors.T
    zero = np.zeros(len(x))
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.column_stack(row) for row in rows], axis=1)


def _placed(layout: Layout, ties: TiePoints, dense: np.ndarray) -> csr_array:
    """Derivatives (N, 2, 4 + 3 + 8 + 6), one more each with readouts and a rate, at their parameters, (2 N, P)."""
    count = len(ties.view)
    shared = np.tile(np.arange(WATER + RELIEF), (count, 1))
    number = layout.lens_of[ties.view][:, None]
    lens = layout.first_lens + LENS * number + np.arange(LENS)
    readout = layout.first_readout + number[:, : int(layout.finds_readouts)]
    rate = np.tile(np.arange(layout.first_rate, layout.first_pose), (count, 1))
    pose = layout.first_pose + POSE * ties.view[:, None] + np.arange(POSE)
    columns = np.repeat(np.concatenate([shared, lens, readout, rate, pose], axis=1), 2, axis=0)
    ends = np.arange(2 * count + 1) * columns.shape[1]
    return csr_array((dense.reshape(-1), columns.reshape(-1), ends), shape=(2 * count, len(layout)))
