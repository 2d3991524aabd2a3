"""Coordinates of control points in another horizontal CRS than that of the survey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pyproj import CRS, Transformer
from pyproj.transformer import AreaOfInterest

from geo.crs import horizontal_crs, other_heights
from survey.control.content import GivenPoint
from survey.errors import ControlError


def in_crs(points: Sequence[GivenPoint], crs: CRS, assumptions: list[str]) -> list[GivenPoint]:
    """Points with their coordinates in the crs of a survey; heights are those of the files.

    Raises
    ------
    ControlError
        If heights count from another datum, or a point does not lie on the map of crs.
    """
    done = list(points)
    for source in dict.fromkeys(point.crs for point in points if point.crs is not None):
        of_source = [i for i, point in enumerate(points) if point.crs == source]
        first = points[of_source[0]]
        _require_heights(source, crs, first)
        places = np.array([points[i].place for i in of_source])
        if not horizontal_crs(source).equals(horizontal_crs(crs), ignore_axis_order=True):
            places[:, :2] = _transformed(source, crs, places)
            assumptions.append(
                f"control points in {source.name} are transformed to {horizontal_crs(crs).name}; their heights are "
                "taken as heights in crs"
            )
        for i, place in zip(of_source, places.tolist(), strict=True):
            if not np.isfinite(place).all():
                raise ControlError(
                    f"{points[i].where}: {points[i].place[0]:.10g}, {points[i].place[1]:.10g} is not on the map of "
                    f"{source.name} and of {crs.name}; correct the coordinates, their order (easting or longitude "
                    "first) or the CRS of the file"
                )
            done[i] = replace(points[i], place=tuple(place), crs=None, as_read=points[i])
    return done


def swapped(point: GivenPoint, crs: CRS) -> GivenPoint | None:
    """A point in crs with the first two numbers of its file swapped; None where that is not on the map."""
    given = point.as_read or point
    first, second, height = given.place
    try:
        return in_crs([replace(given, place=(second, first, height))], crs, [])[0]
    except ControlError:
        return None


def _require_heights(source: CRS, crs: CRS, first: GivenPoint) -> None:
    """Raise where the CRS of a file says that its heights count from another datum than those of the survey."""
    names = other_heights(source, crs)
    if names is not None:
        raise ControlError(
            f"{first.where}: the heights of control points are above {names[0]}, expected above {names[1]} as in "
            "survey.toml; convert them, and leave the vertical part out of the CRS of the file"
        )


def _transformed(source: CRS, crs: CRS, places: np.ndarray) -> np.ndarray:
    """Horizontal coordinates (N, 2) in crs; not finite where a point is not on the map."""
    own = horizontal_crs(source)
    lon, lat = Transformer.from_crs(own, "EPSG:4326", always_xy=True).transform(places[:, 0], places[:, 1])
    known = np.isfinite(lon) & np.isfinite(lat)
    if not known.any():
        return np.full((len(places), 2), np.nan)
    middle_lon, middle_lat = float(np.median(lon[known])), float(np.median(lat[known]))
    # For PROJ to choose among the regional transformations of a datum.
    area = AreaOfInterest(
        middle_lon - 0.01, max(middle_lat - 0.01, -90.0), middle_lon + 0.01, min(middle_lat + 0.01, 90.0)
    )
    to_crs = Transformer.from_crs(own, horizontal_crs(crs), always_xy=True, area_of_interest=area)
    return np.column_stack(to_crs.transform(places[:, 0], places[:, 1]))
