"""Whether two data sets share a coordinate system and a place, and points of one in the system of another.

`Reprojection` transforms horizontal coordinates by PROJ; heights stay as they are where both systems count them from
the same datum. Between two vertical datums the grid of one of them is needed, and without it an error is raised.

The approximate geoid undulation recognises which vertical datums were mixed up, where heights differ by tens of metres;
nothing is transformed with it. It is EGM96 (National Geospatial-Intelligence Agency, public domain) at every fifth
degree, in whole metres: interpolated, it is within 2 m (rms) of the model, and within 8 m over 99 % of the Earth.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any, cast

import numpy as np
from pyproj import CRS, Geod, Transformer
from pyproj.crs import CompoundCRS, Datum
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError, ProjError
from scipy.ndimage import map_coordinates

import geo.crs
from geo.errors import GeoError, PlaceMismatch
from geo.grid import plan_box
from geo.projection import MapProjection, nan_unless_finite
from geo.transformation import Transformation, area_about, best_operation, lon_lat, middle_of, operations

# Two statements of one system differ by rounded parameters, e.g. feet to nine digits (0.4 mm at 1,300 km),
# and GRS 80 from WGS 84 by 0.1 mm; really different systems do so by decimetres and more.
_TOLERANCE_M = 0.001
# Bounds this many times as elongated as the same four numbers in the other order are taken to be in that order.
_SIDE_RATIO = 10.0
# Places of easting low, northing low, easting high and northing high among four numbers: of PDAL, and northing first.
_EASTINGS_FIRST, _NORTHING_FIRST, _NORTHINGS_FIRST = (0, 2, 1, 3), (1, 0, 3, 2), (2, 0, 3, 1)
_SAMPLES_M = np.array([-2e5, 0.0, 3e5])


def crs_difference(a: CRS, b: CRS) -> str | None:
    """Difference of two CRSs in words for a message; None if there is none, as far as is known.

    A part that one of them leaves out (a vertical datum, the name of a datum) counts as equal; the order of axes does
    not count.
    """
    if a.equals(b, ignore_axis_order=True):
        return None
    if _horizontal_differs(geo.crs.horizontal_crs(a), geo.crs.horizontal_crs(b)):
        names = [geo.crs.horizontal_crs(crs).name for crs in (a, b)]
        if names[0] == names[1]:
            names = [f"{crs.name} ({crs.axis_info[0].unit_name})" for crs in (a, b)]
        return f"{names[0]} against {names[1]}"
    if not (geo.crs.has_height(a) and geo.crs.has_height(b)):
        return None
    names = [(v.name if (v := geo.crs.vertical_crs(crs)) else "ellipsoidal height") for crs in (a, b)]
    axes = [crs.axis_info[2] for crs in (a, b)]
    if abs(geo.crs.height_unit_m(a) - geo.crs.height_unit_m(b)) > 1e-9 or axes[0].direction != axes[1].direction:
        names = [f"{name} ({axis.unit_name}, {axis.direction})" for name, axis in zip(names, axes, strict=True)]
        return f"heights {names[0]} against {names[1]}"
    first, second = geo.crs.vertical_crs(a), geo.crs.vertical_crs(b)
    is_one_ellipsoidal = (first is None) != (second is None)
    if is_one_ellipsoidal or (first and second and _names_differ(first.datum, second.datum)):
        return f"heights {names[0]} against {names[1]}"
    return None


def require_same_crs(a: CRS | None, b: CRS | None, a_name: str, b_name: str) -> None:
    """Refuse two data sets whose CRSs are known and differ."""
    difference = crs_difference(a, b) if a is not None and b is not None else None
    if difference:
        raise GeoError(
            f"{a_name} and {b_name} are in different coordinate reference systems: {difference}; convert one "
            "to the system of the other first, with the grid of the vertical datum where heights differ."
        )


def require_same_place(a: np.ndarray, b: np.ndarray, a_name: str, b_name: str) -> None:
    """Refuse two sets of points (N, 3) and (M, 3), in crs, whose horizontal boxes do not touch."""
    box_a, box_b = plan_box(a), plan_box(b)
    if _overlap(box_a, box_b):
        return
    remedy = "check that both are in the same coordinate reference system and of the same place"
    if _overlap(box_a, box_b[:, ::-1]):
        remedy = f"easting and northing seem to be swapped in one of them: swap them in {b_name}"
    raise PlaceMismatch(
        f"{a_name} (easting {_range(box_a[:, 0])}, northing {_range(box_a[:, 1])}) and {b_name} (easting "
        f"{_range(box_b[:, 0])}, northing {_range(box_b[:, 1])}) do not overlap; {remedy}."
    )


def bounds_in_other_order(bounds: tuple[float, ...], places: np.ndarray) -> tuple[float, ...] | None:
    """Bounds as (E0, N0, E1, N1) where they were given in another order that programs have; else None.

    Another order is taken if some of the places (N, 2 or more) that they should contain lie within them in it, and the
    numbers as given contain none and are no rectangle, one `_SIDE_RATIO` times as elongated, or a northing first.
    """
    stands, box = np.array(bounds).reshape(2, 2), plan_box(places)
    is_rectangle = bool((stands[0] < stands[1]).all())
    for order in (_EASTINGS_FIRST, _NORTHING_FIRST, _NORTHINGS_FIRST):
        meant = tuple(bounds[i] for i in order)
        other = np.array(meant).reshape(2, 2)
        if not (other[0] < other[1]).all() or not _overlap(other, box):
            continue
        if order == _EASTINGS_FIRST:
            is_doubtful = not is_rectangle or np.ptp(stands, axis=0).max() > _SIDE_RATIO * np.ptp(other, axis=0).max()
        elif order == _NORTHING_FIRST:
            is_doubtful = not _overlap(stands, box)
        else:
            is_doubtful = not is_rectangle
        if is_doubtful:
            return meant
    return None


def _overlap(a: np.ndarray, b: np.ndarray) -> bool:
    return bool((a[0] <= b[1]).all() and (b[0] <= a[1]).all())


def _range(ends: np.ndarray) -> str:
    return f"{ends[0]:.10g} to {ends[1]:.10g}"


def _horizontal_differs(a: CRS, b: CRS) -> bool:
    if a.is_geographic != b.is_geographic or _names_differ(a.datum, b.datum):
        return True
    if not all(crs.is_projected or crs.is_geographic for crs in (a, b)):
        # A site grid, or heights alone, has no parameters that place it on the Earth: only its text can be compared.
        return not a.equals(b, ignore_axis_order=True)
    return not np.allclose(_frame_numbers(a), _frame_numbers(b), rtol=0.0, atol=_TOLERANCE_M) or (
        not a.is_geographic and _grids_differ(a, b)
    )


def _frame_numbers(crs: CRS) -> list[float]:
    """Semi-axes [m], prime meridian [m on the equator] and unit (of 1000 m, or of a turn)."""
    a, b = geo.crs.ellipsoid(crs).semi_major_metre, geo.crs.ellipsoid(crs).semi_minor_metre
    return [a, b, geo.crs.prime_meridian_rad(crs) * a, 1000.0 * geo.crs.horizontal_unit(crs)]


def _grids_differ(a: CRS, b: CRS) -> bool:
    """Whether places around the origin of the grid of a have other coordinates in b, whatever their notations."""
    unit, projection = geo.crs.horizontal_unit(a), a.coordinate_operation
    if projection is None:
        raise GeoError(f"{a.name} has no map projection; expected a projected CRS.")
    false_origin = [
        # Lengths, though pyproj's stubs say str: only names of grid files are text.
        sum(float(p.value) * p.unit_conversion_factor for p in projection.params if word in p.name.lower())
        for word in ("easting", "northing")
    ]
    x, y = np.meshgrid(*(origin + _SAMPLES_M for origin in false_origin))
    in_a = np.stack([x / unit, y / unit, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    in_b = MapProjection(b.to_3d()).crs_from_geodetic(*MapProjection(a.to_3d()).geodetic_from_crs(in_a))
    distances = np.linalg.norm(in_a - in_b, axis=-1) * unit
    return not np.nanmax(distances, initial=np.inf if np.isnan(distances).all() else 0.0) <= _TOLERANCE_M


def _names_differ(a: Datum | None, b: Datum | None) -> bool:
    """Whether two datums have different names; False where either is unknown."""
    if a is None or b is None:
        return False
    code_a, code_b = (datum.to_json_dict().get("id") for datum in (a, b))
    if code_a and code_b:
        return code_a != code_b
    words_a, words_b = (re.sub("[^a-z0-9]", "", d.name.lower().replace("ensemble", "")) for d in (a, b))
    return words_a != words_b and not words_a.startswith("unknown") and not words_b.startswith("unknown")


# Areas wider than this are worldwide: mean sea level and its models, tides.
_WORLDWIDE_DEG = 350.0


def require_in_area(crs: CRS, points: np.ndarray, subject: str, where: str = "crs") -> None:
    """Raise PlaceMismatch, which names ``where``, if the middle of points (N, 2 or 3) lies far outside the area."""
    middle = middle_of(geo.crs.horizontal_crs(crs), np.asarray(points, dtype=np.float64))
    if middle is not None:
        _require_in_area(crs, np.radians(middle), subject, where)


def require_at(crs: CRS, lon_lat_deg: np.ndarray, subject: str, where: str) -> None:
    """Raise PlaceMismatch as `require_in_area`, for longitudes and latitudes (N, 2) of WGS 84 [deg]."""
    if len(lon_lat_deg):
        east, north = geo.crs.middle_lon_lat(lon_lat_deg).tolist()
        lon, lat = np.radians([east, north])
        subject += f" (about latitude {north:.3f}, longitude {east:.3f})"
        _require_in_area(crs, np.array([lon - geo.crs.prime_meridian_rad(crs), lat]), subject, where)


def _require_in_area(crs: CRS, middle: np.ndarray, subject: str, where: str) -> None:
    lon, lat = middle.tolist()
    excess = geo.crs.degrees_outside_area(crs, lon, lat)
    if excess > geo.crs.AREA_MARGIN_DEG:
        raise PlaceMismatch(
            f"{subject} lie {excess:.0f} degrees outside the area that {crs.name} is made for; choose the CRS of the "
            f"place ({where})"
        )


@cache
def height_systems_at(lat_deg: float, lon_deg: float) -> tuple[CRS, ...]:
    """National vertical CRSs in metres at a place, the smallest area of use first.

    Only those whose geoid PROJ knows (its grid need not be installed), and of each area the newest (the highest EPSG
    code). PROJ has areas as rectangles: near a border those of the neighbours are among them.
    """
    area: Any = area_about(lon_deg, lat_deg)  # The stubs of pyproj have two types for one class
    newest: dict[tuple[float, ...], tuple[float, int]] = {}
    for info in query_crs_info("EPSG", PJType.VERTICAL_CRS, area, contains=True):
        use, code = info.area_of_use, int(info.code)
        width = _WORLDWIDE_DEG if use is None else (use.east - use.west) % 360.0 or 360.0
        if use is None or width >= _WORLDWIDE_DEG or not _is_national(code, area):
            continue
        newest[use.bounds] = max(newest.get(use.bounds, (0.0, 0)), (width * (use.north - use.south), code))
    # The code decides between areas of equal size.
    return tuple(CRS.from_epsg(code) for _, code in sorted(newest.values()))


def likely_crs(points: np.ndarray, lon_lat_deg: tuple[float, float], within_m: float, like: CRS) -> list[CRS]:
    """Projected CRSs in which points (N, 2 or 3) lie about a place, by the median: the datum of ``like`` first."""
    lon, lat = lon_lat_deg
    found, area = [], cast("Any", area_about(lon, lat))
    for info in query_crs_info("EPSG", PJType.PROJECTED_CRS, area, contains=True):
        crs = CRS.from_epsg(int(info.code))
        try:
            east, north = lon_lat(crs, points[:, :2]).T
        except (GeoError, ProjError):
            continue
        finite = np.isfinite(east) & np.isfinite(north) & (np.abs(north) <= 90.0)
        if not finite.any():
            continue
        places = np.broadcast_to([[lon], [lat]], (2, finite.sum()))
        away_m = float(np.median(Geod(ellps="WGS84").inv(east[finite], north[finite], *places)[2]))
        if away_m <= within_m:
            # Of a grid with its axes swapped, only the name differs here.
            is_other = geo.crs.geodetic_crs(crs) != geo.crs.geodetic_crs(like) or "(N-E)" in crs.name
            found.append((is_other, round(away_m, -2), int(info.code), crs))
    return [crs for *_, crs in sorted(found, key=lambda item: item[:3])]


def _is_national(code: int, area: Any) -> bool:
    """Whether a vertical CRS counts metres upwards from a geoid that PROJ knows at the place."""
    vertical = CRS.from_epsg(code)
    axis = vertical.axis_info[0]
    if axis.direction != "up" or axis.unit_conversion_factor != 1.0:
        return False
    compound = CompoundCRS(f"WGS 84 + {vertical.name}", ["EPSG:4326", vertical])
    try:
        group = operations("EPSG:4979", compound, area)
    except ProjError:
        return False
    steps = [transformer.definition for transformer in group.transformers]
    steps += [operation.to_proj4() for operation in group.unavailable_operations]
    return any("vgridshift" in text for text in steps)


# Heights of the geoid (37, 72) [m], from 90 degrees south and 180 degrees west.
_GEOID, _STEP_DEG = "undulation.npy", 5.0


def approximate_undulation_m(lat_deg: float, lon_deg: float) -> float:
    """Approximate height of the geoid over the WGS 84 ellipsoid at a place [m]: in Denmark, and south of India.

    >>> round(approximate_undulation_m(55.0, 10.0)), round(approximate_undulation_m(5.0, 80.0))
    (40, -106)
    """
    with files("geo").joinpath(_GEOID).open("rb") as stream:
        grid = np.load(stream).astype(np.float64)
    at = [[(lat_deg + 90.0) / _STEP_DEG], [(lon_deg + 180.0) % 360.0 / _STEP_DEG]]
    # After the last meridian comes the first.
    return float(map_coordinates(np.column_stack([grid, grid[:, 0]]), at, order=1, mode="nearest")[0])


def crosses(lonlat: np.ndarray) -> bool:
    """Whether places (N, 2 or more) [deg] of a survey lie on both sides of the meridian of 180 degrees."""
    longitude = lonlat[np.isfinite(lonlat[:, 0]), 0]
    return len(longitude) > 0 and float(np.ptp(longitude)) > 180.0


@dataclass(frozen=True)
class Reprojection:
    """Transformation from one CRS with heights to another: places by PROJ, and heights where their datum changes."""

    crs: CRS  # In which points come out, with a vertical part
    keeps_height: bool  # Whether heights stay as they are
    warning: str | None  # A sentence: where places or heights are less well known in it, as PROJ states
    _transformer: Transformer = field(repr=False, compare=False)
    _where: str | None = field(repr=False, compare=False)  # In errors about places off the area; None: places stay

    @staticmethod
    def between(
        source: CRS, target: str | CRS, *, where: str = "crs", places: np.ndarray | None = None
    ) -> Reprojection:
        """Transformation from a CRS with heights to one with heights, or to a horizontal one, which keeps the heights.

        Errors name ``where``; places (N, 2 or 3) of the survey, in the source, decide between regional operations.
        """
        target = _with_height(source, target, where)
        plan = geo.crs.horizontal_crs(source), geo.crs.horizontal_crs(target)
        keeps_height = has_same_heights(source, target)
        remedy = "or name a horizontal CRS alone, which keeps the heights as they are."
        operation = best_operation(*(plan if keeps_height else (source, target)), where, remedy, places)
        warning = None
        if places is not None:
            in_plan = Transformation.between(source, target, places)
            warning = in_plan.warning(f"{where}: places")
            if in_plan.accuracy_m == 0.0 and not keeps_height and operation.accuracy > 0.0:
                warning = (
                    f"{where}: heights are transformed by {operation.description} with an accuracy of "
                    f"{operation.accuracy:.2g} m by PROJ: an error common to all of them"
                )
        stays = plan[0].equals(plan[1], ignore_axis_order=True)
        return Reprojection(target, keeps_height, warning, operation, None if stays else where)

    @property
    def height_std_m(self) -> float:
        """Accuracy of heights that PROJ states for the operation; 0 where they stay, or nothing is stated."""
        return 0.0 if self.keeps_height else max(self._transformer.accuracy, 0.0)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) in the source CRS as points (N, 3) float64 in `crs`; NaN where PROJ has no answer."""
        east, north, height = np.asarray(points, dtype=np.float64).T
        if self.keeps_height:
            east, north = self._transformer.transform(east, north)
        else:
            east, north, height = self._transformer.transform(east, north, height)
        turned = nan_unless_finite(np.stack([east, north, height], axis=-1))
        if geo.crs.is_geographic(self.crs) and crosses(turned):
            raise GeoError(
                f"the survey lies on the meridian of 180 degrees, where the longitudes of {self.crs.name} jump; choose "
                "a projected CRS of the place, e.g. UTM zone 1 or 60; GeoJSON of lines and areas is cut there."
            )
        if self._where is not None:
            require_in_area(self.crs, turned, "the points", self._where)
        return turned


