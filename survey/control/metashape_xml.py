"""Markers as Metashape exports them to XML: coordinates in its reference, marks in photographs.

The centre of its first pixel is 0.5, 0.5, as here. A marker that is not enabled in the reference pane is a check point.
"""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree.ElementTree import Element

from pyproj import CRS

from survey.control.points import Content, ControlFormat, GivenMark, GivenPoint, require_std
from survey.errors import ControlError
from survey.files.csv_table import number_of
from survey.files.foreign import begins_with
from survey.files.xml_tree import crs_of_chunk, read_chunk

_AXES, _STDS = ("x", "y", "z"), ("sx", "sy", "sz")


def read_metashape_xml(path: Path) -> Content:
    """Points that have coordinates, and the marks that were set or confirmed by hand."""
    chunk = read_chunk(path, "marker", "markers", ControlError)
    images = {camera.get("id", ""): camera.get("label", "") for camera in chunk.iter("camera")}
    names = {marker.get("id", ""): marker.get("label", "") for marker in chunk.iter("marker") if marker.get("label")}
    crs = crs_of_chunk(chunk, "markers", path, ControlError)
    points = [
        _point(marker, reference, path, crs)
        for marker in chunk.iter("marker")
        if marker.get("label")
        and (reference := marker.find("reference")) is not None
        and reference.get("x") is not None
    ]
    marks = [
        mark
        for marker in chunk.iter("marker")
        for location in marker.iter("location")
        if (mark := _mark(marker, location, path, names, images)) is not None
    ]
    return Content(tuple(points), tuple(marks))


def _point(marker: Element, reference: Element, path: Path, crs: CRS | None) -> GivenPoint:
    name = marker.get("label", "")
    where = f'{path}, marker "{name}"'
    x, y, z = (_number(reference, key, where) for key in _AXES)
    std = None
    if all(reference.get(key) is not None for key in _STDS):
        sx, sy, sz = (_number(reference, key, where) for key in _STDS)
        std = require_std((sx, sy, sz), where)
    return GivenPoint(name, where, (x, y, z), crs, std, is_check=not _is_true(reference, "enabled"))


def _mark(
    marker: Element, location: Element, path: Path, names: dict[str, str], images: dict[str, str]
) -> GivenMark | None:
    """A mark; None where Metashape only predicted it from the poses."""
    if not (_is_true(location, "pinned") and _is_true(location, "valid")):
        return None
    key = marker.get("marker_id") or marker.get("id") or ""
    camera = location.get("camera_id") or ""
    where = f'{path}, marker "{names.get(key, key)}" in camera "{images.get(camera, camera)}"'
    if key not in names or not images.get(camera):
        raise ControlError(
            f"{where}: there is no such {'marker' if key not in names else 'camera'} with a label in the file; export "
            "the markers again"
        )
    return GivenMark(names[key], images[camera], where, (_number(location, "x", where), _number(location, "y", where)))


def _is_true(element: Element, key: str) -> bool:
    return element.get(key, "true").casefold() not in ("false", "0")


def _number(element: Element, key: str, where: str) -> float:
    text = element.get(key, "")
    value = number_of(text)
    if not math.isfinite(value):
        raise ControlError(f"{where}: {key} is {text or 'missing'}, expected a finite number; correct it")
    return value


FORMAT = ControlFormat(
    name="markers of Metashape (.xml)",
    recognises=lambda path: path.suffix.casefold() == ".xml" or begins_with(path, b"<"),
    read=read_metashape_xml,
)
