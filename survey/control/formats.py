"""Formats of control files: gcp_list.txt, Metashape's markers, GPX and KML, tables of coordinates, marks, check points.

Pixels are given so that the centre of the first one is 0.5, 0.5, as in Metashape and in tables; in gcp_list.txt of
OpenDroneMap it is 0, 0. Its lines are ``x y z px py image [name] [role]``, after one with the CRS; those without a name
belong to the same point if they have the same coordinates. Heights of GPX and KML are taken as heights in crs.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from xml.etree.ElementTree import Element

from pyproj import CRS

from geo.crs import horizontal_crs
from geo.errors import UnreadableFile
from geo.features import read_features
from survey.control.points import Content, ControlFormat, GivenPoint, Mark
from survey.errors import ControlError
from survey.files import point_table as point_tables
from survey.files.csv_table import Row, Table, column_names, number_of, text_lines, words_of
from survey.files.foreign_text import crs_of_chunk, crs_of_comment, is_odm_crs, odm_lines, read_chunk
from survey.files.paths import begins_with
from survey.photos.exif import SUFFIXES
from survey.words import GCP_LIST

_FORM = "x y z px py image name"
# Offset from the pixels of gcp_list.txt to ours.
_HALF_A_PIXEL = 0.5
# Words for roles, in lower case.
_CHECK, _CONTROL = ("check", "checkpoint", "check point", "cp"), ("control", "gcp", "ground control", "")
# Names of the columns of marks in other programs.
_MARK_WORDS = words_of({
    "image": ("photo", "photograph", "file", "filename", "camera", "image_name"),
    "name": ("label", "point", "gcp", "marker", "point name", "point_name"),
    "x": ("px", "u", "x_px", "pixel_x", "col"),
    "y": ("py", "v", "y_px", "pixel_y", "row"),
})  # fmt: skip
_MARK_COLUMNS = ("image", "name", "x", "y")
_OPTIONAL = ("name", "std", "std_horizontal", *point_tables.STDS)


def _is_check(role: str, where: str) -> bool:
    word = role.strip().casefold()
    if word not in (*_CHECK, *_CONTROL):
        raise ControlError(f'{where}: the role is "{role}", expected control or check; correct it')
    return word in _CHECK


def _stds(values: Sequence[float], where: str, *, is_check: bool) -> tuple[float, float, float] | None:
    """Standard deviations [m] that a file has; None for check points with a 0, which is that of no measurement."""
    if is_check and 0.0 in values:
        return None
    if not all(0.0 < value <= 10.0 for value in values):
        raise ControlError(
            f"{where}: the standard deviations are {', '.join(f'{value:g}' for value in values)}, expected metres "
            "above 0 and at most 10; correct them, or leave the columns out"
            f"{'' if is_check else ' and give [control] std_m'}"
        )
    east, north, up = values
    return east, north, up


def read_gcp_list(path: Path) -> Content:
    """Points and marks of a gcp_list.txt."""
    crs, lines = odm_lines(path, GCP_LIST, _FORM, ControlError)
    names: dict[tuple[float, ...], str] = {}
    points, marks = [], []
    for where, line in lines:
        cells = line_cells(line)
        if len(cells) < 6 and "," in line:
            raise ControlError(
                f"{where}: values are separated by commas, expected spaces or tabs: {_FORM}; replace them"
            )
        if len(cells) < 6:
            raise ControlError(f"{where}: {len(cells)} values were found, expected {_FORM}; complete the line")
        for name, cell in zip(_FORM.split()[:5], cells, strict=False):
            if not math.isfinite(number_of(cell)):
                raise ControlError(f"{where}: {name} is {cell}, expected a finite number in {_FORM}; correct it")
        x, y, z, px, py = map(number_of, cells[:5])
        image, words = cells[5], cells[6:]
        _require_whole_name(image, words, where)
        name = words[0] if words else names.setdefault((x, y, z), f"{path.stem} {len(names) + 1}")
        # Words after the name have no fixed meaning; only roles are recognised.
        is_check = len(words) > 1 and words[1].strip().casefold() in _CHECK
        points.append(GivenPoint(name, where, (x, y, z), crs, is_check=is_check))
        marks.append(Mark(name, image, (px + _HALF_A_PIXEL, py + _HALF_A_PIXEL), where))
    return Content(tuple(points), tuple(marks))


def is_of_content(line: str) -> bool:
    """Whether a line is neither empty nor a comment."""
    return bool(line.strip()) and not line.lstrip().startswith("#")


def line_cells(line: str) -> list[str]:
    """The values of a line of a gcp_list.txt; a name with a space is whole only between tabs."""
    if line.strip().count("\t") >= 5:
        return [cell.strip() for cell in line.split("\t") if cell.strip()]
    return line.split()


def mark_line(place: Sequence[str], pixel: tuple[float, float], image: str, words: Sequence[str]) -> str:
    """A line of a mark at x, y, z, with as many of name and role as there are, which `read_gcp_list` reads."""
    cells = [*place, *(f"{value - _HALF_A_PIXEL:.3f}" for value in pixel), image, *words]
    return ("\t" if any(" " in cell for cell in cells) else " ").join(cells)


def _require_whole_name(image: str, words: list[str], where: str) -> None:
    """Raise ControlError where a space has cut the name of a photograph: its suffix is in a later word."""
    ends = [i for i, word in enumerate([image, *words]) if PurePosixPath(word).suffix.lower() in SUFFIXES]
    if ends and ends[0]:
        raise ControlError(
            f'{where}: the image name "{" ".join([image, *words[: ends[0]]])}" has a space, and values are '
            "separated by spaces here; separate all values of the file by tabs, or rename the photographs"
        )


def is_gcp_list(path: Path) -> bool:
    """Whether a file is a gcp_list.txt, by its name or its first line."""
    if path.name.casefold() == GCP_LIST:
        return True
    try:
        first = next((line.strip() for _, line in text_lines(path, ControlError) if is_of_content(line)), "")
    except ControlError:
        return False
    cells = first.split()
    return is_odm_crs(first) or (len(cells) >= 6 and all(math.isfinite(number_of(cell)) for cell in cells[:5]))


def read_metashape_xml(path: Path) -> Content:
    """Points of Metashape that have coordinates, and the marks that were set or confirmed by hand.

    A marker that is not enabled in the reference pane is a check point.
    """
    chunk = read_chunk(path, "marker", "markers", ControlError)
    images = {camera.get("id", ""): camera.get("label", "") for camera in chunk.iter("camera")}
    names = {marker.get("id", ""): marker.get("label", "") for marker in chunk.iter("marker") if marker.get("label")}
    crs = crs_of_chunk(chunk, "markers", path, ControlError)
    points, marks = [], []
    for marker in chunk.iter("marker"):
        reference, name = marker.find("reference"), marker.get("label")
        if name and reference is not None and reference.get("x") is not None:
            where, std, is_check = f'{path}, marker "{name}"', None, not _is_true(reference, "enabled")
            x, y, z = (_attribute(reference, key, where) for key in "xyz")
            if all(reference.get(key) is not None for key in ("sx", "sy", "sz")):
                std = _stds([_attribute(reference, key, where) for key in ("sx", "sy", "sz")], where, is_check=is_check)
            points.append(GivenPoint(name, where, (x, y, z), crs, std, is_check=is_check))
        key = marker.get("marker_id") or marker.get("id") or ""
        for location in marker.iter("location"):
            # Others Metashape has only predicted from the poses.
            if _is_true(location, "pinned") and _is_true(location, "valid"):
                marks.append(_mark(location, key, names, images, path))
    return Content(tuple(points), tuple(marks))


def _mark(location: Element, key: str, names: dict[str, str], images: dict[str, str], path: Path) -> Mark:
    camera = location.get("camera_id") or ""
    where = f'{path}, marker "{names.get(key, key)}" in camera "{images.get(camera, camera)}"'
    if key not in names or not images.get(camera):
        lacking = "marker" if key not in names else "camera"
        raise ControlError(f"{where}: there is no such {lacking} with a label in the file; export the markers again")
    pixel = _attribute(location, "x", where), _attribute(location, "y", where)
    return Mark(names[key], images[camera], pixel, where)


def _is_true(element: Element, key: str) -> bool:
    return element.get(key, "true").casefold() not in ("false", "0")


def _attribute(element: Element, key: str, where: str) -> float:
    value = number_of(text := element.get(key, ""))
    if not math.isfinite(value):
        raise ControlError(f"{where}: {key} is {text or 'missing'}, expected a finite number; correct it")
    return value


def read_waypoints(path: Path) -> Content:
    """The points of a GPX or KML file, in WGS 84."""
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
        points.append(GivenPoint(name, where, feature.geometry.coords[0], found.crs))
    if not points:
        raise ControlError(f"{path} has no points, expected waypoints or placemarks of control; give another file")
    return Content(tuple(points))


def read_coordinates(path: Path) -> Content:
    """The points of a table ``name,easting,northing,height``, with their accuracy and role if it has these."""
    table = point_tables.point_table(path, ControlError)
    rows = point_tables.read_points(table, optional=(*_OPTIONAL, "role", "enable"))
    point_tables.require_exact(rows, table)
    if rows and "name" not in table.names:
        raise ControlError(
            f"{path}: the first line has no column name, expected {','.join(('name', *point_tables.PLACE))}; add it"
        )
    crs, units = crs_of_comment(path, ControlError), point_tables.stated_units(table)
    points = tuple(replace(_point(row, crs), units=units) for row in rows)
    return Content(points, warnings=point_tables.accuracy_warnings(table))


def _point(row: Row, crs: CRS | None) -> GivenPoint:
    # Metashape adjusts to enabled points, and uses the others as check points.
    is_ticked = row.cells.get("enable", "").casefold() not in ("0", "false")
    is_check = _is_check(row.cells.get("role", ""), row.where) or not is_ticked
    return GivenPoint(row.text("name"), row.where, _place(row), crs, _std_of(row, is_check=is_check), is_check=is_check)


def _std_of(row: Row, *, is_check: bool) -> tuple[float, float, float] | None:
    for columns in (point_tables.STDS, ("std_horizontal", "std_horizontal", "std_height"), ("std", "std", "std")):
        if all(row.cells.get(column) for column in columns):
            return _stds([row.number(column) for column in columns], row.where, is_check=is_check)
    return None


def _place(row: Row) -> tuple[float, float, float]:
    easting, northing, height = (row.number(name) for name in point_tables.PLACE)
    return easting, northing, height


def read_marks(path: Path) -> Content:
    """The marks of a table ``image,name,x,y``."""
    rows = Table.read(path, _MARK_WORDS, ControlError).rows(_MARK_COLUMNS)
    return Content(
        marks=tuple(
            Mark(row.text("name"), row.text("image"), (row.number("x"), row.number("y")), row.where) for row in rows
        )
    )


def read_checkpoints(path: Path, level: float | None = None, survey_crs: CRS | None = None) -> tuple[GivenPoint, ...]:
    """The points of a table ``easting,northing,height``, numbered where it has no names.

    Depths count from the ``level`` of the water in the crs of the survey, where it has one.
    """
    table, crs, units = point_tables.point_table(path, ControlError), crs_of_comment(path, ControlError), None
    if survey_crs is not None and point_tables.has_depths(table):
        # Depths become heights of the survey; heights have the unit that the file states.
        crs = None if crs is None else horizontal_crs(crs)
        units = point_tables.Units(
            point_tables.Units.of(crs or survey_crs).plan_m, point_tables.Units.of(survey_crs).height_m
        )
    rows = point_tables.read_points(
        table, optional=_OPTIONAL, level=level, give_level="give [water] level_m", units=units
    )
    point_tables.require_exact(rows, table)
    stated = point_tables.stated_units(table) if units is None else point_tables.Units(height_m=units.height_m)
    if not rows:
        raise ControlError(f"{path} has no check points, expected lines name,easting,northing,height; add them")
    points: dict[str, GivenPoint] = {}
    for i, row in enumerate(rows, start=1):
        name = row.cells.get("name") or str(i)
        point = GivenPoint(name, row.where, _place(row), crs, _std_of(row, is_check=True), is_check=True, units=stated)
        first = points.setdefault(point.name, point)
        if first is not point:
            raise ControlError(f"{row.where}: check point {point.name} is in {first.where} too; remove or rename one")
    return tuple(points.values())


def _has(path: Path, columns: tuple[str, ...], words: dict[str, str]) -> bool:
    return set(columns) <= set(column_names(path, words))


# Tried in this order to recognise a file; the last takes every .csv that no other does.
FORMATS = (
    ControlFormat(
        "points of GPX or KML with names and heights",
        lambda path: path.suffix.casefold() in (".gpx", ".kml"),
        read_waypoints,
    ),
    ControlFormat(
        "markers of Metashape (.xml)",
        lambda path: path.suffix.casefold() == ".xml" or begins_with(path, b"<"),
        read_metashape_xml,
    ),
    ControlFormat("OpenDroneMap's gcp_list.txt", is_gcp_list, read_gcp_list),
    ControlFormat("a table image,name,x,y of marks", lambda path: _has(path, _MARK_COLUMNS, _MARK_WORDS), read_marks),
    ControlFormat(
        "a table name,easting,northing,height",
        lambda path: path.suffix.casefold() == ".csv" or _has(path, ("name", *point_tables.PLACE), point_tables.WORDS),
        read_coordinates,
    ),
)
