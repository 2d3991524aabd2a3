"""Search volume of a survey: its area in plan, heights over one plane, and sample places of the bed with their views.

Bounds that no two photographs see any part of are refused. A survey of kilometres is flattened for whatever is planned
for all of it at once: overlap, heights, amounts of work.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np

from fields.sweep.views import coverage
from geo.crs import height_unit_m
from survey.errors import FILE_NAME, ConfigError
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.photos.poses import least_track
from survey.plan.heights import camera_height_m, dry_ground, height_range

# x0, y0, x1, y1 [m], local.
Area = tuple[float, float, float, float]

# A survey over which the level surface falls by less than this [m] needs no flattening; over a kilometre it is 2 cm.
_LEAST_DROP_M = 0.05
# The cloud ends this far beyond the area, so that heights at its border have points on all sides.
AREA_MARGIN_M = 0.5
# Sample places along each side of the bounds and of a photograph, and sample heights of the bed.
_PLACES, _HEIGHTS = 16, 5
# Rays nearer to the horizon than this sine leave the survey; footprints are cut there.
_LEAST_FALL = 0.05
# Assumed depth of the bed where nothing is known [m].
ASSUMED_DEPTH_M = 2.0
# Largest number of views of a block that is analysed: its middle is as stable as that of a larger block.
_MOST_VIEWS = 100


def flattened(survey: Survey) -> Survey:
    """The survey with heights in crs as local z of photographs and matched points.

    Away from the origin level ground falls below z = 0, by 7.8 m at 10 km, which is more than the height of some
    flights. Unchanged where it falls by less than 5 cm.
    """
    given = np.array([view.camera.centre for view in survey.views])
    centres = _raised(survey, given)
    if not np.isfinite(centres).all() or np.abs(centres[:, 2] - given[:, 2]).max() < _LEAST_DROP_M:
        return survey
    views = tuple(
        replace(view, camera=replace(view.camera, centre=centre))
        for view, centre in zip(survey.views, centres, strict=True)
    )
    observations, water = survey.observations, survey.water
    if observations.points is not None:
        observations = replace(observations, points=_raised(survey, observations.points))
    if water is not None:
        x, y, z = _raised(survey, np.array([water.point]))[0].tolist()
        slope_x, slope_y = survey.frame.local_from_grid(survey.frame.crs_from_local(np.array(water.point)))[:2, 2]
        # Slopes are against level, not against the plane that touches the Earth at the origin.
        water = replace(
            water, point=(x, y, z), slope_x=water.slope_x + float(slope_x), slope_y=water.slope_y + float(slope_y)
        )
    return replace(survey, views=views, water=water, observations=observations)


def _raised(survey: Survey, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) [m], local, with their heights in crs over the origin as z."""
    frame = survey.frame
    heights = frame.crs_from_local(points)[:, 2] - frame.origin[2]
    return np.column_stack([points[:, :2], heights * height_unit_m(frame.crs)])


def plane_name(survey: Survey) -> str:
    """The reference of heights, in words."""
    return "water" if survey.water is not None else "local origin"


def limits(survey: Survey) -> tuple[float, float]:
    """Heights [m] over the water plane (dry: over local z = 0) between which the bed is searched."""
    found = height_range(survey, camera_height_m(survey))
    return found.low, found.high


def local_area(survey: Any) -> Area | None:
    """Bounds of a survey, or of the flight of a run, as (x0, y0, x1, y1) [m], local, that hold them; None without."""
    if survey.bounds is None:
        return None
    e0, n0, e1, n1 = survey.bounds
    level = survey.frame.origin[2]
    corners = survey.frame.local_from_crs([[e0, n0, level], [e1, n0, level], [e1, n1, level], [e0, n1, level]])[:, :2]
    return (*corners.min(axis=0), *corners.max(axis=0))


def grown(area: Area, margin: float) -> Area:
    """An area (x0, y0, x1, y1) [m] with a margin [m] on every side."""
    return (area[0] - margin, area[1] - margin, area[2] + margin, area[3] + margin)


