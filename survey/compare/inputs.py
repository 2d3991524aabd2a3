"""Inputs of a comparison: files and tables of points read, checked against each other, and their local frame."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

import geo.shapes
from evaluation import weld
from evaluation.c2m import has_area
from geo import LocalFrame, require_same_crs, require_same_place
from geo.atl24 import SUFFIXES as ATL24
from geo.atl24 import read_atl24
from geo.compatibility import bounds_in_other_order
from geo.crs import has_height, height_unit_m, is_geographic
from geo.files import existing_file
from geo.reading import check_values, read_reference, rounded_coordinates
from survey.compare.options import Bounds, CompareError, as_text
from survey.files.csv_table import Row
from survey.files.foreign_text import crs_of_comment
from survey.files.point_table import PLACE, Units, has_depths, point_table, read_points

# How a user tells the level that depths count from.
GIVE_LEVEL = "give --water-level"
# Names that programs give the depth of a point.
DEPTH_NAMES = ("depth", "depth_m")
# Water levels over the points of a cloud that differ by less are equal: rounding, not the slope of a river.
_ONE_LEVEL_M = 0.02
# The class of LAS of points that have none.
_UNCLASSIFIED = 1.0
# Of files that are read as tables.
SUFFIXES = (".csv", ".xyz", ".txt", ".tsv", ".pts")
# Heights further apart than this many times the size of the data are another place, not an error of the bed.
_FARTHEST_HEIGHT = 10.0


def is_table(path: Path) -> bool:
    """Whether a file is a table of points, by the suffix of its name."""
    return path.suffix.lower() in SUFFIXES


def read_shape(path: Path, water_level: float | None, crs: CRS | None = None) -> geo.shapes.Mesh | geo.shapes.Cloud:
    """A mesh or cloud as `geo.read_reference`, or the points of a table, depths below the level of the water.

    The level is in the CRS of the comparison; `crs` is that of a table that names none, and of the heights of one that
    names one without.
    """
    if not is_table(path):
        return read_reference(path)
    own = crs_of_comment(existing_file(path), CompareError)
    table = point_table(path, CompareError)
    rows = read_points(
        table,
        optional=("std", "classification", "depth"),
        by_place=True,
        level=water_level,
        give_level=GIVE_LEVEL,
        units=Units.of(own or crs, crs),
    )
    if not rows:
        raise CompareError(f"{path} has no points; expected lines of easting, northing, height")
    points = np.array([[row.number(name) for name in PLACE] for row in rows])
    classes, notes = _classes_of(rows, path)
    # Soundings have the depth below the water beside the height.
    extra = {} if has_depths(table) else {"depth": np.array([row.number("depth", default=np.nan) for row in rows])}
    extra = {name: values for name, values in extra.items() if np.isfinite(values).any()}
    notes = (*check_values(points, own, path), *notes)
    return geo.shapes.Cloud(points=points, crs=own, classification=classes, extra=extra, notes=notes)


def _classes_of(rows: Sequence[Row], path: Path) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Classes (N,) of LAS, and a note where a column of that name has none; empty cells are not classified."""
    parts = [row.cells.get("classification", "") for row in rows]
    if not any(parts):
        return None, ()
    classes = np.empty(len(rows), dtype=np.uint8)
    for number, (row, cell) in enumerate(zip(rows, parts, strict=True)):
        with suppress(CompareError):
            found = geo.shapes.as_classes(np.array([row.number("classification", default=_UNCLASSIFIED)]))
            if found is not None:
                classes[number] = found[0]
                continue
        return None, (f"the classes of {path.name} are not those of LAS ({cell}): all its points count",)
    return classes, ()


