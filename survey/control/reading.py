"""Control files of any known format, merged and checked against the photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import checked_height_unit, crs_name, horizontal_crs, is_geographic
from geo.errors import GeoError
from geo.transformation import Transformation, height_scale
from survey.control import gcp_list, metashape_xml, tables, waypoints
from survey.control.points import Content, GivenMark, GivenPoint, Mark
from survey.display.quantities import named
from survey.errors import ControlError, Findings
from survey.files.csv_table import text_lines
from survey.files.foreign import instead_of
from survey.files.point_table import Units
from survey.photos.names import ImageNames

# Tried in this order to recognise a file; COORDINATES takes every .csv that MARKS does not.
FORMATS = (
    waypoints.FORMAT,
    metashape_xml.FORMAT,
    gcp_list.FORMAT,
    tables.MARKS,
    tables.COORDINATES,
)
# Files of other programs that hold no control that can be read, by patterns of their names, and what to give instead.
_NOT_READ = {
    "*.kmz": "unzip it, and give the .kml in it",
    **dict.fromkeys(("*.opf", "*.p4d"), "export the control points of the project as a table"),
    "ground_control_points.json": "give OpenDroneMap's gcp_list.txt of the same points",
    "*.psx": "export the markers from Metashape (File > Export > Export Markers, .xml)",
    "*.rcproj": "export the control points from RealityScan as a table, with their measurements",
    **dict.fromkeys(
        ("*.shp", "*.gpkg", "*.dxf", "*.geojson"), "export the points as a table name,easting,northing,height"
    ),
    **dict.fromkeys(("*.xlsx", "*.xls", "*.ods"), "save it as .csv"),
}
# Two files may round the coordinates of one point differently.
_SAME_M, _SAME_DEG = 1e-3, 1e-8
# A file of a thousand points with fifty marks each has 3 MB.
_MOST_BYTES = 8_000_000
# The least number of points that fix place, tilt and scale.
_ENOUGH = 3


def in_crs(points: Sequence[GivenPoint], crs: CRS) -> tuple[list[GivenPoint], Findings]:
    """Points with their coordinates in the crs of a survey; heights keep their datum.

    The findings state what was transformed, with warnings about inaccurate transformations.
    """
    done, findings = list(points), Findings()
    for source, units in dict.fromkeys((point.crs, point.units) for point in points):
        if source is None and units == Units():
            continue
        of_source = [i for i, point in enumerate(points) if (point.crs, point.units) == (source, units)]
        first, source = points[of_source[0]], crs if source is None else source
        scale = _height_scale(first, source, crs)
        places, added = np.array([points[i].place for i in of_source]), 0.0
        if not horizontal_crs(source).equals(horizontal_crs(crs), ignore_axis_order=True):
            remedy = "or give the points in crs"
            what = f"{first.where}: points in {crs_name(source)}"
            transformation = Transformation.between(source, crs, places)
            transformation.require_best(what, remedy)
            transformation.require_known(what, remedy)
            places = np.column_stack([*transformation(places[:, 0], places[:, 1]), places[:, 2]])
            added, warning = transformation.accuracy_m or 0.0, transformation.warning(what)
            heights = "are converted to the unit of crs" if scale != 1.0 else "are taken as heights in crs"
            assumption = (
                f"points in {crs_name(source)} ({first.where}) are transformed to {horizontal_crs(crs).name}; their "
                f"heights {heights}"
            )
            findings += Findings((assumption,), () if warning is None else (warning,))
        elif scale != 1.0:
            assumption = f"heights of {first.where} are multiplied by {scale:.7g}, by the units of its columns or CRS"
            findings += Findings((assumption,))
        places[:, 2] *= scale
        for i, place in zip(of_source, places.tolist(), strict=True):
            if not np.isfinite(place).all():
                raise ControlError(
                    f"{points[i].where}: {points[i].place[0]:.10g}, {points[i].place[1]:.10g} is not on the map of "
                    f"{crs_name(source)} and of {crs.name}; correct the coordinates, their order (easting or longitude "
                    "first) or the CRS of the file"
                )
            done[i] = replace(points[i], place=tuple(place), crs=None, as_read=points[i], datum_std_m=added)
    return done, findings


def _height_scale(first: GivenPoint, source: CRS, crs: CRS) -> float:
    """Factor from heights of a file to the unit of crs, by its header and its CRS; ``first`` is a point of it."""
    where = Path(first.where)
    units = first.units.meant(Units.of(source))
    fault = units.plan_fault(Units.of(source))
    if fault is not None:
        raise ControlError(f"{first.where}: {fault}; convert them")
    if first.crs is None:
        return units.height_factor(Units.of(crs))
    unit_m = checked_height_unit(source, units.height_m, where, "the unit of its column of heights")
    return height_scale(source, crs, f"{first.where}: the heights of points in {crs_name(source)}", unit_m=unit_m)


def with_swapped_axes(point: GivenPoint, crs: CRS) -> GivenPoint | None:
    """A point in crs with the first two numbers of its file swapped; None where that is not on the map."""
    given = point.as_read or point
    first, second, height = given.place
    try:
        return in_crs([replace(given, place=(second, first, height))], crs)[0][0]
    except (ControlError, GeoError):
        return None


@dataclass(frozen=True)
class MergedControl:
    """Control points with marks, coordinates in the crs of the survey."""

    points: tuple[GivenPoint, ...] = ()  # Each name once, each with a mark at least
    marks: tuple[Mark, ...] = ()  # In order of points and of photographs
    unmarked: tuple[GivenPoint, ...] = ()  # Check points that no photograph needs to show


def read_control(path: Path) -> Content:
    """Contents of a file of control, in any known format."""
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise ControlError(f"the control file {path} {what}; correct [control] in survey.toml")
    size = path.stat().st_size
    if size > _MOST_BYTES:
        raise ControlError(
            f"{path} has {size / 1e6:.0f} MB, expected at most {_MOST_BYTES / 1e6:.0f}; keep the points and marks "
            "of this survey"
        )
    if size == 0:
        raise ControlError(f"{path} is empty, expected {_expected()}; write it again")
    instead = instead_of(path, _NOT_READ)
    if instead is not None:
        raise ControlError(f"{path} is not read: {instead}; expected {_expected()}")
    known = next((known for known in FORMATS if known.recognises(path)), None)
    if known is None:
        for _ in text_lines(path, ControlError):
            pass  # not text: this says so
        raise ControlError(f"{path} is not a known kind of control file, expected {_expected()}; convert it")
    return known.read(path)


def merge_control(
    contents: Sequence[Content], crs: CRS, sizes: Mapping[str, tuple[int, int]]
) -> tuple[MergedControl, Findings]:
    """Points and marks of several files, in the crs of a survey and under the names of its photographs."""
    given = [point for content in contents for point in content.points]
    given, findings = in_crs(given, crs)
    points = _points(given, crs)
    marks, warnings = _marks([content.marks for content in contents], points, sizes)
    marked = {mark.point for mark in marks}
    unmarked = [point for name, point in points.items() if name not in marked]
    lost = [f"{point.name} ({point.where})" for point in unmarked if not point.is_check]
    warnings += [warning for content in contents for warning in content.warnings]
    warnings += named(lost, "control point", "without a mark in a photograph, left out")
    kept = tuple(point for name, point in points.items() if name in marked)
    warnings += _warnings(kept)
    order = {point.name: i for i, point in enumerate(kept)}
    marks.sort(key=lambda mark: (order[mark.point], mark.view))
    merged = MergedControl(kept, tuple(marks), tuple(point for point in unmarked if point.is_check))
    return merged, findings + Findings(warnings=tuple(warnings))


def _points(given: Sequence[GivenPoint], crs: CRS) -> dict[str, GivenPoint]:
    if not given:
        raise ControlError("[control] gcps has no points; name a file with name,easting,northing,height beside marks")
    same = _SAME_DEG if is_geographic(crs) else _SAME_M
    points: dict[str, GivenPoint] = {}
    for point in given:
        first = points.setdefault(point.name, point)
        if not np.allclose(first.place[:2], point.place[:2], rtol=0.0, atol=same) or (
            abs(first.place[2] - point.place[2]) > _SAME_M
        ):
            raise ControlError(
                f"{point.where}: the point {point.name} is at {_shown(point)}, but at {_shown(first)} in "
                f"{first.where}; correct one of them, or give one another name"
            )
        if point.is_check:
            points[point.name] = replace(first, is_check=True)
    return points


def _marks(
    of_files: Sequence[Sequence[GivenMark]], points: Mapping[str, GivenPoint], sizes: Mapping[str, tuple[int, int]]
) -> tuple[list[Mark], list[str]]:
    """Marks of points in photographs, and warnings about those of unknown names."""
    if not any(of_files):
        raise ControlError(
            "[control] names points without marks, expected where photographs show them; name a table "
            "image,name,x,y or Metashape's XML in marks, or use a gcp_list.txt, which has both"
        )
    marks: dict[tuple[str, str], GivenMark] = {}
    unknown_images: dict[str, GivenMark] = {}
    unknown_points: dict[str, GivenMark] = {}
    given_marks = [(mark, names) for given in of_files for names in [ImageNames(sizes)] for mark in given]
    for mark, names in given_marks:
        image = names.find(mark.image, mark.where)
        if image is None:
            unknown_images.setdefault(mark.image, mark)
        elif mark.point not in points:
            unknown_points.setdefault(mark.point, mark)
        else:
            width, height = sizes[image]
            if not (0.0 <= mark.pixel[0] <= width and 0.0 <= mark.pixel[1] <= height):
                raise ControlError(
                    f"{mark.where}: the mark of {mark.point} at {_at(mark)} lies outside {image}, which has {width} x "
                    f"{height} pixels; if the photographs were reduced, reduce the marks too, else correct it"
                )
            first = marks.setdefault((mark.point, image), mark)
            if first.pixel != mark.pixel:
                raise ControlError(
                    f"{mark.where}: {mark.point} has a second mark in {image}, {_at(mark)} after {_at(first)} in "
                    f"{first.where}; keep one"
                )
    if not marks:
        example = next(iter(unknown_images.values()), None) or next(iter(unknown_points.values()))
        what = (
            f"photograph of the survey is called {example.image}"
            if unknown_images
            else (f"point with coordinates is called {example.point}")
        )
        like = next(iter(sizes)) if unknown_images else next(iter(points))
        raise ControlError(
            f"{example.where}: no {what}, and none of the {len(given_marks)} marks belongs to one; use the names that "
            f'they have, e.g. "{like}"'
        )
    warnings = _left_out(unknown_images, "photograph", "that the survey does not have")
    warnings += _left_out(unknown_points, "point", "without coordinates")
    return [Mark(point, image, mark.pixel) for (point, image), mark in marks.items()], warnings


def _left_out(found: Mapping[str, GivenMark], noun: str, why: str) -> list[str]:
    """A warning about marks of unknown names, with the place of the first."""
    if not found:
        return []
    first = next(iter(found.values()))
    return [
        f"{warning} (first in {first.where}): their marks are left out; correct the names or remove the lines"
        for warning in named(list(found), noun, f"{why} in the files of control")
    ]


def _warnings(points: Sequence[GivenPoint]) -> list[str]:
    """Warnings about control that is too little, or has no heights."""
    warnings = []
    num = sum(not point.is_check for point in points)
    if 0 < num < _ENOUGH:
        warnings.append(
            f"{num} control point{'s' if num > 1 else ''} with marks, expected {_ENOUGH} or more to fix place, tilt "
            "and scale; the positions of the cameras have to fix the rest"
        )
    if len(points) >= _ENOUGH and all(point.place[2] == 0.0 for point in points):
        warnings.append("all control points have the height 0; check that the file has their heights")
    return warnings


def _shown(point: GivenPoint) -> str:
    return ", ".join(f"{value:.10g}" for value in point.place)


def _at(mark: GivenMark) -> str:
    return f"{mark.pixel[0]:.6g}, {mark.pixel[1]:.6g}"


def _expected() -> str:
    return " or ".join(known.name for known in FORMATS)
