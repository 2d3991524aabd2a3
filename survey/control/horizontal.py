"""Coordinates of control points in another CRS than that of the survey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import called, horizontal_crs
from geo.errors import GeoError
from geo.stated import height_unit_said
from geo.transformation import Transformation, height_scale
from survey.control.content import GivenPoint
from survey.errors import ControlError
from survey.files.column_units import Units
from survey.findings import Findings


def in_crs(points: Sequence[GivenPoint], crs: CRS) -> tuple[list[GivenPoint], Findings]:
    """Points with their coordinates in the crs of a survey; heights keep their datum.

    The findings say what was transformed, and how little well known a transformation is.

    Raises
    ------
    ControlError
        If a point does not lie on the map of crs.
    GeoError
        If heights count from another datum or have no unit, a grid of the best transformation is missing, or PROJ
        knows none.
    """
    done, said = list(points), Findings()
    for source, units in dict.fromkeys((point.crs, point.units) for point in points):
        if source is None and units == Units():
            continue
        of_source = [i for i, point in enumerate(points) if (point.crs, point.units) == (source, units)]
        first, source = points[of_source[0]], crs if source is None else source
        scale = _height_scale(first, source, crs)
        places, added = np.array([points[i].place for i in of_source]), 0.0
        if not horizontal_crs(source).equals(horizontal_crs(crs), ignore_axis_order=True):
            mend = "or give the points in crs"
            what = f"{first.where}: points in {called(source)}"
            way = Transformation.between(source, crs, places)
            way.require_best(what, mend)
            way.require_known(what, mend)
            places = np.column_stack([*way(places[:, 0], places[:, 1]), places[:, 2]])
            added, doubt = way.accuracy_m or 0.0, way.doubt(what)
            heights = "are converted to the unit of crs" if scale != 1.0 else "are taken as heights in crs"
            assumption = (
                f"points in {called(source)} ({first.where}) are transformed to {horizontal_crs(crs).name}; their "
                f"heights {heights}"
            )
            said += Findings((assumption,), () if doubt is None else (doubt,))
        elif scale != 1.0:
            assumption = f"heights of {first.where} are converted by {scale:.7g}, as its columns or CRS name units"
            said += Findings((assumption,))
        places[:, 2] *= scale
        for i, place in zip(of_source, places.tolist(), strict=True):
            if not np.isfinite(place).all():
                raise ControlError(
                    f"{points[i].where}: {points[i].place[0]:.10g}, {points[i].place[1]:.10g} is not on the map of "
                    f"{called(source)} and of {crs.name}; correct the coordinates, their order (easting or longitude "
                    "first) or the CRS of the file"
                )
            done[i] = replace(points[i], place=tuple(place), crs=None, as_read=points[i], datum_std_m=added)
    return done, said


def _height_scale(first: GivenPoint, source: CRS, crs: CRS) -> float:
    """Units of height of crs in one of a file, of which this is a point, by what its header and its CRS say."""
    where = Path(first.where)
    units = first.units.meant(Units.of(source))
    fault = units.plan_fault(Units.of(source))
    if fault is not None:
        raise ControlError(f"{first.where}: {fault}; convert them")
    if first.crs is None:
        return units.height_factor(Units.of(crs))
    unit_m = height_unit_said(source, units.height_m, where, "the unit of its column of heights")
    return height_scale(source, crs, f"{first.where}: the heights of points in {called(source)}", unit_m=unit_m)


def swapped(point: GivenPoint, crs: CRS) -> GivenPoint | None:
    """A point in crs with the first two numbers of its file swapped; None where that is not on the map."""
    given = point.as_read or point
    first, second, height = given.place
    try:
        return in_crs([replace(given, place=(second, first, height))], crs)[0][0]
    except (ControlError, GeoError):
        return None
