"""Coordinates of control points in another CRS than that of the survey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pyproj import CRS

from geo.crs import called, horizontal_crs
from geo.errors import GeoError
from geo.transformation import Transformation, height_scale
from survey.control.content import GivenPoint
from survey.errors import ControlError


def in_crs(points: Sequence[GivenPoint], crs: CRS, assumptions: list[str], warnings: list[str]) -> list[GivenPoint]:
    """Points with their coordinates in the crs of a survey; heights keep their datum.

    Assumptions are added to the first list, to the second how little well known the way of points into crs is.

    Raises
    ------
    ControlError
        If a point does not lie on the map of crs.
    GeoError
        If heights count from another datum or have no unit, or a grid of the best transformation is missing.
    """
    done = list(points)
    for source in dict.fromkeys(point.crs for point in points if point.crs is not None):
        of_source = [i for i, point in enumerate(points) if point.crs == source]
        first = points[of_source[0]]
        scale = height_scale(source, crs, f"{first.where}: the heights of points in {called(source)}")
        places, added = np.array([points[i].place for i in of_source]), 0.0
        if not horizontal_crs(source).equals(horizontal_crs(crs), ignore_axis_order=True):
            mend = "or give the points in crs"
            said = f"{first.where}: points in {called(source)}"
            way = Transformation.between(source, crs, places)
            way.require_best(said, mend)
            places = np.column_stack([*way(places[:, 0], places[:, 1]), places[:, 2]])
            added, doubt = way.accuracy_m or 0.0, way.doubt(said)
            warnings += [] if doubt is None else [doubt]
            heights = "are converted to the unit of crs" if scale != 1.0 else "are taken as heights in crs"
            assumptions.append(
                f"points in {called(source)} ({first.where}) are transformed to {horizontal_crs(crs).name}; their "
                f"heights {heights}"
            )
        places[:, 2] *= scale
        for i, place in zip(of_source, places.tolist(), strict=True):
            if not np.isfinite(place).all():
                raise ControlError(
                    f"{points[i].where}: {points[i].place[0]:.10g}, {points[i].place[1]:.10g} is not on the map of "
                    f"{called(source)} and of {crs.name}; correct the coordinates, their order (easting or longitude "
                    "first) or the CRS of the file"
                )
            done[i] = replace(points[i], place=tuple(place), crs=None, as_read=points[i], datum_std_m=added)
    return done


def swapped(point: GivenPoint, crs: CRS) -> GivenPoint | None:
    """A point in crs with the first two numbers of its file swapped; None where that is not on the map."""
    given = point.as_read or point
    first, second, height = given.place
    try:
        return in_crs([replace(given, place=(second, first, height))], crs, [], [])[0]
    except (ControlError, GeoError):
        return None
