"""The quality gate of a run: whether its cloud may be used unseen.

Two things are required. Of the ground that two or more views see, at the height where the bed was found, at least half
has a point: what one view alone sees cannot be measured and does not count. And the median standard deviation of the
points is at most one and a half ground sampling distances.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import distance_transform_edt

from survey.display.plan_grid import PlanGrid
from survey.display.quantities import NO_BREAK, length, share
from survey.plan.area import local_area
from survey.report.verdict import Gate, Verdict

if TYPE_CHECKING:
    from fields.sweep.bed import BedPoints
    from refract import PinholeCamera
    from survey.folder.survey import Survey

MIN_COVERED_SHARE = 0.5
MAX_STD_GSD = 1.5
# Side of a cell: large against the spacing of points of a well matched bed, which is one, and smaller than a gap that
# matters.
CELL_GSD = 10.0
MIN_VIEWS = 2
# At most this many cells along an axis; larger areas take larger cells.
_MOST_CELLS = 2000


def verdict_of(survey: Survey, bed: BedPoints, gsd_m: float) -> Verdict:
    """What the gates say of points of the bed (local frame) at a ground sampling distance [m]."""
    return Verdict((_completeness(survey, bed, gsd_m), _precision(bed, gsd_m)))


def _completeness(survey: Survey, bed: BedPoints, gsd_m: float) -> Gate:
    has_point, num_views = cells_seen(survey, bed.xyz, gsd_m)
    seen = num_views >= MIN_VIEWS
    found = float((has_point & seen).sum() / seen.sum()) if seen.any() else 0.0
    sentence = (
        f"{share(found)} of the ground that two or more views see has a point of the bed; "
        f"required: at least {share(MIN_COVERED_SHARE)}"
    )
    passed = found >= MIN_COVERED_SHARE
    return Gate("ground with a point", 100.0 * found, 100.0 * MIN_COVERED_SHARE, "%", passed, sentence)


def _precision(bed: BedPoints, gsd_m: float) -> Gate:
    std, limit = float(np.nanmedian(bed.std)), MAX_STD_GSD * gsd_m
    sentence = (
        f"the median standard deviation of the points is {length(std)}; required: at most {length(limit)} "
        f"({MAX_STD_GSD:g}{NO_BREAK}ground sampling distances)"
    )
    return Gate("median standard deviation", 1000.0 * std, 1000.0 * limit, "mm", std <= limit, sentence)


def cells_seen(survey: Survey, xyz: np.ndarray, gsd_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Cells of the ground in plan: which have a point of (N, 3) [m], local, and how many views see each.

    The cells cover the bounds of the survey, or without bounds where the axes of cameras meet the bed and one view
    reaches around; a cell without a point lies as high as the nearest that has one. Occlusion is
    ignored.

    Returns
    -------
    has_point : (rows, columns) bool
        Rows from south to north.
    num_views : (rows, columns) int
    """
    cameras = [view.camera for view in survey.views]
    low, high = _extent(survey, cameras, float(np.median(xyz[:, 2])))
    cell = max(CELL_GSD * gsd_m, float((high - low).max()) / _MOST_CELLS)
    grid = PlanGrid.within(xyz, low, high, cell)
    height = grid.mean(xyz[:, 2])[::-1]
    has_point = np.isfinite(height)
    if not has_point.any():
        return has_point, np.zeros(grid.shape, dtype=int)
    nearest = distance_transform_edt(~has_point, return_distances=False, return_indices=True)
    height = height[tuple(nearest)]
    west, _, south, _ = grid.extent
    rows, columns = grid.shape
    x, y = west + cell * (np.arange(columns) + 0.5), south + cell * (np.arange(rows) + 0.5)
    places = np.stack([*np.meshgrid(x, y), height], axis=-1)
    num_views = np.zeros(grid.shape, dtype=int)
    for camera in cameras:
        part = _around(camera, x, y, height)
        pixel = camera.project(places[part].reshape(-1, 3), survey.water)
        sees = ((pixel > 0.0) & (pixel < (camera.width, camera.height))).all(axis=1)  # False for NaN
        num_views[part] += sees.reshape(num_views[part].shape)
    return has_point, num_views


def _extent(survey: Survey, cameras: list[PinholeCamera], height: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners (2,), (2,) [m], local, of the ground that is asked about."""
    area = local_area(survey)
    if area is not None:
        return np.array(area[:2]), np.array(area[2:])
    centres, reaches = np.array([camera.centre for camera in cameras]), []
    axes = np.array([camera.cam_from_local[2] for camera in cameras])
    # Views to the horizon are taken to look at most 45 degrees up from the vertical.
    fall = np.minimum(axes[:, 2], -np.sqrt(0.5))
    foot = centres[:, :2] + axes[:, :2] * ((height - centres[:, 2]) / fall)[:, None]
    for camera in cameras:
        half = 0.5 * camera.widening * np.hypot(camera.width / camera.fx, camera.height / camera.fy)
        reaches.append(half * max(camera.centre[2] - height, 0.0))
    reach = np.array(reaches)[:, None]
    return (foot - reach).min(axis=0), (foot + reach).max(axis=0)


def _around(camera: PinholeCamera, x: np.ndarray, y: np.ndarray, height: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the cells that a camera can see at all: those within the cone about its vertical.

    Refraction only draws what is seen nearer to the vertical.
    """
    directions = camera.directions(camera.outline())
    fall = camera.centre[2] - float(height.min())
    # False for NaN, where the lens brings no light to the border.
    if not (directions[:, 2] < -1e-3).all() or fall <= 0.0:
        return slice(None), slice(None)
    ends = camera.centre[:2] + directions[:, :2] * (fall / -directions[:, 2])[:, None]
    ends = np.concatenate([ends, camera.centre[None, :2]])
    (x0, y0), (x1, y1) = ends.min(axis=0), ends.max(axis=0)
    return slice(*np.searchsorted(y, (y0, y1))), slice(*np.searchsorted(x, (x0, x1)))
