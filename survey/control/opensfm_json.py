"""ground_control_points.json of OpenSfM: points by latitude and longitude, marks in shares of the longer side.

Its marks count from the middle of the photograph, in units of its longer side.
"""

from __future__ import annotations

from pathlib import Path

from pyproj import CRS

from survey.control.points import Content, ControlFormat, GivenMark, GivenPoint
from survey.errors import ControlError
from survey.files.foreign import begins_with
from survey.files.json_values import finite_number, finite_numbers, read_foreign_json

_LONGITUDE, _LATITUDE, _ALTITUDE = "longitude", "latitude", "altitude"
# OpenSfM's role of check points.
_CHECK = "metrics_only"
_FORM = '{"points": [{"id": ..., "position": {...}, "observations": [...]}]}'


def read_opensfm_json(path: Path) -> Content:
    """Points that have a whole position, and all marks."""
    content = read_foreign_json(path, ControlError)
    given = content.get("points") if isinstance(content, dict) else None
    if not isinstance(given, list) or not given:
        raise ControlError(f"{path} has no points, expected {_FORM}; export it again")
    points, marks = [], []
    for number, each in enumerate(given, start=1):
        where = f"{path}, point {number}"
        if not isinstance(each, dict) or not isinstance(each.get("id"), str) or not each["id"]:
            raise ControlError(f'{where} has no name under "id", expected {_FORM}; export it again')
        position = each.get("position")
        if isinstance(position, dict) and position.get("has_altitude", _ALTITUDE in position):
            points.append(_point(each, position, where))
        marks += _marks(each, where)
    return Content(tuple(points), tuple(marks))


def _point(each: dict, position: dict, where: str) -> GivenPoint:
    place = [finite_number(position.get(key)) for key in (_LONGITUDE, _LATITUDE, _ALTITUDE)]
    east, north, height = place
    if east is None or north is None or height is None or abs(east) > 180.0 or abs(north) > 90.0:
        raise ControlError(f"{where}: position is {position}, expected latitude, longitude, altitude; correct it")
    is_check = each.get("role") == _CHECK
    return GivenPoint(each["id"], where, (east, north, height), CRS.from_epsg(4326), is_check=is_check)


def _marks(each: dict, where: str) -> list[GivenMark]:
    given = each.get("observations", [])
    marks = []
    for entry in given if isinstance(given, list) else [given]:
        known = entry if isinstance(entry, dict) else {}
        at, image = finite_numbers(known.get("projection"), 2), known.get("shot_id")
        if at is None or not isinstance(image, str):
            raise ControlError(f"{where}: an observation is {entry}, expected shot_id and projection; correct it")
        marks.append(GivenMark(each["id"], image, where, (at[0], at[1]), is_normalised=True))
    return marks


def _is_opensfm_json(path: Path) -> bool:
    return path.suffix.casefold() == ".json" and begins_with(path, b"{")


FORMAT = ControlFormat(
    name="OpenSfM's ground_control_points.json",
    recognises=_is_opensfm_json,
    read=read_opensfm_json,
)