def _with_height(source: CRS, target: str | CRS, where: str) -> CRS:
    """The target as a CRS with heights: its own, else those of the source."""
    try:
        target_crs = geo.crs.crs_of(target)
    except CRSError as error:
        raise GeoError(
            f'{where} is "{str(target)[:80]}", which is not a known coordinate reference system; give an EPSG code '
            'such as "EPSG:32632", WKT or a PROJ string.'
        ) from error
    if not geo.crs.has_height(target_crs) and (target_crs.is_projected or target_crs.is_geographic):
        vertical = geo.crs.vertical_crs(source)
        compound = vertical and CompoundCRS(f"{target_crs.name} + {vertical.name}", [target_crs, vertical])
        target_crs = compound or target_crs.to_3d()
    return geo.crs.parse_crs(target_crs, where=where)


def has_same_heights(source: CRS, target: CRS) -> bool:
    """Whether both count heights from the same surface and in the same unit."""
    before, after = geo.crs.vertical_crs(source), geo.crs.vertical_crs(target)
    if before is None or after is None:
        same_ellipsoid = geo.crs.horizontal_crs(source).geodetic_crs == geo.crs.horizontal_crs(target).geodetic_crs
        return (
            before is after is None
            and same_ellipsoid
            and geo.crs.height_unit_m(source) == geo.crs.height_unit_m(target)
        )
    return before.equals(after)