@dataclass(frozen=True)
class Tiling:
    """Tiles of a rectangle, row by row from the south-west."""

    # x, y [m], local: lines between the tiles, the outer ones included, rising
    x: tuple[float, ...]
    y: tuple[float, ...]
    rim: float  # [m]: overlap of the maps of a tile with its neighbours

    @staticmethod
    def of(ground: Area, count: int, rim: float) -> Tiling:
        """Equal tiles of a ground (x0, y0, x1, y1), as square as their number allows."""
        width, height = ground[2] - ground[0], ground[3] - ground[1]
        pairs = [(n, count // n) for n in range(1, count + 1) if count % n == 0]
        columns, rows = min(pairs, key=lambda pair: abs(math.log(width / pair[0] * pair[1] / height)))
        x, y = np.linspace(ground[0], ground[2], columns + 1), np.linspace(ground[1], ground[3], rows + 1)
        return Tiling(tuple(x.tolist()), tuple(y.tolist()), rim)

    def __len__(self) -> int:
        return (len(self.x) - 1) * (len(self.y) - 1)

    def _lines(self, number: int) -> tuple[int, int]:
        row, column = divmod(number, len(self.x) - 1)
        return row, column

    def cell(self, number: int) -> Area:
        """Rectangle of the points of a tile, its west and south sides included; without end at the outer sides."""
        row, column = self._lines(number)
        x, y = (-math.inf, *self.x[1:-1], math.inf), (-math.inf, *self.y[1:-1], math.inf)
        return x[column], y[row], x[column + 1], y[row + 1]

    def ground(self, number: int, margin: float) -> Area:
        """Rectangle of a tile with a margin [m] at the sides where another tile follows."""
        row, column = self._lines(number)
        west, south, east, north = (
            margin if is_inner else 0.0
            for is_inner in (column > 0, row > 0, column + 2 < len(self.x), row + 2 < len(self.y))
        )
        return self.x[column] - west, self.y[row] - south, self.x[column + 1] + east, self.y[row + 1] + north


def inside(xy: np.ndarray, cell: Area) -> np.ndarray:
    """Mask of the places (..., 2) in a rectangle whose west and south sides belong to it."""
    x, y = xy[..., 0], xy[..., 1]
    return (x >= cell[0]) & (y >= cell[1]) & (x < cell[2]) & (y < cell[3])


def within(xyz: np.ndarray, area: Area) -> np.ndarray:
    """Points (N, 3) over an area (x0, y0, x1, y1), as (N,) bool."""
    return (xyz[:, 0] >= area[0]) & (xyz[:, 1] >= area[1]) & (xyz[:, 0] <= area[2]) & (xyz[:, 1] <= area[3])


def require_seen(survey: Survey) -> None:
    """Raise where fewer than two photographs see the bounds at any height of the search range."""
    area = local_area(survey)
    if survey.bounds is None or area is None:
        return
    level = flattened(survey)
    area = grown(area, AREA_MARGIN_M)
    footprints = [_footprint(view, level) for view in level.views]
    # Both samples are needed: small bounds may contain no sample of a photograph, and a footprint none of large bounds.
    inside = (places[within(places, area)] for places in footprints)
    for places in chain(_places(level, area), inside):
        count = np.zeros(len(places), dtype=np.int64)
        for camera in (view.camera for view in level.views):
            count += camera.sees(camera.project(places, level.water)) if len(places) else 0
            if (count >= 2).any():
                return
    corners = survey.frame.crs_from_local(np.concatenate(footprints))
    low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
    e0, n0, e1, n1 = survey.bounds
    surface = "water" if survey.water is not None else "ground"
    raise ConfigError(
        f"[area] bounds in {FILE_NAME}, {e0:.10g} to {e1:.10g} east and {n0:.10g} to {n1:.10g} north, are seen by "
        f"fewer than two photographs, whose footprints at the {surface} reach from {low[0]:.10g} to {high[0]:.10g} "
        f"east and from {low[1]:.10g} to {high[1]:.10g} north; correct them (east and north, low then high)"
    )


def _places(survey: Survey, area: Area) -> list[np.ndarray]:
    """Sample places (N, 3) [m], local, of an area at several heights of the bed."""
    x, y = np.meshgrid(*(np.linspace(area[i], area[i + 2], _PLACES) for i in (0, 1)))
    plan = np.column_stack([x.ravel(), y.ravel()])
    base = 0.0 if survey.water is None else np.asarray(survey.water.height(*plan.T))
    low, high = limits(survey)
    heights = np.linspace(low, high, _HEIGHTS)
    return [np.column_stack([plan, np.broadcast_to(base + height, len(plan))]) for height in (0.0, *heights)]


def _footprint(view: View, survey: Survey) -> np.ndarray:
    """Sample places (N, 3) [m], local, of a footprint at the water, or at the rough height of dry ground."""
    camera, water = view.camera, survey.water
    x, y = np.meshgrid(np.linspace(0.0, camera.width, _PLACES), np.linspace(0.0, camera.height, _PLACES))
    path = camera.paths(np.column_stack([x.ravel(), y.ravel()]), water)
    up = np.array((0.0, 0.0, 1.0) if water is None else water.up)
    falls = path.air_direction @ up < -_LEAST_FALL
    if water is not None:
        return path.crossing[falls]
    return path.at_height(dry_ground(survey).height, None)[falls]


@dataclass(frozen=True)
class Places:
    """Places of a level bed in the area, each in the frames of three views, or of two where there are only two."""

    seen: np.ndarray  # (V, M) bool
    cells: np.ndarray  # (M, 3) float64 [m], local

    def some(self, number: int) -> Places:
        """An evenly spaced subset."""
        every = np.linspace(0, len(self.cells) - 1, min(number, len(self.cells))).round().astype(np.int64)
        every = np.unique(every)
        return Places(self.seen[:, every], self.cells[every].copy())


def in_the_middle(survey: Survey) -> Survey:
    """The survey reduced to its central views, where it has many."""
    centres = np.array([view.camera.centre[:2] for view in survey.views])
    distance = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    nearest = np.sort(np.argsort(distance, kind="stable")[:_MOST_VIEWS])
    return replace(survey, views=tuple(survey.views[number] for number in nearest))


def places_of(survey: Survey, depth_m: float) -> Places | None:
    """Places of a bed at a depth [m] under the water, or of dry ground; None where too few views overlap."""
    cameras = [view.camera for view in survey.views]
    if survey.water is None:
        height = dry_ground(survey).height
    else:
        x, y = np.mean([camera.centre for camera in cameras], axis=0)[:2]
        height = float(survey.water.height(x, y)) - depth_m
    try:
        seen, cells = coverage(cameras, survey.water, height)
    except ValueError:
        return None
    use = seen.sum(axis=0) >= least_track(len(cameras))
    area = local_area(survey)
    if area is not None:
        use &= within(cells, area)
    return Places(seen[:, use].toarray(), cells[use]) if use.any() else None
