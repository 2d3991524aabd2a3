"""Transformation from one CRS into another: choice of the operation, its accuracy, and units.

Everything that enters or leaves a survey in another CRS than its own goes through here: `Transformation` for
horizontal coordinates, `height_scale` for heights. Conversion between the grid of a CRS and its own longitudes and
latitudes, without a change of datum, is in `geo.projection.MapProjection`.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from threading import get_ident

import numpy as np
from pyproj import CRS, Transformer, datadir
from pyproj.exceptions import ProjError
from pyproj.transformer import AreaOfInterest, TransformerGroup

import geo.crs
from geo.errors import GeoError, UnknownUnit


def operations(source: CRS | str, target: CRS | str, area: AreaOfInterest | None) -> TransformerGroup:
    """All operations that PROJ knows between two CRSs, with or without heights, at a place; the best first."""
    # Cached, since a search takes PROJ some 10 ms: anew where a folder of grids was added, and for each thread, since
    # threads must not share transformers.
    first, second = (crs if isinstance(crs, str) else crs.srs for crs in (source, target))
    return _operations(first, second, area, datadir.get_data_dir(), get_ident())


@lru_cache(maxsize=64)
def _operations(source: str, target: str, area: AreaOfInterest | None, _folders: str, _thread: int) -> TransformerGroup:
    with warnings.catch_warnings():
        # pyproj warns of missing grids, which callers name in their own words.
        warnings.simplefilter("ignore", UserWarning)
        return TransformerGroup(source, target, always_xy=True, allow_ballpark=False, area_of_interest=area)


def area_about(lon_deg: float, lat_deg: float, margin_deg: float = 0.01) -> AreaOfInterest:
    """Area of interest about a survey, for PROJ to choose among regional operations."""
    south, north = max(lat_deg - margin_deg, -90.0), min(lat_deg + margin_deg, 90.0)
    return AreaOfInterest(lon_deg - margin_deg, south, lon_deg + margin_deg, north)


def use_grids(folder: Path) -> list[Path]:
    """Let PROJ find the grids (.tif, .gtx) in a folder, for the rest of the process; returns them.

    A grid is found by its own name, e.g. us_nga_egm96_15.tif or, of the same model, egm96_15.gtx.
    """
    if not folder.is_dir():
        return []
    grids = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".tif", ".gtx"))
    known = datadir.get_data_dir().split(os.pathsep)
    if grids and str(folder.resolve()) not in known:
        datadir.append_data_dir(str(folder.resolve()))
    return grids


WGS84 = CRS("EPSG:4326")
# Longitudes and latitudes that change by less pass unchanged: a tenth of a millimetre.
_UNCHANGED_DEG = 1e-9
# Operations with a worse stated accuracy than this are not compared.
_MOST_STATED_M = 100.0
# Two feet differ by 2e-6: units that differ by less are one.
_SAME_UNIT = 1e-9
# GRS 80 and WGS 84 differ by 0.1 mm, others by metres.
_SAME_ELLIPSOID_M = 0.001


@dataclass(frozen=True)
class Transformation:
    """The operation between the horizontal parts of two CRSs that PROJ chooses for a place."""

    source: CRS  # Two-dimensional; easting or longitude first
    target: CRS
    # As PROJ states it; 0 where the datum, or longitudes and latitudes, stay the same; outside the areas of all
    # operations, the largest difference between them; None where it is not known
    accuracy_m: float | None
    # Names of the grids that the best operation needs and PROJ does not have; the operation is then a worse one
    missing_grids: tuple[str, ...]
    is_known: bool  # False where PROJ has no operation: one datum is then taken for the other
    _transformer: Transformer = field(repr=False, compare=False)
    is_outside: bool = False  # Whether the place lies outside the areas of all operations

    @staticmethod
    def between(source: CRS, target: CRS, places: np.ndarray) -> Transformation:
        """The operation for places (N, 2 or 3) in the source; the middle of those that are on its map counts."""
        ends = _with_own_operation(source), _with_own_operation(target)
        source, target = geo.crs.horizontal_crs(source), geo.crs.horizontal_crs(target)
        middle = middle_of(source, np.asarray(places, dtype=np.float64))
        if middle is None:
            return Transformation(source, target, 0.0, (), True, Transformer.from_crs(*ends, always_xy=True))
        found = _chosen(*ends, middle)
        may_be_one = _may_be_one_datum(source, target)
        accuracy = found.accuracy_m
        is_rated = (accuracy is not None or may_be_one) and not found.is_outside and not found.missing_grids
        if is_rated and accuracy != 0.0 and _keeps_degrees(source, target, found._transformer, middle):
            # By convention the WGS 84 of a receiver is the frame of its corrections.
            accuracy = 0.0
        is_known = found.is_known or may_be_one
        return replace(found, source=source, target=target, accuracy_m=accuracy, is_known=is_known)

    def __call__(self, x, y) -> tuple[np.ndarray, np.ndarray]:
        """Easting and northing (N,) in the target of coordinates (N,) in the source; not finite off the map."""
        return self._transformer.transform(x, y)

    def require_best(self, subject: str, remedy: str) -> None:
        """Raise GeoError where a grid of the best operation is missing; ``remedy`` says what else would help."""
        if self.missing_grids:
            raise _missing(subject, self.source, self.target, self.missing_grids, remedy)

    def require_known(self, subject: str, remedy: str) -> None:
        """Raise GeoError where PROJ has no operation: two datums may lie hundreds of metres apart."""
        if not self.is_known:
            raise GeoError(
                f"{subject}: PROJ knows no operation between the datums of {geo.crs.crs_name(self.source)} and "
                f"{geo.crs.crs_name(self.target)}, which may lie hundreds of metres apart; name the datum "
                f"(an EPSG code, or +towgs84 in a PROJ string), {remedy}"
            )

    def warning(self, subject: str) -> str | None:
        """A warning that states the accuracy of the operation where it degrades places; else None."""
        if self.accuracy_m == 0.0 and not self.missing_grids:
            return None
        if self.is_outside and self.accuracy_m is not None:
            return (
                f"{subject} are transformed from {geo.crs.crs_name(self.source)} to {geo.crs.crs_name(self.target)} "
                f"outside the area of each operation that PROJ knows, which are good to {self.accuracy_m:.2g} m there: "
                "an error common to all of them"
            )
        known = "an unknown accuracy" if self.accuracy_m is None else f"an accuracy of {self.accuracy_m:.2g} m by PROJ"
        names = f"{geo.crs.crs_name(self.source)} to {geo.crs.crs_name(self.target)}"
        subject = f"{subject} are transformed from {names} with {known}"
        if self.missing_grids:
            grids = " and ".join(self.missing_grids)
            return (
                f"{subject}; a more accurate one needs {grids}, which is not installed: pyproj sync --file "
                f"{self.missing_grids[0]}"
            )
        return f"{subject}: an error common to all of them"


def transformed(source: CRS, target: CRS, points: np.ndarray, subject: str, remedy: str) -> np.ndarray:
    """Points (N, 3) with horizontal coordinates in the target, by the best operation; heights unchanged."""
    transformation = Transformation.between(source, target, points)
    transformation.require_best(subject, remedy)
    return np.column_stack([*transformation(points[:, 0], points[:, 1]), points[:, 2]])


def height_scale(source: CRS, target: CRS, subject: str, *, unit_m: float | None = None) -> float:
    """Factor that converts heights of the source to the unit of heights of the target, which has heights.

    A source without heights of its own has those of the target, in ``unit_m`` [m] where the program that wrote them
    defines it. Errors name the subject, e.g. "the heights of control points in gcp_list.txt".
    """
    if geo.crs.has_height(source):
        first, second = geo.crs.vertical_crs(source), geo.crs.vertical_crs(target)
        is_one = first is not None and second is not None and (first.equals(second) or first.datum == second.datum)
        if not is_one and not first is second is None:
            names = [part.name if part is not None else "the ellipsoid" for part in (first, second)]
            raise GeoError(
                f"{subject} are above {names[0]}, expected above {names[1]}; convert them, or correct the vertical "
                "part of the CRS"
            )
        return geo.crs.height_unit_m(source) / geo.crs.height_unit_m(target)
    if unit_m is not None:
        return unit_m / geo.crs.height_unit_m(target)
    in_plan = 1.0 if geo.crs.is_geographic(source) else geo.crs.horizontal_unit(source)
    if abs(in_plan / geo.crs.height_unit_m(target) - 1.0) < _SAME_UNIT:
        return 1.0
    if geo.crs.is_geographic(source):
        return 1.0 / geo.crs.height_unit_m(target)
    plan = geo.crs.horizontal_crs(source)
    raise UnknownUnit(
        f"{subject} have no unit: {geo.crs.crs_name(plan)} counts east and north in {plan.axis_info[0].unit_name}, and "
        f"heights of the survey are in {target.axis_info[2].unit_name}; name the CRS with its vertical part, "
        "whose unit counts (of heights above NAVD 88: +5703 in metres, +8228 in feet, +6360 in US survey feet)"
    )


def best_operation(source: CRS, target: CRS, where: str, remedy: str, places: np.ndarray | None = None) -> Transformer:
    """PROJ's best operation between two CRSs with or without heights, if all grids that it needs are there.

    Errors name ``where`` and end with ``remedy``; places (N, 2 or 3) in the source decide between regional operations.
    """
    subject = f"{where}: the transformation from {geo.crs.crs_name(source)} to {geo.crs.crs_name(target)}"
    middle = None if places is None else middle_of(geo.crs.horizontal_crs(source), np.asarray(places, dtype=np.float64))
    try:
        group = operations(source, target, None if middle is None else area_about(*middle.tolist()))
    except ProjError as error:
        why = str(error)[:80]
        raise GeoError(f"{subject} is not known to PROJ ({why}); choose another CRS, {remedy}") from error
    if group.best_available and group.transformers:
        return group.transformers[0]
    missing = [grid.short_name for op in group.unavailable_operations[:1] for grid in op.grids if not grid.available]
    if missing:
        raise _missing(where, source, target, missing, remedy)
    raise GeoError(f"{subject} is not known to PROJ; choose another CRS, {remedy}")


def _missing(subject: str, source: CRS, target: CRS, grids: Sequence[str], remedy: str) -> GeoError:
    return GeoError(
        f"{subject}: the transformation from {geo.crs.crs_name(source)} to {geo.crs.crs_name(target)} needs "
        f"{' and '.join(grids)}, which PROJ does not have; fetch it into its data folder "
        f"(pyproj sync --file {grids[0]}), {remedy}"
    )


def lon_lat(crs: CRS, points: np.ndarray) -> np.ndarray:
    """Longitude and latitude (N, 2) of WGS 84 [deg] of points (N, 2 or 3), to some metres; not finite off the map."""
    points = np.asarray(points, dtype=np.float64)
    return np.column_stack(Transformation.between(crs, WGS84, points)(points[:, 0], points[:, 1]))


def _with_own_operation(crs: CRS) -> CRS:
    """The horizontal part of a CRS, with the transformation to WGS 84 in its text where PROJ knows no other."""
    part = crs.sub_crs_list[0] if crs.is_compound else crs
    if not part.is_bound:
        return geo.crs.horizontal_crs(crs)
    try:
        group = operations(geo.crs.geodetic_crs(part), WGS84, None)
        # Even if the grid of one is missing.
        is_known = bool(group.transformers or group.unavailable_operations)
    except ProjError:
        is_known = False
    return geo.crs.horizontal_crs(crs) if is_known else part.to_2d()


def _may_be_one_datum(a: CRS, b: CRS) -> bool:
    """Whether two CRSs may share a datum: one datum has no name, and the ellipsoids are alike."""
    datums, axes = [geo.crs.geodetic_crs(crs).datum for crs in (a, b)], [geo.crs.ellipsoid(crs) for crs in (a, b)]
    is_nameless = any(datum is None or datum.name.lower().startswith(("unknown", "unnamed")) for datum in datums)
    apart_m = np.ptp([[axis.semi_major_metre, axis.semi_minor_metre] for axis in axes], axis=0)
    return is_nameless and bool((apart_m < _SAME_ELLIPSOID_M).all())


def middle_of(source: CRS, places: np.ndarray) -> np.ndarray | None:
    """Longitude and latitude (2,) [deg], on the source's own datum, of the middle of places; None off the map."""
    if not len(places):
        return None
    own = places[:, :2]
    if not source.is_geographic:
        own = np.column_stack(_projection(source.srs, geo.crs.geodetic_crs(source).srs).transform(*own.T))
    known = np.isfinite(own).all(axis=1)
    if not known.any():
        return None
    unit = geo.crs.geodetic_crs(source).axis_info[0].unit_conversion_factor
    return geo.crs.middle_lon_lat(np.degrees(own[known] * unit))


