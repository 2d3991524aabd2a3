"""Reprojection of points from the CRS of a survey into another, and lines cut at the antimeridian.

Horizontal coordinates are transformed by PROJ, heights stay as they are where both systems count them from the same
datum; between two vertical datums the grid of one of them is needed, and without it an error is raised.

Lines and polygons in degrees that cross the meridian of 180 degrees are cut there (RFC 7946, section 3.1.9).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError
from shapely import LineString, Polygon
from shapely.ops import split

from geo.compatibility import require_in_area
from geo.crs import crs_of, has_height, height_unit_m, horizontal_crs, is_geographic, parse_crs, vertical_crs
from geo.errors import GeoError
from geo.projection import nan_unless_finite
from geo.transformation import Transformation, best_operation

_HALF_TURN, _TURN = 180.0, 360.0
_MERIDIAN = LineString([(_HALF_TURN, -90.0), (_HALF_TURN, 90.0)])
_REMEDY = "or name a horizontal CRS alone, which keeps the heights as they are."


def crosses(lonlat: np.ndarray) -> bool:
    """Whether places (N, 2 or more) [deg] of a survey lie on both sides of the meridian of 180 degrees."""
    longitude = lonlat[np.isfinite(lonlat[:, 0]), 0]
    return len(longitude) > 0 and float(np.ptp(longitude)) > _HALF_TURN


def cut_line(line: np.ndarray) -> list[np.ndarray]:
    """The parts of a line (N, 2) [deg] on both sides, in their order; the line itself where it does not cross."""
    return [part[0] for part in _cut(LineString(_unwrapped(line)))] if crosses(line) else [line]


def cut_polygon(rings: list[np.ndarray]) -> list[list[np.ndarray]]:
    """The parts of a polygon on both sides, each as its closed rings (N, 2) [deg] with the outer one first."""
    if not crosses(np.concatenate(rings)):
        return [rings]
    outer, *holes = (_unwrapped(ring) for ring in rings)
    return _cut(Polygon(outer, holes))


def _unwrapped(line: np.ndarray) -> np.ndarray:
    """The line with longitudes from 0 to 360 degrees, without a jump at the meridian."""
    line = np.array(line, dtype=np.float64)
    line[line[:, 0] < 0.0, 0] += _TURN
    return line


def _cut(shape: LineString | Polygon) -> list[list[np.ndarray]]:
    """The parts of a shape on both sides of 180 degrees, each as its lines (N, 2) with longitudes of -180 to 180."""
    parts = []
    for part in split(shape, _MERIDIAN).geoms:
        east = _TURN if part.representative_point().x > _HALF_TURN else 0.0
        lines = [part] if isinstance(part, LineString) else [part.exterior, *part.interiors]
        parts.append([np.array(line.coords) - [east, 0.0] for line in lines])
    return parts


@dataclass(frozen=True)
class Reprojection:
    """Transformation from one CRS with heights to another."""

    crs: CRS  # In which points come out, with a vertical part
    keeps_height: bool  # Whether heights stay as they are
    _transformer: Transformer = field(repr=False, compare=False)
    _changes_plan: bool = field(repr=False, compare=False)
    _where: str = field(repr=False, compare=False)
    warning: str | None = None  # a sentence, or None: where places or heights are less well known in it, as PROJ states

    @staticmethod
    def between(
        source: CRS, target: str | CRS, *, where: str = "crs", places: np.ndarray | None = None
    ) -> Reprojection:
        """Transformation from a CRS with heights to one with heights, or to a horizontal one, which keeps the heights.

        Errors name ``where``; places (N, 2 or 3) of the survey, in the source, decide between regional operations.
        """
        target_crs = _with_height(source, target, where)
        keeps_height = has_same_heights(source, target_crs)
        ends = (horizontal_crs(source), horizontal_crs(target_crs)) if keeps_height else (source, target_crs)
        changes_plan = not horizontal_crs(source).equals(horizontal_crs(target_crs), ignore_axis_order=True)
        operation = best_operation(*ends, where, _REMEDY, places)
        warning = None if places is None else _warning(source, target_crs, operation, where, places)
        return Reprojection(target_crs, keeps_height, operation, changes_plan, where, warning)

    @property
    def height_std_m(self) -> float:
        """Accuracy of heights that PROJ states for the operation; 0 where they stay, or nothing is stated."""
        return 0.0 if self.keeps_height else max(self._transformer.accuracy, 0.0)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) in the source CRS as points (N, 3) float64 in `crs`; NaN where PROJ has no answer."""
        points = np.asarray(points, dtype=np.float64)
        if self.keeps_height:
            east, north = self._transformer.transform(points[:, 0], points[:, 1])
            height = points[:, 2]
        else:
            east, north, height = self._transformer.transform(*points.T)
        turned = nan_unless_finite(np.stack([east, north, height], axis=-1))
        if is_geographic(self.crs) and crosses(turned):
            raise GeoError(
                f"the survey lies on the meridian of 180 degrees, where the longitudes of {self.crs.name} jump; choose "
                "a projected CRS of the place, e.g. UTM zone 1 or 60; GeoJSON of lines and areas is cut there."
            )
        if self._changes_plan:
            require_in_area(self.crs, turned, "the points", self._where)
        return turned


def _warning(source: CRS, target: CRS, operation: Transformer, where: str, places: np.ndarray) -> str | None:
    """A warning where the operation makes places or heights less accurate, as PROJ states."""
    in_plan = Transformation.between(source, target, places)
    if in_plan.accuracy_m == 0.0 and not has_same_heights(source, target) and operation.accuracy > 0.0:
        return (
            f"{where}: heights are transformed by {operation.description} with an accuracy of "
            f"{operation.accuracy:.2g} m by PROJ: an error common to all of them"
        )
    return in_plan.warning(f"{where}: places")


def _with_height(source: CRS, target: str | CRS, where: str) -> CRS:
    """The target as a CRS with heights: its own, else those of the source."""
    try:
        target_crs = crs_of(target)
    except CRSError as error:
        raise GeoError(
            f'{where} is "{str(target)[:80]}", which is not a known coordinate reference system; give an EPSG code '
            'such as "EPSG:32632", WKT or a PROJ string.'
        ) from error
    if not has_height(target_crs) and (target_crs.is_projected or target_crs.is_geographic):
        vertical = vertical_crs(source)
        compound = vertical and CompoundCRS(f"{target_crs.name} + {vertical.name}", [target_crs, vertical])
        target_crs = compound or target_crs.to_3d()
    return parse_crs(target_crs, where=where)


def has_same_heights(source: CRS, target: CRS) -> bool:
    """Whether both count heights from the same surface and in the same unit."""
    before, after = vertical_crs(source), vertical_crs(target)
    if before is None or after is None:
        same_ellipsoid = horizontal_crs(source).geodetic_crs == horizontal_crs(target).geodetic_crs
        return before is after is None and same_ellipsoid and height_unit_m(source) == height_unit_m(target)
    return before.equals(after)
