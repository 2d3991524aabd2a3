"""Control points that GPX and KML hold: waypoints and placemarks with a name and a height, in WGS 84."""

from __future__ import annotations

from pathlib import Path

from geo.errors import UnreadableFile
from geo.features import read_features
from survey.control.points import Content, ControlFormat, GivenPoint
from survey.errors import ControlError

_SUFFIXES = (".gpx", ".kml")


def read_waypoints(path: Path) -> Content:
    """The points of a file; their heights are taken as heights in crs."""
    try:
        found = read_features(path, "points with names")
    except UnreadableFile as error:
        raise ControlError(str(error)) from error
    points = []
    for number, feature in enumerate((f for f in found.features if f.geometry.geom_type == "Point"), start=1):
        where, name = f"{path}, point {number}", feature.properties["name"]
        if not name:
            raise ControlError(f"{where} has no name, expected that of its marks; name it")
        if not feature.geometry.has_z:
            raise ControlError(f"{where}, {name}, has no height, expected one in crs; add it, or give a table")
        x, y, z = feature.geometry.coords[0]
        points.append(GivenPoint(name, where, (x, y, z), found.crs))
    if not points:
        raise ControlError(f"{path} has no points, expected waypoints or placemarks of control; give another file")
    return Content(tuple(points))


FORMAT = ControlFormat(
    name="points of GPX or KML with names and heights",
    recognises=lambda path: path.suffix.casefold() in _SUFFIXES,
    read=read_waypoints,
)
