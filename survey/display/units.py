"""The unit of lengths in reports: metres, or the feet of a CRS."""

from __future__ import annotations

from pyproj import CRS

from geo.crs import height_unit_m, horizontal_unit

_FOOT_M = 0.3048
# Of a foot: the kinds that surveys use differ by some parts in a million.
_ALIKE = 1e-4


def foot_m(units: str | None, crs: CRS) -> float | None:
    """The length of the foot that lengths are shown in [m], None for metres.

    Parameters
    ----------
    units : "metres", "feet" or None
        None leaves it to the CRS; "feet" are those of the CRS, else international ones.
    crs : pyproj.CRS
        With a height.
    """
    if units == "metres":
        return None
    of_crs = [unit for unit in (height_unit_m(crs), horizontal_unit(crs)) if abs(unit / _FOOT_M - 1.0) < _ALIKE]
    if of_crs:
        return of_crs[0]
    return _FOOT_M if units == "feet" else None
