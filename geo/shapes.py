"""Points and triangles in crs coordinates, as files hold them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from pyproj import CRS

from geo.errors import UnreadableFile


@dataclass(frozen=True)
class Cloud:
    """Points of a file."""

    points: np.ndarray  # (N, 3) float64, in crs: Easting or longitude, northing or latitude, height
    rgb: np.ndarray | None = None  # (N, 3) uint8
    crs: CRS | None = None  # None if the file states none, or one that is not understood; `notes` says which
    classification: np.ndarray | None = None  # (N,) uint8: Classes of LAS
    # (N,) or (N, k): further values by name; NaN where the file declares "no data"
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # Sentences for the user about missing parts of the file
    withheld: np.ndarray | None = None  # (N,) bool: Points that the file itself says are not to be used
    height_unit_m: float | None = None  # [m]: One unit of height, where the file says it and its CRS does not
    # (N,) bool: Points where flight lines overlap, as formats 6 and later of LAS flag them
    overlap: np.ndarray | None = None


@dataclass(frozen=True)
class Mesh:
    """Triangles of a file."""

    vertices: np.ndarray  # (V, 3) float64, in crs
    faces: np.ndarray  # (F, 3) int64: Vertex numbers in the winding of the file; polygons are cut into fans
    crs: CRS | None = None  # None where the file states none
    rgb: np.ndarray | None = None  # (V, 3) uint8: Of the vertices
    notes: tuple[str, ...] = ()  # Sentences for the reader about what the file lacks
    height_unit_m: float | None = None  # [m]: One unit of height, where the file says it and its CRS does not


_Shape = TypeVar("_Shape", bound=Mesh | Cloud)
# Classes of LAS 1.4 and its topo-bathy profile that are left out: noise, water, and places where no bottom was found.
NOT_GROUND = {
    7: "low noise", 9: "water", 18: "high noise", 41: "water surface", 42: "derived water surface",
    45: "no bottom found",
}  # fmt: skip
# Not ground by LAS 1.4, but a survey may be of such points: a wreck, a quay. They are used, counted and reported.
_USED_AS_GROUND = {
    3: "low vegetation", 4: "medium vegetation", 5: "high vegetation", 6: "building",
    12: "overlap of flight lines, in formats 0 to 5", 13: "wire guard", 14: "wire conductor", 15: "transmission tower",
    16: "wire connector", 17: "bridge deck", 19: "overhead structure", 20: "ignored ground", 22: "temporal exclusion",
}  # fmt: skip


def as_classes(values: np.ndarray | None) -> np.ndarray | None:
    """LAS classes (N,) uint8 from a column (N,) of numbers; None where these are no classes."""
    if values is None or not (np.isin(values % 1, 0) & (values >= 0) & (values <= 255)).all():
        return None
    return values.astype(np.uint8)


def excluded_points(cloud: Cloud) -> tuple[np.ndarray, str]:
    """Mask (N,) of points that are not ground by their classes and flags, and their counts in words."""
    out = np.zeros(len(cloud.points), dtype=bool)
    parts = []
    if cloud.withheld is not None and cloud.withheld.any():
        out |= cloud.withheld
        parts.append(f"{int(cloud.withheld.sum())} flagged withheld")
    for code, name in NOT_GROUND.items() if cloud.classification is not None else ():
        of_class = (cloud.classification == code) & ~out
        if of_class.any():
            parts.append(f"{int(of_class.sum())} of class {code} ({name})")
            out |= of_class
    return out, ", ".join(parts)


def used_as_ground(cloud: Cloud) -> str:
    """Counts, in words, of points that are used although their class or flag (but synthetic) says otherwise."""
    classes = cloud.classification if cloud.classification is not None else np.zeros(0, dtype=np.uint8)
    count = np.bincount(classes, minlength=256)
    parts = [f"{count[code]} of class {code} ({name})" for code, name in _USED_AS_GROUND.items() if count[code]]
    if cloud.overlap is not None and cloud.overlap.any():
        parts.append(f"{int(cloud.overlap.sum())} flagged overlap")
    return ", ".join(parts)


def ground_of(cloud: Cloud, path: object) -> tuple[Cloud, tuple[str, ...]]:
    """The points of a file that are ground by their classes and flags, and a note that counts the others."""
    out, kinds = excluded_points(cloud)
    if out.all():
        raise UnreadableFile(f"no point of {path} is of the ground: it holds {kinds}; give the points of the bed.")
    return masked_cloud(cloud, ~out), (f"{path}: of its points {kinds} are left out",) if kinds else ()


def masked_cloud(cloud: Cloud, keep: np.ndarray) -> Cloud:
    """The points of a cloud that a mask (N,) keeps, with all their attributes."""

    def kept(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[keep]

    names = ("points", "rgb", "classification", "withheld", "overlap")
    columns: dict = {name: kept(getattr(cloud, name)) for name in names}
    return replace(cloud, **columns, extra={name: values[keep] for name, values in cloud.extra.items()})


def vertices_of(shape: Mesh | Cloud) -> np.ndarray:
    """Points (N, 3) of a cloud or vertices of a mesh, in crs."""
    return shape.vertices if isinstance(shape, Mesh) else shape.points


def in_height_unit(shape: _Shape, unit_m: float) -> _Shape:
    """A shape with its heights converted to another unit [m], where its file states one besides its CRS."""
    if shape.height_unit_m is None or shape.height_unit_m == unit_m:
        return shape
    converted = vertices_of(shape) * np.array([1.0, 1.0, shape.height_unit_m / unit_m])
    return replace(shape, height_unit_m=unit_m, **{"vertices" if isinstance(shape, Mesh) else "points": converted})


def triangulated(counts: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) int64 of polygons with so many corners (P,), cut into fans around their first, in order.

    ``corners`` are their vertex numbers, polygon after polygon; those of fewer than three give no triangle.
    """
    counts = np.asarray(counts, dtype=np.int64)
    corners = np.asarray(corners, dtype=np.int64)
    starts = np.cumsum(counts) - counts
    fans = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), fans)
    within = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    first = starts[polygon]
    return corners[np.stack([first, first + within + 1, first + within + 2], axis=-1)]


# Rows that are worked on at a time, unless a caller has its own number.
_PORTION = 250_000


def portions(count: int, at_once: int | None = None) -> Iterator[slice]:
    """Slices that cover ``count`` rows, of at most ``at_once`` rows each."""
    step = _PORTION if at_once is None else at_once
    return (slice(first, first + step) for first in range(0, count, step))


class ComputedColumn:
    """A column (N,) that is a function of the same rows of others (N, ...), computed for those that are asked for."""

    def __init__(self, function: Callable[..., np.ndarray], *columns: np.ndarray):
        self._function, self._columns = function, columns

    def __len__(self) -> int:
        return len(self._columns[0])

    def __getitem__(self, rows) -> np.ndarray:
        """Values of some rows: a slice, or their numbers."""
        return self._function(*(np.asarray(column[rows]) for column in self._columns))