@lru_cache(maxsize=64)
def _projection(source: str, target: str) -> Transformer:
    return Transformer.from_crs(source, target, always_xy=True)


def _chosen(source: CRS, target: CRS, middle: np.ndarray) -> Transformation:
    """PROJ's best available operation, with its accuracy and the missing grids of a better one."""

    def chosen(operation: Transformer, accuracy: float | None, is_known: bool = True) -> Transformation:
        return Transformation(source, target, accuracy, missing, is_known, operation)

    area = area_about(*middle.tolist())
    try:
        group = operations(source, target, area)
        better = () if group.best_available else group.unavailable_operations[:1]
        missing = tuple(grid.short_name for operation in better for grid in operation.grids if not grid.available)
        if group.transformers:
            best = group.transformers[0]
            return chosen(best, best.accuracy if best.accuracy >= 0.0 else None)
        elsewhere: list[Transformer] = []
        with suppress(ProjError):
            elsewhere = [] if missing else operations(source, target, None).transformers
        if elsewhere:
            return replace(chosen(elsewhere[0], _spread_m(elsewhere, source, target, middle)), is_outside=True)
        # An unknown datum is taken to be that of the other CRS.
        transformer = Transformer.from_crs(source, target, always_xy=True, area_of_interest=area)
        return chosen(transformer, None, is_known=bool(missing))
    except ProjError as error:
        raise GeoError(
            f"the transformation from {geo.crs.crs_name(source)} to {geo.crs.crs_name(target)} is not known to PROJ "
            f"({str(error)[:80]}); choose another CRS"
        ) from error