def level_of_cloud(shape: geo.shapes.Mesh | geo.shapes.Cloud) -> float | None:
    """Height of the water over a cloud, in its CRS, by the depths of its points; None where it has no one level."""
    if not isinstance(shape, geo.shapes.Cloud):
        return None
    depth = next((shape.extra[name] for name in DEPTH_NAMES if name in shape.extra), np.empty(0))
    if not (depth > 0.0).any():
        return None
    unit = 1.0 if shape.crs is None or not has_height(shape.crs) else height_unit_m(shape.crs)
    levels = (shape.points[:, 2] + depth / unit)[depth > 0.0]
    low, middle, high = np.quantile(levels, [0.02, 0.5, 0.98])
    return float(middle) if (high - low) * unit < _ONE_LEVEL_M else None


@dataclass(frozen=True)
class ShiftedFrame:
    """Substitute for a `LocalFrame` if no file has a CRS: coordinates in metres, shifted near zero."""

    origin: tuple[float, float, float]

    def local_from_crs(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) as given, minus the origin [m]."""
        return np.asarray(points, dtype=np.float64) - self.origin

    def crs_from_local(self, points: np.ndarray) -> np.ndarray:
        """The inverse."""
        return np.asarray(points, dtype=np.float64) + self.origin


@dataclass(frozen=True)
class InputPaths:
    """The files of a comparison; ``visible`` is None where it is not known what cameras see."""

    cloud: Path
    reference: Path
    visible: Path | None = None


@dataclass(frozen=True)
class Inputs:
    """A cloud, its reference and a frame for both."""

    paths: InputPaths
    cloud: geo.shapes.Cloud  # As read, not cropped
    # (N,) bool: the points that are compared: within the bounds, and of the ground by what the file says of them
    inside: np.ndarray
    num_cropped: int  # Points beyond the bounds
    reference: geo.shapes.Mesh | geo.shapes.Cloud
    visible: geo.shapes.Mesh | geo.shapes.Cloud | None
    crs: CRS | None  # Of all coordinates; None if no file has one
    frame: LocalFrame | ShiftedFrame  # Near the points that are compared
    notes: tuple[str, ...]  # Assumptions, where files state nothing


def load_inputs(paths: InputPaths, bounds: Bounds | None, water_level: float | None = None) -> Inputs:
    """Read the files of a comparison and refuse what cannot be compared.

    Depths in tables count from ``water_level``, in the CRS of the cloud, else from the water that the cloud has.
    """
    compared, given = _read_shapes(paths, water_level)
    shapes = {paths.cloud: compared} | given
    notes = [note for shape in (compared, *given.values()) for note in shape.notes]
    crs, crs_notes = common_crs({path: shape.crs for path, shape in shapes.items()})
    notes += crs_notes
    for path, shape in shapes.items():
        if shape.crs is None and crs is not None and is_geographic(crs):
            # Check the rounding again as degrees, in which a tenth of a metre is six decimals.
            notes += rounded_coordinates(geo.shapes.vertices_of(shape), crs, path)
    cloud = _in_common_unit(compared, paths.cloud, crs, notes)
    if isinstance(cloud, geo.shapes.Mesh):
        cloud = geo.shapes.Cloud(points=cloud.vertices, crs=cloud.crs)
        notes.append(f"{paths.cloud.name} is a mesh: its vertices are compared")
    others: dict[Path, geo.shapes.Mesh | geo.shapes.Cloud] = {}
    for path, given_shape in given.items():
        shape = _in_common_unit(given_shape, path, crs, notes)
        if isinstance(shape, geo.shapes.Cloud):
            others[path] = geo.shapes.masked_cloud(shape, _is_ground(shape, path, notes))
        else:
            others[path] = _welded(shape, path)
        require_same_place(cloud.points, geo.shapes.vertices_of(others[path]), str(paths.cloud), str(path))
    reference = others[paths.reference]
    cropped = _cropped(cloud, bounds, paths.cloud)
    cloud_notes: list[str] = []
    inside = ~cropped & _is_ground(cloud, paths.cloud, cloud_notes)
    kept = cloud.points[inside]
    if not len(kept):
        raise CompareError(f"no point of {paths.cloud} within the bounds is of the ground, by its class or flag")
    require_same_place(kept, geo.shapes.vertices_of(reference), f"{paths.cloud} (cropped)", str(paths.reference))
    east, north, height = (float(v) for v in 0.5 * (kept.min(axis=0) + kept.max(axis=0)))
    origin = (east, north, height)
    frame = ShiftedFrame(origin) if crs is None else LocalFrame(crs, origin)
    notes += cloud_notes + _height_warnings(kept, geo.shapes.vertices_of(reference), paths, frame)
    visible = None if paths.visible is None else others[paths.visible]
    return Inputs(paths, cloud, inside, int(cropped.sum()), reference, visible, crs, frame, tuple(notes))


def _read_shapes(
    paths: InputPaths, water_level: float | None
) -> tuple[geo.shapes.Mesh | geo.shapes.Cloud, dict[Path, geo.shapes.Mesh | geo.shapes.Cloud]]:
    """What is compared as its file has it, and reference and visible points by their paths, in the same CRS."""
    crs = None
    if is_table(paths.cloud):
        # That of the reference, whose points may not be read yet, as their depths count from the water of the cloud.
        of_table = is_table(paths.reference)
        crs = crs_of_comment(paths.reference, CompareError) if of_table else read_reference(paths.reference).crs
    compared = read_shape(paths.cloud, water_level, crs)
    level = level_of_cloud(compared) if water_level is None else water_level
    given = {
        path: read_atl24(path, compared.crs, geo.shapes.vertices_of(compared))
        if path.suffix.lower() in ATL24
        else read_shape(path, level, compared.crs)
        for path in (paths.reference, paths.visible)
        if path is not None
    }
    for path, other in given.items():
        require_same_crs(compared.crs, other.crs, str(paths.cloud), str(path))
    return compared, given


def _cropped(cloud: geo.shapes.Cloud, bounds: Bounds | None, path: Path) -> np.ndarray:
    """Mask (N,) of the points beyond the bounds; raise CompareError where that is all of them."""
    if bounds is not None and (meant := bounds_in_other_order(bounds, cloud.points)) is not None:
        raise CompareError(
            f"--bounds is {as_text(bounds)}, which is not in the order E0 N0 E1 N1: give --bounds {as_text(meant)}"
        )
    cropped = ~within(cloud.points, bounds)
    if cropped.all():
        low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
        raise CompareError(
            f"none of the {len(cloud.points)} points of {path} lies within the bounds "
            f"{as_text(bounds)}; it reaches from {as_text(low[:2])} to {as_text(high[:2])}: correct "
            "--bounds (E0 N0 E1 N1 in its CRS)"
        )
    return cropped


def _in_common_unit(
    shape: geo.shapes.Mesh | geo.shapes.Cloud, path: Path, crs: CRS | None, notes: list[str]
) -> geo.shapes.Mesh | geo.shapes.Cloud:
    """A shape with heights in the unit of the common CRS, where its file gives a unit beside its own CRS."""
    unit_m = 1.0 if crs is None else height_unit_m(crs)
    if shape.height_unit_m is not None and abs(shape.height_unit_m - unit_m) > 1e-9:
        notes.append(
            f"{path.name} gives its heights in units of {shape.height_unit_m:.10g} m: converted to units of "
            f"{unit_m:.10g} m"
        )
    return geo.shapes.in_height_unit(shape, unit_m)


def _is_ground(cloud: geo.shapes.Cloud, path: Path, notes: list[str]) -> np.ndarray:
    """Mask (N,) of the points that are compared, by the classes and flags of their file; notes count the others."""
    out, kinds = geo.shapes.excluded_points(cloud)
    if out.all():
        raise CompareError(f"no point of {path} is of the ground: it holds {kinds}; give it with the points of the bed")
    if kinds:
        notes.append(
            f"{int(out.sum())} of {len(out)} points of {path.name} are not of the ground and left out: {kinds}"
        )
    if doubtful := geo.shapes.used_as_ground(cloud):
        notes.append(f"{path.name} counts as ground with {doubtful}: leave them out of the file where they are none")
    return ~out


def _welded(shape: geo.shapes.Mesh, path: Path) -> geo.shapes.Mesh:
    """A mesh with equal vertices merged, so that triangles share edges."""
    vertices, faces = weld(shape.vertices, shape.faces)
    if not has_area(vertices, faces).any():
        raise CompareError(
            f"none of the {len(faces)} triangles of {path} has an area; export the surface again, or its points alone"
        )
    return replace(shape, vertices=vertices, faces=faces, rgb=None)


def common_crs(known: Mapping[Path, CRS | None]) -> tuple[CRS | None, list[str]]:
    """The CRS of all files, None if none has one: the first that has heights, else the first; notes on the others."""
    stated = {file: crs for file, crs in known.items() if crs is not None}
    if not stated:
        names = " nor ".join(dict.fromkeys(file.name for file in known))
        return None, [
            f"neither {names} has a CRS: coordinates are taken as metres, and the scale of a map grid is not corrected"
        ]
    source = next((file for file, crs in stated.items() if has_height(crs)), next(iter(stated)))
    crs, notes = stated[source], []
    for file, own in known.items():
        if own is None:
            notes.append(f"{file.name} does not say its CRS: taken to be that of {source.name}, {crs.name}")
        elif not has_height(own):
            like = f"those of {source.name}" if has_height(crs) else "metres above one datum in all files"
            notes.append(f"the CRS of {file.name} does not say what heights count from: taken as {like}")
    return crs if has_height(crs) else crs.to_3d(), notes


def _height_warnings(
    points: np.ndarray, vertices: np.ndarray, paths: InputPaths, frame: LocalFrame | ShiftedFrame
) -> list[str]:
    """Raise where heights are too far apart to be of one place; a note on those that do not overlap."""
    # Two points give the size in metres, whatever the units of the CRS.
    corners = frame.local_from_crs(np.array([points.min(axis=0), points.max(axis=0)]))
    size_m = max(float(np.linalg.norm(corners[1] - corners[0])), 1.0)
    low, high = points[:, 2].min(), points[:, 2].max()
    ref_low, ref_high = vertices[:, 2].min(), vertices[:, 2].max()
    gap = max(low - ref_high, ref_low - high)
    if gap <= 0.0:
        return []
    message = (
        f"the heights of {paths.cloud} ({low:.10g} to {high:.10g}) and of {paths.reference} ({ref_low:.10g} to "
        f"{ref_high:.10g}) do not meet"
    )
    remedy = "check that both count from the same vertical datum"
    if gap > _FARTHEST_HEIGHT * size_m:
        raise CompareError(f"{message}; {remedy}, and in the same unit")
    return [f"{message}: {remedy}"]


def within(points: np.ndarray, bounds: Bounds | None, margins: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Whether points (N, 3) lie in bounds (edges included) that grow by margins in easting and northing."""
    if bounds is None:
        return np.ones(len(points), dtype=bool)
    low, high = np.array(bounds[:2]) - margins, np.array(bounds[2:]) + margins
    inside = (points[:, :2] >= low) & (points[:, :2] <= high)
    return inside[:, 0] & inside[:, 1]


def to_local(frame: LocalFrame | ShiftedFrame, points: np.ndarray, name: Path) -> np.ndarray:
    """Points (N, 3) in the local frame [m]."""
    local = frame.local_from_crs(points)
    if isinstance(frame, ShiftedFrame):
        return local
    bad = int((~np.isfinite(local).all(axis=1)).sum())
    if bad:
        raise CompareError(
            f"{bad} of {len(points)} points of {name} lie where {frame.crs.name} is not defined; remove them or "
            "correct the CRS of the file"
        )
    return local


def metres_in_crs(frame: LocalFrame | ShiftedFrame, length_m: float) -> tuple[float, float]:
    """A length [m] near the origin in units of easting and of northing (degrees in a geographic CRS)."""
    origin = np.array(frame.origin)
    step = 1e-6 * max(float(np.abs(origin[:2]).max()), 1.0)
    ends = frame.local_from_crs(origin + step * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]))
    east, north = (length_m * 2.0 * step / np.linalg.norm(ends[::2] - ends[1::2], axis=1)).tolist()
    return east, north
