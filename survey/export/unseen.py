"""Causes of water without a bed: turbid, too deep, glint, or one view only."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from survey.plan.area import local_area
from survey.report.seen_cells import SeenCells, cells_seen

if TYPE_CHECKING:
    from geo.frames import LocalFrame
    from survey.export.loaded import LoadedRun
    from survey.run.stored import StoredBed

# What a cell without a point is; 0 is everything else: bed found, dry ground, or seen by no view.
TWO_VIEWS, ONE_VIEW = 1, 2
REASONS = {
    TWO_VIEWS: "two or more views, no bed found: turbid, too deep, glint, or without texture",
    ONE_VIEW: "one view only",
}
CLASS_WATER_SURFACE, CLASS_NO_BOTTOM = 41, 45


@dataclass(frozen=True)
class Unseen:
    """Cells of the ground without a bed."""

    cells: SeenCells
    codes: np.ndarray  # (rows, columns) uint8: `TWO_VIEWS`, `ONE_VIEW` or 0
    # (rows, columns) float64 [m], local: height of the water over the middles of the cells; NaN in a dry survey
    level: np.ndarray
    frame: LocalFrame

    def codes_at(self, points_crs: np.ndarray) -> np.ndarray:
        """Codes (...) uint8 under points (..., 3) in the CRS of the survey, e.g. the middles of other cells; 0 beyond.

        Heights matter little: a metre moves a place by micrometres.
        """
        local = self.frame.local_from_crs(points_crs)
        rows, columns = self.codes.shape
        at = (local[..., :2] - self.cells.low) / self.cells.cell_m
        inside = ((at >= 0.0) & (at < (columns, rows))).all(axis=-1)
        return np.where(inside, self.codes[self.cells.index(np.where(inside[..., None], local, 0.0))], 0).astype(
            np.uint8
        )


def unseen_of(run: LoadedRun) -> Unseen:
    """The cells of a run, made once for the products of a command.

    A cell is ten ground sampling distances wide (`survey.report.seen_cells`), counts as water where the nearest bed
    lies under the water, and as seen where its middle is.

    Raises
    ------
    SurveyError
        If the run was made before runs kept their cameras.
    """
    return run.once("unseen", lambda: _unseen(run))


def _unseen(run: LoadedRun) -> Unseen:
    flight = run.flight
    cameras = [view.camera for view in flight.views]
    cells = cells_seen(cameras, flight.water, local_area(flight), run.columns("xyz")["xyz"], run.place.gsd_m)
    places = cells.middles
    level = np.full(cells.height.shape, np.nan)
    if flight.water is not None:
        level = flight.water.height(places[..., 0], places[..., 1])
    is_water = cells.height < level
    codes = np.where(cells.num_views >= 2, TWO_VIEWS, np.where(cells.num_views == 1, ONE_VIEW, 0))
    return Unseen(cells, np.where(is_water & ~cells.has_point, codes, 0).astype(np.uint8), level, flight.frame)


def with_unseen(run: LoadedRun, stored: StoredBed, crs: str | None) -> tuple[StoredBed, np.ndarray]:
    """The cloud, in a CRS or that of the survey, with two points for each cell without a bed; the classes (N,) of all.

    Both stand on the water over the middle of the cell, black, without depth and standard deviation: `CLASS_NO_BOTTOM`,
    and `CLASS_WATER_SURFACE`.
    """
    from fields.sweep.bed import BedPoints
    from geo.las import classes_of

    unseen, bed = unseen_of(run), stored.bed
    missing = unseen.codes > 0
    number = int(missing.sum())
    xyz = unseen.cells.middles[missing]
    xyz[:, 2] = unseen.level[missing]
    views = unseen.cells.num_views[missing].clip(max=255).astype(bed.num_views.dtype)
    unknown = np.full(number, np.nan, dtype=np.float32)
    some = bed[np.zeros(number, dtype=np.int64)]
    added = replace(
        some, xyz=xyz, rgb=np.zeros_like(some.rgb), std=unknown, num_views=views, depth=unknown, incidence=unknown
    )
    points = unseen.frame.crs_from_local(xyz)
    if crs is not None:
        points = run.way_to(crs)(points)
    classes = [classes_of(bed.wet), np.full(number, CLASS_NO_BOTTOM), np.full(number, CLASS_WATER_SURFACE)]
    common = stored.std_common
    whole = replace(
        stored,
        bed=BedPoints.concatenate([bed, added, added]),
        points_crs=np.concatenate([stored.points_crs, points, points]),
        std_common=None if common is None else np.concatenate([common, unknown, unknown]),
        std_placed=None,
    )
    return whole, np.concatenate(classes).astype(np.uint8)
