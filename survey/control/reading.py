"""Files of control of any known format, and all of them put together and checked against the photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import is_geographic
from survey.control import gcp_list, metashape_xml, opensfm_json, tables
from survey.control.content import Content, GivenMark, GivenPoint
from survey.control.horizontal import in_crs
from survey.control.points import Mark
from survey.display.words import named
from survey.errors import ControlError
from survey.files.csv_table import text_lines
from survey.findings import Findings
from survey.photos.names import ImageNames

# Asked in this order which of them a file is of; COORDINATES takes every .csv that MARKS does not.
FORMATS = (metashape_xml.FORMAT, opensfm_json.FORMAT, gcp_list.FORMAT, tables.MARKS, tables.COORDINATES)
# Two files may round the coordinates of one point differently.
_SAME_M, _SAME_DEG = 1e-3, 1e-8
# The least number of points that fix place, tilt and scale.
_ENOUGH = 3


@dataclass(frozen=True)
class Gathered:
    """Control points with marks, coordinates in the crs of the survey."""

    points: tuple[GivenPoint, ...]  # Each name once, each with a mark at least
    marks: tuple[Mark, ...]  # In order of points and of photographs
    unmarked: tuple[GivenPoint, ...] = ()  # Check points that no photograph needs to show


def read_control(path: Path) -> Content:
    """Contents of a file of control, in any known format.

    Raises
    ------
    ControlError
        If there is no such file, its format is not known, or its content cannot be true.
    """
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise ControlError(f"the control file {path} {what}; correct [control] in survey.toml")
    if path.stat().st_size == 0:
        raise ControlError(f"{path} is empty, expected {_expected()}; write it again")
    known = next((known for known in FORMATS if known.recognises(path)), None)
    if known is None:
        for _ in text_lines(path, ControlError):
            pass  # not text: this says so
        raise ControlError(f"{path} is not a known kind of control file, expected {_expected()}; convert it")
    return known.read(path)


def gather(contents: Sequence[Content], crs: CRS, sizes: Mapping[str, tuple[int, int]]) -> tuple[Gathered, Findings]:
    """Points and marks of several files, in the crs of a survey and under the names of its photographs.

    Parameters
    ----------
    contents : of each file
    crs : CRS
    sizes : name of a photograph to (width, height) [px]

    Raises
    ------
    ControlError
        If a point has two places, a mark lies outside its photograph or has two places in it, or nothing is left.
    """
    given = [point for content in contents for point in content.points]
    given, said = in_crs(given, crs)
    points = _points(given, crs)
    marks, warnings = _marks([content.marks for content in contents], points, sizes)
    marked = {mark.point for mark in marks}
    unmarked = [point for name, point in points.items() if name not in marked]
    lost = [f"{point.name} ({point.where})" for point in unmarked if not point.is_check]
    warnings += named(lost, "control point", "without a mark in a photograph, left out")
    kept = tuple(point for name, point in points.items() if name in marked)
    warnings += _doubts(kept)
    order = {point.name: i for i, point in enumerate(kept)}
    marks.sort(key=lambda mark: (order[mark.point], mark.view))
    gathered = Gathered(kept, tuple(marks), tuple(point for point in unmarked if point.is_check))
    return gathered, said + Findings(warnings=tuple(warnings))


def _points(given: Sequence[GivenPoint], crs: CRS) -> dict[str, GivenPoint]:
    if not given:
        raise ControlError(
            "[control] gcps names no file with coordinates of points, expected name,easting,northing,height; name one "
            "beside the marks"
        )
    same = _SAME_DEG if is_geographic(crs) else _SAME_M
    points: dict[str, GivenPoint] = {}
    for point in given:
        first = points.setdefault(point.name, point)
        if not np.allclose(first.place[:2], point.place[:2], rtol=0.0, atol=same) or (
            abs(first.place[2] - point.place[2]) > _SAME_M
        ):
            raise ControlError(
                f"{point.where}: the point {point.name[:40]} is at {_shown(point)}, but at {_shown(first)} in "
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
    strangers: dict[str, GivenMark] = {}
    nameless: dict[str, GivenMark] = {}
    called = [(mark, names) for given in of_files for names in [ImageNames(sizes)] for mark in given]
    for said, names in called:
        mark, image = said, names.find(said.image, said.where)
        if image is None:
            strangers.setdefault(mark.image, mark)
        elif mark.point not in points:
            nameless.setdefault(mark.point, mark)
        else:
            mark = mark.in_pixels(sizes[image])
            _require_inside(mark, image, sizes[image])
            first = marks.setdefault((mark.point, image), mark)
            if first.pixel != mark.pixel:
                raise ControlError(
                    f"{mark.where}: {mark.point[:40]} has a second mark in {image}, {_at(mark)} after {_at(first)} in "
                    f"{first.where}; keep one"
                )
    if not marks:
        example = next(iter(strangers.values()), None) or next(iter(nameless.values()))
        what = (
            f"photograph of the survey is called {example.image[:60]}"
            if strangers
            else (f"point with coordinates is called {example.point[:40]}")
        )
        like = next(iter(sizes)) if strangers else next(iter(points))
        raise ControlError(
            f"{example.where}: no {what}, and none of the {len(called)} marks belongs to one; use the names that they "
            f'have, e.g. "{like}"'
        )
    warnings = _left_out(strangers, "photograph", "that the survey does not have")
    warnings += _left_out(nameless, "point", "without coordinates")
    return [Mark(point, image, mark.pixel) for (point, image), mark in marks.items()], warnings


def _left_out(found: Mapping[str, GivenMark], noun: str, why: str) -> list[str]:
    """A warning about marks of unknown names, with the place of the first."""
    if not found:
        return []
    first = next(iter(found.values()))
    return [
        f"{warning} (first in {first.where}): their marks are left out; correct the names or remove the lines"
        for warning in named([name[:60] for name in found], noun, f"{why} in the files of control")
    ]


def _require_inside(mark: GivenMark, image: str, size: tuple[int, int]) -> None:
    x, y = mark.pixel
    if not (0.0 <= x <= size[0] and 0.0 <= y <= size[1]):
        raise ControlError(
            f"{mark.where}: the mark of {mark.point[:40]} at {_at(mark)} lies outside {image}, which has {size[0]} x "
            f"{size[1]} pixels; if the photographs were reduced, reduce the marks too, else correct it"
        )


def _doubts(points: Sequence[GivenPoint]) -> list[str]:
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