def _spread_m(candidates: list[Transformer], source: CRS, target: CRS, middle: np.ndarray) -> float | None:
    """Largest difference [m] of other operations from the first, at a place outside all areas; None with one only.

    At least the accuracy that is stated for the first in its own area.
    """
    rated = [candidate for candidate in candidates if 0.0 <= candidate.accuracy <= _MOST_STATED_M]
    if len(rated) < 2 or candidates[0] not in rated:
        return None
    places = np.array([_degrees_by(candidate, source, target, middle) for candidate in rated])
    unit = geo.crs.geodetic_crs(target).axis_info[0].unit_conversion_factor
    offsets = (places - places[rated.index(candidates[0])]) * unit * geo.crs.EARTH_RADIUS_M
    offsets[:, 0] *= np.cos(places[:, 1] * unit)
    far = np.hypot(*offsets.T)
    return float(max(far[np.isfinite(far)].max(initial=0.0), candidates[0].accuracy))


def _keeps_degrees(source: CRS, target: CRS, transformer: Transformer, middle: np.ndarray) -> bool:
    """Whether longitude and latitude stay what they are."""
    ends = (geo.crs.geodetic_crs(source), geo.crs.geodetic_crs(target))
    if any(abs(np.degrees(end.axis_info[0].unit_conversion_factor) - 1.0) > _SAME_UNIT for end in ends):
        return False
    return bool(np.abs(_degrees_by(transformer, source, target, middle) - middle).max() < _UNCHANGED_DEG)


def _degrees_by(transformer: Transformer, source: CRS, target: CRS, middle: np.ndarray) -> np.ndarray:
    """Longitude and latitude (2,) of a place in the target by an operation, from those in the source."""
    x, y = middle
    if not source.is_geographic:
        x, y = _projection(geo.crs.geodetic_crs(source).srs, source.srs).transform(x, y)
    x, y = transformer.transform(x, y)
    if not target.is_geographic:
        x, y = _projection(target.srs, geo.crs.geodetic_crs(target).srs).transform(x, y)
    return np.array([x, y])
