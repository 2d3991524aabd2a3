"""Tests whether two data sets share a coordinate system and a place."""

from __future__ import annotations

import re

import numpy as np
from pyproj import CRS
from pyproj.crs import Datum

from geo.crs import (
    ellipsoid,
    has_height,
    height_unit_m,
    horizontal_crs,
    horizontal_unit,
    prime_meridian_rad,
    vertical_crs,
)
from geo.errors import CRSMismatch, PlaceMismatch, UnsupportedCRS
from geo.grid import plan_box
from geo.projection import MapProjection

# Two statements of one system differ by rounded parameters, e.g. feet to nine digits (0.4 mm at 1,300 km),
# and GRS 80 from WGS 84 by 0.1 mm; really different systems do so by decimetres and more.
_TOLERANCE_M = 0.001
# Bounds this many times as elongated as the same four numbers in the other order are taken to be in that order.
_SIDE_RATIO = 10.0
# Places of easting low, northing low, easting high and northing high among four numbers: of PDAL, and northing first.
_EASTINGS_FIRST = (0, 2, 1, 3)
_NORTHING_FIRST = (1, 0, 3, 2)
_ORDERS_OF_BOUNDS = (_EASTINGS_FIRST, _NORTHING_FIRST, (2, 0, 3, 1))
_SAMPLES_M = np.array([-2e5, 0.0, 3e5])


def crs_difference(a: CRS, b: CRS) -> str | None:
    """Difference of two CRSs in words for a message; None if there is none, as far as is known.

    A part that one of them leaves out (a vertical datum, the name of a datum) counts as equal. The order of axes that
    the authority prefers is ignored: coordinates are always easting, northing, height here.
    """
    if a.equals(b, ignore_axis_order=True):
        return None
    if _horizontal_differs(horizontal_crs(a), horizontal_crs(b)):
        names = [horizontal_crs(crs).name for crs in (a, b)]
        if names[0] == names[1]:
            names = [f"{crs.name} ({crs.axis_info[0].unit_name})" for crs in (a, b)]
        return f"{names[0]} against {names[1]}"
    if not (has_height(a) and has_height(b)):
        return None
    names = [(v.name if (v := vertical_crs(crs)) else "ellipsoidal height") for crs in (a, b)]
    axes = [crs.axis_info[2] for crs in (a, b)]
    if abs(height_unit_m(a) - height_unit_m(b)) > 1e-9 or axes[0].direction != axes[1].direction:
        names = [f"{name} ({axis.unit_name}, {axis.direction})" for name, axis in zip(names, axes, strict=True)]
        return f"heights {names[0]} against {names[1]}"
    if _vertical_differs(vertical_crs(a), vertical_crs(b)):
        return f"heights {names[0]} against {names[1]}"
    return None


def same_crs(a: CRS, b: CRS) -> bool:
    """Whether coordinates in both may be compared, as far as is known; see `crs_difference`."""
    return crs_difference(a, b) is None


def require_same_crs(a: CRS | None, b: CRS | None, a_name: str, b_name: str) -> None:
    """Refuse two data sets whose CRSs are known and differ."""
    difference = crs_difference(a, b) if a is not None and b is not None else None
    if difference:
        raise CRSMismatch(
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

    Parameters
    ----------
    bounds : four numbers, in crs
    places : (N, 2 or more), in crs
        Places that the bounds should contain. Another order is taken if some lie within the bounds in it, and the
        numbers as given contain none of them and are no rectangle, one `_SIDE_RATIO` times as elongated, or a northing
        first.
    """
    stands, box = np.array(bounds).reshape(2, 2), plan_box(places)
    is_rectangle = bool((stands[0] < stands[1]).all())
    for order in _ORDERS_OF_BOUNDS:
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
    axes = ellipsoid(crs)
    return [
        axes.semi_major_metre,
        axes.semi_minor_metre,
        prime_meridian_rad(crs) * axes.semi_major_metre,
        1000.0 * horizontal_unit(crs),
    ]


def _grids_differ(a: CRS, b: CRS) -> bool:
    """Whether places around the origin of the grid of a have other coordinates in b.

    Compared as numbers, because one projection has several notations (EPSG, GDAL, ESRI).
    """
    unit, projection = horizontal_unit(a), a.coordinate_operation
    if projection is None:
        raise UnsupportedCRS(f"{a.name} has no map projection; expected a projected CRS.")
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


def _vertical_differs(a: CRS | None, b: CRS | None) -> bool:
    if a is None or b is None:
        return (a is None) != (b is None)
    return _names_differ(a.datum, b.datum)


def _names_differ(a: Datum | None, b: Datum | None) -> bool:
    """Whether two datums have different names; False where either is unknown."""
    if a is None or b is None:
        return False
    code_a, code_b = (datum.to_json_dict().get("id") for datum in (a, b))
    if code_a and code_b:
        return code_a != code_b
    words_a, words_b = (re.sub("[^a-z0-9]", "", d.name.lower().replace("ensemble", "")) for d in (a, b))
    return words_a != words_b and not words_a.startswith("unknown") and not words_b.startswith("unknown")
