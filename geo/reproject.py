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

from geo.area_of_use import require_in_area
from geo.crs import crs_of, has_height, horizontal_crs, is_geographic, parse_crs, vertical_crs
from geo.errors import UnknownCRS, UnsupportedCRS
from geo.projection import nan_unless_finite
from geo.transformation import Transformation, best_operation

_HALF_TURN, _TURN = 180.0, 360.0
_REMEDY = "or name a horizontal CRS alone, which keeps the heights as they are."


def crosses(lonlat: np.ndarray) -> bool:
    """Whether places (N, 2 or more) [deg] of a survey lie on both sides of the meridian of 180 degrees."""
    longitude = lonlat[np.isfinite(lonlat[:, 0]), 0]
    return len(longitude) > 0 and float(np.ptp(longitude)) > _HALF_TURN


def cut_line(line: np.ndarray) -> list[np.ndarray]:
    """The parts of a line (N, 2) [deg] on both sides, in their order; the line itself where it does not cross."""
    if not crosses(line):
        return [line]
    return [_wrapped(chain, east) for chain, east in _split_line(_unwrapped(line))]


def cut_polygon(rings: list[np.ndarray]) -> list[list[np.ndarray]]:
    """The parts of a polygon on both sides, each as its closed rings (N, 2) [deg] with the outer one first."""
    if not any(crosses(ring) for ring in rings) and not crosses(np.concatenate(rings)):
        return [rings]
    unwrapped = [_unwrapped(ring) for ring in rings]
    return [polygon for east in (False, True) for polygon in _polygons_on_side(unwrapped, east)]


def _unwrapped(line: np.ndarray) -> np.ndarray:
    """The line with longitudes from 0 to 360 degrees, without a jump at the meridian."""
    line = np.array(line, dtype=np.float64)
    line[line[:, 0] < 0.0, 0] += _TURN
    return line


def _wrapped(line: np.ndarray, east: bool) -> np.ndarray:
    """The line with longitudes from -180 degrees on where it lies east of the meridian."""
    return line - [_TURN, 0.0] if east else line


def _split_line(line: np.ndarray) -> list[tuple[np.ndarray, bool]]:
    """Pieces of a line that lie on one side each, with their ends on the meridian, and whether that is the eastern."""
    side = line[:, 0] > _HALF_TURN
    pieces, start = [], 0
    head: list[np.ndarray] = []
    for at in np.flatnonzero(side[1:] != side[:-1]) + 1:
        (x0, y0), (x1, y1) = line[at - 1], line[at]
        on_it = np.array([[_HALF_TURN, y0 + (y1 - y0) * (_HALF_TURN - x0) / (x1 - x0)]])
        pieces.append((np.concatenate([*head, line[start:at], on_it]), bool(side[at - 1])))
        head, start = [on_it], int(at)
    pieces.append((np.concatenate([*head, line[start:]]), bool(side[-1])))
    return pieces


def _polygons_on_side(rings: list[np.ndarray], east: bool) -> list[list[np.ndarray]]:
    """The part of a polygon on one side.

    Its border consists of pieces of rings, joined along the meridian. Sorted by latitude, the first and second end on
    the meridian bound a stretch of the inside, the third and fourth the next, and so on.
    """
    chains: list[np.ndarray] = []
    holes: list[np.ndarray] = []
    outer: list[np.ndarray] = []
    for number, ring in enumerate(rings):
        pieces = _split_line(ring)
        if len(pieces) == 1:
            if pieces[0][1] == east:
                (holes if number else outer).append(ring)
            continue
        # Rings are closed: the last piece continues with the first.
        joined = np.concatenate([pieces[-1][0], pieces[0][0][1:]])
        chains += [chain for chain, side in [(joined, pieces[0][1]), *pieces[1:-1]] if side == east]
    ends = np.array([[chain[0, 1], chain[-1, 1]] for chain in chains]).reshape(-1)
    order = np.argsort(ends, kind="stable")
    partner = np.empty(len(ends), dtype=np.int64)
    partner[order] = order.reshape(-1, 2)[:, ::-1].reshape(-1)
    left = set(range(len(chains)))
    while left:
        parts, at = [], first = [], min(left)
        end = 0
        while at in left:
            left.remove(at)
            parts.append(chains[at] if end == 0 else chains[at][::-1])
            # From the end of this piece along the meridian to the end that bounds the same stretch.
            at, end = divmod(int(partner[2 * at + 1 - end]), 2)
        outer.append(np.concatenate([*parts, chains[first][:1]]))
    polygons = [[ring] for ring in outer]
    for hole in holes:
        next(p for p in polygons if _contains(p[0], hole[0])).append(hole)
    return [[_wrapped(ring, east) for ring in polygon] for polygon in polygons]


def _contains(ring: np.ndarray, place: np.ndarray) -> bool:
    """Whether a place lies in a closed ring, by the parity of crossings of a line to the north."""
    (x0, y0), (x1, y1) = ring[:-1].T, ring[1:].T
    spans = (x0 > place[0]) != (x1 > place[0])
    above = y0[spans] + (y1 - y0)[spans] * (place[0] - x0[spans]) / (x1 - x0)[spans] > place[1]
    return bool(above.sum() % 2)


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

        Parameters
        ----------
        target : str or pyproj.CRS
            EPSG code, WKT or PROJ string, e.g. "EPSG:32632" or "EPSG:4326+5773".
        where : str
            What errors name.
        places : (N, 2 or 3), optional
            In the source, of the survey: they decide between regional operations.
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
            raise UnsupportedCRS(
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
        raise UnknownCRS(
            f'{where} is "{str(target)[:80]}", which is not a known coordinate reference system; give an EPSG code '
            'such as "EPSG:32632", WKT or a PROJ string.'
        ) from error
    if has_height(target_crs) or not (target_crs.is_projected or target_crs.is_geographic):
        return parse_crs(target_crs, where=where)
    vertical = vertical_crs(source)
    with_height = (
        target_crs.to_3d()
        if vertical is None
        else CompoundCRS(f"{target_crs.name} + {vertical.name}", [target_crs, vertical])
    )
    return parse_crs(with_height, where=where)


def has_same_heights(source: CRS, target: CRS) -> bool:
    """Whether both count heights from the same surface and in the same unit."""
    before, after = vertical_crs(source), vertical_crs(target)
    if before is None or after is None:
        same_ellipsoid = horizontal_crs(source).geodetic_crs == horizontal_crs(target).geodetic_crs
        same_unit = source.axis_info[2].unit_conversion_factor == target.axis_info[2].unit_conversion_factor
        return before is after is None and same_ellipsoid and same_unit
    return before.equals(after)
