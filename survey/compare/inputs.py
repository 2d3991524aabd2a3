"""What a comparison needs: the files read, checked against each other, and brought into one local frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS

from evaluation import weld
from evaluation.triangles import has_area
from geo import Cloud, LocalFrame, Mesh, read_reference, require_same_crs, require_same_place
from geo.crs import has_height
from survey.errors import SurveyError

Bounds = tuple[float, float, float, float]

# Heights further apart than this many times the size of the data are another place, not an error of the bed.
_FARTHEST_HEIGHT = 10.0


class CompareError(SurveyError):
    """Two data sets that cannot be compared, or options that cannot be meant."""


@dataclass(frozen=True)
class ShiftedFrame:
    """In place of a `LocalFrame` where no file says its CRS: coordinates in metres, shifted near zero."""

    origin: tuple[float, float, float]

    def local_from_crs(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) as given, minus the origin [m]."""
        return np.asarray(points, dtype=np.float64) - self.origin

    def crs_from_local(self, points: np.ndarray) -> np.ndarray:
        """The inverse."""
        return np.asarray(points, dtype=np.float64) + self.origin


@dataclass(frozen=True)
class Inputs:
    """A cloud, its reference and a frame for both.

    Attributes
    ----------
    cloud : Cloud
        As read, not cropped.
    inside : (N,) bool
        The points within the bounds; all of them without bounds.
    reference : Mesh or Cloud
    visible : Mesh or Cloud or None
    crs : pyproj.CRS or None
        Of all coordinates; None if no file says.
    frame : LocalFrame or ShiftedFrame
        Near the points that are compared.
    notes : tuple of str
        What was taken to be so without a file saying it.
    """

    cloud: Cloud
    inside: np.ndarray
    reference: Mesh | Cloud
    visible: Mesh | Cloud | None
    crs: CRS | None
    frame: LocalFrame | ShiftedFrame
    notes: tuple[str, ...]


def load_inputs(cloud_path: Path, reference_path: Path, visible_path: Path | None, bounds: Bounds | None) -> Inputs:
    """Read the files of a comparison and refuse what cannot be compared.

    Raises
    ------
    GeoError
        If a file is missing, damaged or empty, or in another CRS or place than the cloud.
    CompareError
        If no point is within the bounds, or the heights cannot be of one place.
    """
    notes: list[str] = []
    cloud = _as_cloud(read_reference(cloud_path), cloud_path, notes)
    reference = _surface(read_reference(reference_path), reference_path)
    visible = _surface(read_reference(visible_path), visible_path) if visible_path is not None else None
    others = {reference_path: reference} | ({visible_path: visible} if visible is not None else {})
    for path, other in others.items():
        require_same_crs(cloud.crs, other.crs, str(cloud_path), str(path))
        require_same_place(cloud.points, vertices_of(other), str(cloud_path), str(path))
    inside = within(cloud.points, bounds)
    if not inside.any():
        low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
        raise CompareError(
            f"none of the {len(cloud.points)} points of {cloud_path} lies within the bounds "
            f"{_numbers(bounds)}; it reaches from {_numbers(low[:2])} to {_numbers(high[:2])}: correct "
            "--bounds (E0 N0 E1 N1 in its CRS)"
        )
    kept = cloud.points[inside]
    require_same_place(kept, vertices_of(reference), f"{cloud_path} (cropped)", str(reference_path))
    notes += [note for shape in (cloud, *others.values()) for note in getattr(shape, "notes", ())]
    crs = _common_crs(cloud, cloud_path, others, notes)
    origin = tuple(float(v) for v in 0.5 * (kept.min(axis=0) + kept.max(axis=0)))
    frame = ShiftedFrame(origin) if crs is None else LocalFrame(crs, origin)
    _check_heights(kept, cloud_path, vertices_of(reference), reference_path, frame, notes)
    return Inputs(cloud, inside, reference, visible, crs, frame, tuple(notes))


def vertices_of(shape: Mesh | Cloud) -> np.ndarray:
    """Points (N, 3) of a cloud or vertices of a mesh."""
    return shape.vertices if isinstance(shape, Mesh) else shape.points


