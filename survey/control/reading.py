"""Control files of any known format, merged, checked against photographs and cameras, in the crs of the survey."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

import geo.crs
from geo.compatibility import likely_crs
from geo.errors import GeoError
from geo.transformation import Transformation, height_scale, lon_lat
from survey.control.formats import FORMATS
from survey.control.points import Content, GivenPoint, Mark
from survey.display.quantities import distance_text, named
from survey.errors import ControlError, Findings
from survey.files.csv_table import text_lines
from survey.files.paths import instead_of
from survey.files.point_table import Units
from survey.photos.poses import ImageNames

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
# Photographs of shallow water do not show points farther away.
_FARTHEST_M = 3000.0
# A height is far from the others beyond this many times their usual spread, and this length [m].
_FAR, _FAR_HEIGHT_M, _FEWEST = 10.0, 30.0, 4


@dataclass(frozen=True)
class MergedControl:
    """Control points with marks, coordinates in the crs of the survey."""

    points: tuple[GivenPoint, ...] = ()  # Each name once, each with a mark at least
    marks: tuple[Mark, ...] = ()  # In order of points and of photographs
    unmarked: tuple[GivenPoint, ...] = ()  # Check points that no photograph needs to show


def read_control(path: Path) -> Content:
    """Contents of a file of control, in any known format."""
    expected = f"expected {' or '.join(known.name for known in FORMATS)}"
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
        raise ControlError(f"{path} is empty, {expected}; write it again")
    instead = instead_of(path, _NOT_READ)
    if instead is not None:
        raise ControlError(f"{path} is not read: {instead}; {expected}")
    known = next((known for known in FORMATS if known.recognises(path)), None)
    if known is None:
        for _ in text_lines(path, ControlError):
            pass  # not text: this says so
        raise ControlError(f"{path} is not a known kind of control file, {expected}; convert it")
    return known.read(path)


def in_crs(points: Sequence[GivenPoint], crs: CRS) -> tuple[list[GivenPoint], Findings]:
    """Points with their coordinates in the crs of a survey; heights keep their datum.

    The findings state what was transformed, with warnings about inaccurate transformations.
    """
    done, findings = list(points), Findings()
    for stated, units in dict.fromkeys((point.crs, point.units) for point in points):
        if stated is None and units == Units():
            continue
        rows = [i for i, point in enumerate(points) if (point.crs, point.units) == (stated, units)]
        first, source = points[rows[0]], crs if stated is None else stated
        scale, name = _height_scale(first, source, crs), geo.crs.crs_name(source)
        places, datum_std = np.array([points[i].place for i in rows]), 0.0
        if not geo.crs.horizontal_crs(source).equals(geo.crs.horizontal_crs(crs), ignore_axis_order=True):
            what, remedy = f"{first.where}: points in {name}", "or give the points in crs"
            transformation = Transformation.between(source, crs, places)
            transformation.require_best(what, remedy)
            transformation.require_known(what, remedy)
            places = np.column_stack([*transformation(places[:, 0], places[:, 1]), places[:, 2]])
            datum_std, warning = transformation.accuracy_m or 0.0, transformation.warning(what)
            heights = "are converted to the unit of crs" if scale != 1.0 else "are taken as heights in crs"
            to = geo.crs.horizontal_crs(crs).name
            assumption = f"points in {name} ({first.where}) are transformed to {to}; their heights {heights}"
            findings += Findings((assumption,), () if warning is None else (warning,))
        elif scale != 1.0:
            assumption = f"heights of {first.where} are multiplied by {scale:.7g}, by the units of its columns or CRS"
            findings += Findings((assumption,))
        places[:, 2] *= scale
        for i, place in zip(rows, places.tolist(), strict=True):
            if not np.isfinite(place).all():
                raise ControlError(
                    f"{points[i].where}: {points[i].place[0]:.10g}, {points[i].place[1]:.10g} is not on the map of "
                    f"{name} and of {crs.name}; correct them, their order (easting or longitude first) or the CRS"
                )
            done[i] = replace(points[i], place=tuple(place), crs=None, as_read=points[i], datum_std_m=datum_std)
    return done, findings


def _height_scale(first: GivenPoint, source: CRS, crs: CRS) -> float:
    """Factor from heights of a file to the unit of crs, by its header and its CRS; ``first`` is a point of it."""
    units = first.units.meant(Units.of(source))
    fault = units.plan_fault(Units.of(source))
    if fault is not None:
        raise ControlError(f"{first.where}: {fault}; convert them")
    if first.crs is None:
        return units.height_factor(Units.of(crs))
    unit_m = geo.crs.checked_height_unit(source, units.height_m, Path(first.where), "the unit of its column of heights")
    return height_scale(
        source, crs, f"{first.where}: the heights of points in {geo.crs.crs_name(source)}", unit_m=unit_m
    )


def merge_control(
    contents: Sequence[Content], crs: CRS, sizes: Mapping[str, tuple[int, int]]
) -> tuple[MergedControl, Findings]:
    """Points and marks of several files, in the crs of a survey and under the names of its photographs."""
    given, findings = in_crs([point for content in contents for point in content.points], crs)
    points = _points(given, crs)
    marks, warnings = _marks([content.marks for content in contents], points, sizes)
    marked = {mark.point for mark in marks}
    kept = tuple(point for name, point in points.items() if name in marked)
    unmarked = [point for name, point in points.items() if name not in marked]
    lost = [f"{point.name} ({point.where})" for point in unmarked if not point.is_check]
    warnings += [warning for content in contents for warning in content.warnings]
    warnings += named(lost, "control point", "without a mark in a photograph, left out")
    num = sum(not point.is_check for point in kept)
    if 0 < num < _ENOUGH:
        warnings.append(
            f"{num} control point{'s' if num > 1 else ''} with marks, expected {_ENOUGH} or more to fix place, tilt "
            "and scale; the positions of the cameras have to fix the rest"
        )
    if len(kept) >= _ENOUGH and all(point.place[2] == 0.0 for point in kept):
        warnings.append("all control points have the height 0; check that the file has their heights")
    order = {point.name: i for i, point in enumerate(kept)}
    marks.sort(key=lambda mark: (order[mark.point], mark.view))
    merged = MergedControl(kept, tuple(marks), tuple(point for point in unmarked if point.is_check))
    return merged, findings + Findings(warnings=tuple(warnings))


def _points(given: Sequence[GivenPoint], crs: CRS) -> dict[str, GivenPoint]:
    if not given:
        raise ControlError("[control] gcps has no points; name a file with name,easting,northing,height beside marks")
    same = _SAME_DEG if geo.crs.is_geographic(crs) else _SAME_M
    points: dict[str, GivenPoint] = {}
    for point in given:
        first = points.setdefault(point.name, point)
        if (np.abs(np.subtract(first.place, point.place)) > [same, same, _SAME_M]).any():
            at, before = (", ".join(f"{value:.10g}" for value in one.place) for one in (point, first))
            raise ControlError(
                f"{point.where}: the point {point.name} is at {at}, but at {before} in {first.where}; correct one of "
                "them, or give one another name"
            )
        if point.is_check:
            points[point.name] = replace(first, is_check=True)
    return points


def _marks(
    files: Sequence[Sequence[Mark]], points: Mapping[str, GivenPoint], sizes: Mapping[str, tuple[int, int]]
) -> tuple[list[Mark], list[str]]:
    """Marks of points in photographs, and warnings about those of unknown names."""
    if not any(files):
        raise ControlError(
            "[control] names points without marks, expected where photographs show them; name a table "
            "image,name,x,y or Metashape's XML in marks, or use a gcp_list.txt, which has both"
        )
    marks: dict[tuple[str, str], Mark] = {}
    unknown_images: dict[str, Mark] = {}
    unknown_points: dict[str, Mark] = {}
    for mark, names in ((mark, names) for given in files for names in [ImageNames(sizes)] for mark in given):
        image = names.find(mark.view, mark.where)
        if image is None:
            unknown_images.setdefault(mark.view, mark)
        elif mark.point not in points:
            unknown_points.setdefault(mark.point, mark)
        else:
            (width, height), (x, y) = sizes[image], mark.pixel
            if not (0.0 <= x <= width and 0.0 <= y <= height):
                raise ControlError(
                    f"{mark.where}: the mark of {mark.point} at {x:.6g}, {y:.6g} lies outside {image}, which has "
                    f"{width} x {height} pixels; if the photographs were reduced, reduce the marks too, else correct it"
                )
            first = marks.setdefault((mark.point, image), mark)
            if first.pixel != mark.pixel:
                raise ControlError(
                    f"{mark.where}: {mark.point} has a second mark in {image}, {x:.6g}, {y:.6g} after "
                    f"{first.pixel[0]:.6g}, {first.pixel[1]:.6g} in {first.where}; keep one"
                )
    if not marks:
        example = next(iter((unknown_images or unknown_points).values()))
        what = (
            f"photograph of the survey is called {example.view}"
            if unknown_images
            else f"point with coordinates is called {example.point}"
        )
        raise ControlError(
            f"{example.where}: no {what}, and none of the {sum(map(len, files))} marks belongs to one; use the names "
            f'that they have, e.g. "{next(iter(sizes if unknown_images else points))}"'
        )
    warnings = _left_out(unknown_images, "photograph", "that the survey does not have")
    warnings += _left_out(unknown_points, "point", "without coordinates")
    return [Mark(point, image, mark.pixel) for (point, image), mark in marks.items()], warnings


def _left_out(marks: Mapping[str, Mark], noun: str, why: str) -> list[str]:
    """A warning about marks of unknown names, with the place of the first."""
    return [
        f"{warning} (first in {next(iter(marks.values())).where}): their marks are left out; correct the names or "
        "remove the lines"
        for warning in named(list(marks), noun, f"{why} in the files of control")
    ]


def require_near(points: Sequence[GivenPoint], cameras: np.ndarray | None, crs: CRS) -> list[str]:
    """Warnings about implausible heights of points, which like the cameras (N, 3), if these are known, are in crs."""
    for point in points:
        east, north, _ = point.place
        message = f"{point.where}: the point {point.name} at {east:.10g}, {north:.10g}"
        distance, middle, at_cameras = math.inf, None, ""
        if cameras is not None:
            if (distance := _distance_m(point, cameras, crs)) <= _FARTHEST_M:
                continue
            middle = np.median(cameras, axis=0)
            at_cameras = f"the cameras are at {middle[0]:.10g}, {middle[1]:.10g}"
            swapped = _with_swapped_axes(point, crs)
            if swapped is not None and _distance_m(swapped, cameras, crs) <= _FARTHEST_M:
                raise ControlError(
                    f"{message} lies {distance_text(distance)} from the cameras, and among them with easting and "
                    "northing (or longitude and latitude) swapped; swap the two columns in the file"
                )
        if not geo.crs.is_geographic(crs) and abs(east) <= 180.0 and abs(north) <= 90.0:
            among = at_cameras and f", where {at_cameras}"
            raise ControlError(
                f"{message} looks like longitude and latitude, expected {crs.name}{among}; convert it, or name the CRS "
                'in the first line of a gcp_list.txt ("EPSG:4326", longitude first)'
            )
        if middle is not None:
            raise ControlError(
                f"{message} lies {distance_text(distance)} from the nearest camera, {at_cameras} in {crs.name}; "
                f"{_crs_advice(points, point, middle, crs)}"
            )
    return [] if cameras is None or not points else _height_warnings(points, cameras, crs)


def _with_swapped_axes(point: GivenPoint, crs: CRS) -> GivenPoint | None:
    """A point in crs with the first two numbers of its file swapped; None where that is not on the map."""
    given = point.as_read or point
    first, second, height = given.place
    try:
        return in_crs([replace(given, place=(second, first, height))], crs)[0][0]
    except (ControlError, GeoError):
        return None


def _height_warnings(points: Sequence[GivenPoint], cameras: np.ndarray, crs: CRS) -> list[str]:
    """Warnings about points above all cameras, or whose heights lie far from those of all others."""
    unit = geo.crs.height_unit_m(crs)
    heights, top = unit * np.array([point.place[2] for point in points]), unit * cameras[:, 2].max()
    texts = [f"{height:.2f} m in {point.where}" for point, height in zip(points, heights, strict=True)]
    if (heights > top).any():
        worst = int(np.argmax(heights))
        return [
            f"{int((heights > top).sum())} of {len(points)} control or check points lie above all cameras (highest "
            f"camera {top:.2f} m, {points[worst].name} {texts[worst]}); check that their heights have the "
            "vertical datum of crs"
        ]
    off = np.abs(heights - np.median(heights))
    far = off > max(_FAR * float(np.median(off)), _FAR_HEIGHT_M)
    if len(points) < _FEWEST or not far.any():
        return []
    low, high = heights[~far].min(), heights[~far].max()
    why = f"far from the others by its height, which are at {low:.2f} to {high:.2f} m"
    names = [f"{points[i].name} ({texts[i]})" for i in np.flatnonzero(far).tolist()]
    return named(names, "control or check point", why)


def _distance_m(point: GivenPoint, cameras: np.ndarray, crs: CRS) -> float:
    """Horizontal distance [m] from the nearest camera, on the map."""
    unit = geo.crs.horizontal_unit(crs)
    steps = (cameras[:, :2] - np.array(point.place[:2])) * unit
    if geo.crs.is_geographic(crs):
        steps *= geo.crs.EARTH_RADIUS_M * np.array([math.cos(float(np.median(cameras[:, 1])) * unit), 1.0])
    nearest = float(np.linalg.norm(steps, axis=1).min())
    return nearest if math.isfinite(nearest) else math.inf


def _crs_advice(points: Sequence[GivenPoint], far: GivenPoint, middle: np.ndarray, crs: CRS) -> str:
    """What to do about points far from the cameras: the CRS that they are likely in, by where they would lie."""
    if far.as_read is not None and far.as_read.crs is not None:
        return f"the file states {far.as_read.crs.name}: correct that, the point, or crs in survey.toml"
    file = far.where.partition(", line ")[0]
    own = np.array([point.place for point in points if point.where.startswith(file)])
    lon, lat = lon_lat(crs, middle[None, :2])[0].tolist()
    others = likely_crs(own, (lon, lat), _FARTHEST_M, crs)[:3]
    if not others:
        return "correct it, or crs in survey.toml, or state the CRS of the file (# EPSG:n in its first line)"
    codes = " or ".join(f"EPSG:{other.to_epsg()} ({other.name})" for other in others)
    vertical, code = geo.crs.vertical_crs(crs), f"EPSG:{others[0].to_epsg()}"
    heights = "" if vertical is None or vertical.to_epsg() is None else f"+{vertical.to_epsg()}"
    return (
        f"in {codes} it lies among them: if that is the CRS of the file, state it in its first line (# {code}), or "
        f'write crs = "{code}{heights}" in survey.toml'
    )