def within(points: np.ndarray, bounds: Bounds | None, margins: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Whether points (N, 3) lie in bounds (edges included) that grow by margins in easting and northing."""
    if bounds is None:
        return np.ones(len(points), dtype=bool)
    e0, n0, e1, n1 = bounds
    east, north = points[:, 0], points[:, 1]
    return (
        (east >= e0 - margins[0]) & (east <= e1 + margins[0]) & (north >= n0 - margins[1]) & (north <= n1 + margins[1])
    )


def to_local(frame: LocalFrame | ShiftedFrame, points: np.ndarray, name: Path) -> np.ndarray:
    """Points (N, 3) in the local frame [m].

    Raises
    ------
    CompareError
        If some lie where the projection of the CRS ends.
    """
    local = frame.local_from_crs(points)
    bad = int((~np.isfinite(local).all(axis=1)).sum())
    if bad:
        raise CompareError(
            f"{bad} of {len(points)} points of {name} lie off the map of {frame.crs.name}; remove them or "
            "correct the CRS of the file"
        )
    return local


def metres_in_crs(frame: LocalFrame | ShiftedFrame, length_m: float) -> tuple[float, float]:
    """A length [m] near the origin in units of easting and of northing (degrees in a geographic CRS)."""
    e, n, h = frame.origin
    step = 1e-6 * max(abs(e), abs(n), 1.0)
    ends = np.array([[e + step, n, h], [e - step, n, h], [e, n + step, h], [e, n - step, h]])
    local = frame.local_from_crs(ends)
    east = float(np.linalg.norm(local[0] - local[1])) / (2.0 * step)
    north = float(np.linalg.norm(local[2] - local[3])) / (2.0 * step)
    return length_m / east, length_m / north


def _as_cloud(shape: Mesh | Cloud, path: Path, notes: list[str]) -> Cloud:
    if isinstance(shape, Cloud):
        return shape
    notes.append(f"{path.name} is a mesh: its vertices are compared")
    return Cloud(points=shape.vertices, crs=shape.crs)


def _surface(shape: Mesh | Cloud, path: Path) -> Mesh | Cloud:
    """A mesh with its equal vertices made one, so that triangles know their neighbours; a cloud as it is."""
    if isinstance(shape, Cloud):
        return shape
    vertices, faces = weld(shape.vertices, shape.faces)
    if not has_area(vertices, faces).any():
        raise CompareError(
            f"none of the {len(faces)} triangles of {path} has an area; export the surface again, or its points alone"
        )
    return Mesh(vertices, faces, crs=shape.crs)


def _common_crs(cloud: Cloud, path: Path, others: dict[Path, Mesh | Cloud], notes: list[str]) -> CRS | None:
    """The CRS of all files, None if none says it: the first that has heights, else the first."""
    known = {path: cloud.crs} | {other_path: other.crs for other_path, other in others.items()}
    said = {file: crs for file, crs in known.items() if crs is not None}
    if not said:
        names = " nor ".join(dict.fromkeys(file.name for file in known))
        notes.append(
            f"neither {names} says its CRS: coordinates are taken as metres, and the scale of a map grid is "
            "not taken out"
        )
        return None
    source = next((file for file, crs in said.items() if has_height(crs)), next(iter(said)))
    crs = said[source]
    for file in known:
        if known[file] is None:
            notes.append(f"{file.name} does not say its CRS: taken to be that of {source.name}, {crs.name}")
        elif not has_height(known[file]):
            like = f"those of {source.name}" if has_height(crs) else "metres above one datum in all files"
            notes.append(f"the CRS of {file.name} does not say what heights count from: taken as {like}")
    return crs if has_height(crs) else crs.to_3d()


def _check_heights(
    points: np.ndarray,
    cloud_path: Path,
    vertices: np.ndarray,
    reference_path: Path,
    frame: LocalFrame | ShiftedFrame,
    notes: list[str],
) -> None:
    """Refuse heights that are of another place, and note those that do not meet."""
    # Two points tell the size, whatever the units of the CRS.
    corners = frame.local_from_crs(np.array([points.min(axis=0), points.max(axis=0)]))
    size_m = max(float(np.linalg.norm(corners[1] - corners[0])), 1.0)
    low, high = points[:, 2].min(), points[:, 2].max()
    ref_low, ref_high = vertices[:, 2].min(), vertices[:, 2].max()
    gap = max(low - ref_high, ref_low - high)
    if gap <= 0.0:
        return
    said = (
        f"the heights of {cloud_path} ({low:.10g} to {high:.10g}) and of {reference_path} ({ref_low:.10g} to "
        f"{ref_high:.10g}) do not meet"
    )
    mend = "check that both count from the same vertical datum"
    if gap > _FARTHEST_HEIGHT * size_m:
        raise CompareError(f"{said}; {mend}, and in the same unit")
    notes.append(f"{said}: {mend}")


def _numbers(values) -> str:
    return " ".join(f"{value:.10g}" for value in values)


def check_bounds(bounds: Bounds | None) -> None:
    """Raise CompareError unless bounds are four finite numbers, the low ones first."""
    if bounds is None:
        return
    if len(bounds) != 4 or not all(math.isfinite(v) for v in bounds):
        raise CompareError(f"--bounds is {tuple(bounds)}, expected four finite numbers E0 N0 E1 N1")
    e0, n0, e1, n1 = bounds
    if e0 >= e1 or n0 >= n1:
        raise CompareError(
            f"--bounds is {_numbers(bounds)}, expected E0 N0 E1 N1 with E0 below E1 and N0 below N1; put the "
            "south-west corner first"
        )
