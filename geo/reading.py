"""Clouds and meshes read by the suffix of their file: PLY, OBJ, LAS, LAZ, COPC, GeoTIFF, BAG; with extras glTF, E57.

Of every file the values are checked for rounding (single precision, few digits) and undeclared no-data values, whatever
type the format stores.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import has_height, height_unit_m
from geo.e57 import read_e57
from geo.errors import UnreadableFile
from geo.files import existing_file
from geo.las import read_cloud
from geo.meshes import read_gltf, read_obj
from geo.ply import read_ply
from geo.projection import ground_units_m
from geo.shapes import Cloud, Mesh, vertices_of

# Coarser steps than this begin to spoil a comparison.
_COARSEST_STEP_M = 0.005
# Steps up to this may be intended, as in LAS; larger ones are rounding, as are those of single precision or few digits.
_COARSEST_MEANT_M = 0.05
_LARGEST_STEP_M = 1000.0
_STEPS = sorted({*(2.0**k for k in range(-30, 12)), *(float(f"1e{k}") for k in range(-9, 5))}, reverse=True)
_SMALLEST_EXTENT_M = 0.05
# Fewer points than this may lie on whole metres by chance or by design.
_FEWEST = 10
_SAMPLE = 1000
# This many points around the middle are enough to estimate the density of a cloud.
_ENOUGH = 500_000
# Half a step of LAS, in which rounded values may have been stored later.
_STORED_M = 0.0006
_DIGITS = range(4, 10)
# Share of points with another height at the same place in plan; share of the cells of a raster with a height.
_MANY_SHARED, _RASTER = 0.1, 0.3

# No-data values that programs write where there is no height; 0 may also be one.
_NO_DATA_VALUES = (-9999.0, 9999.0, -99999.0, 99999.0, -999.0, -32768.0, -32767.0, 32767.0, 65535.0, 1e6, -1e6)
_BEYOND_EARTH = 1e7
# The highest ground on Earth, also in feet.
_HIGHEST = 30_000.0
_FAR, _FAR_UNKNOWN, _SPREADS = 100.0, 1000.0, 10.0
_SHARE = 0.01


def is_no_data_value(height: float) -> bool:
    """Whether a height is a usual no-data value that no place on Earth has."""
    return height in _NO_DATA_VALUES and not 0.0 < height < _HIGHEST


def check_values(points: np.ndarray, crs: CRS | None, path: Path) -> tuple[str, ...]:
    """Notes on the points (N, 3) of a file, in crs (None: metres)."""
    # Coordinates of a damaged file may be as large as numbers go.
    with np.errstate(over="ignore", invalid="ignore"):
        return (*_no_data_notes(points[:, 2], path), *rounded_coordinates(points, crs, path))


def rounded_coordinates(points: np.ndarray, crs: CRS | None, path: Path) -> tuple[str, ...]:
    """Notes on rounded coordinates of points (N, 3) in crs: the part of `check_values` that tests their steps."""
    if len(points) < _FEWEST:
        return ()
    metres = np.ones(2) if crs is None else ground_units_m(crs, points[0])
    steps = np.array([_step(values, unit) for values, unit in zip(points[:, :2].T, metres, strict=True)])
    if np.isinf(steps).all() and points[:, 2].min() < points[:, 2].max():
        raise UnreadableFile(
            f"all {len(points)} points of {path} have the same easting and northing, and different heights: their "
            "places were rounded; export it again with double precision and all decimals."
        )
    notes = _rounded_heights(points[:, 2], 1.0 if crs is None or not has_height(crs) else height_unit_m(crs), path)
    if not (np.isfinite(steps) & (steps > 0.0)).any():
        return notes
    listed = " and ".join(f"{step:.3g}" for step in steps if step > 0.0 and np.isfinite(step))
    what = f"the eastings and northings of {path} are multiples of {listed}"
    by = _rounding_cause(points[:, :2], steps, metres)
    shared, is_raster = _shared_places(points)
    if by and not is_raster:
        raise UnreadableFile(
            f"{what}: they went through {by}, which loses the places of its points; export it again with double "
            "precision and all decimals, or with an origin near by."
        )
    if shared > _MANY_SHARED:
        if (steps * metres)[np.isfinite(steps)].max() > _COARSEST_MEANT_M:
            raise UnreadableFile(
                f"{what}, and {100.0 * shared:.0f} % of its points share their place with another height: their places "
                "were rounded; export it again with all decimals."
            )
        return (*notes, f"{what}, coarser than the spacing of its points: differences of that size are rounding")
    return notes


def _step(values: np.ndarray, metres: float) -> float:
    """The largest power of two or ten, over 5 mm, by multiples of which values differ; 0 if none, inf if they agree."""
    some = values[:: max(len(values) // _SAMPLE, 1)]
    if values.min() == values.max():
        return np.inf
    if np.ptp(values) * metres < _SMALLEST_EXTENT_M:
        return 0.0
    steps = (step for step in _STEPS if _COARSEST_STEP_M <= step * metres <= _LARGEST_STEP_M)
    likely = (step for step in steps if _is_multiple(some, values[0], step, metres))
    return next((step for step in likely if _is_multiple(values, values[0], step, metres)), 0.0)


def _is_multiple(values: np.ndarray, origin: float, step: float, metres: float) -> bool:
    along = values - origin
    return bool((np.abs(along - np.round(along / step) * step) <= min(_STORED_M / metres, 0.05 * step)).all())


def _rounding_cause(plan: np.ndarray, steps: np.ndarray, metres: np.ndarray) -> str | None:
    """Cause of steps (2,) like these on coordinates (N, 2) of this size, in words; None if none is known."""
    # Equal steps along both axes may be meant.
    if steps[0] == steps[1]:
        return None
    largest = np.abs(plan).max(axis=0)

    def fits(expected: np.ndarray) -> bool:
        is_fine = expected * metres <= _COARSEST_STEP_M
        return bool((np.isinf(steps) | (steps == np.where(is_fine, 0.0, expected))).all())

    if fits(np.spacing(largest.astype(np.float32)).astype(np.float64)):
        return "single precision"
    for digits in _DIGITS:
        num_digits = np.floor(np.log10(np.maximum(largest, 1e-300))) + 1.0
        if fits(np.array([float(f"1e{int(n)}") for n in num_digits - digits])):
            return f"numbers of {digits} digits"
    return None


def _shared_places(points: np.ndarray) -> tuple[float, bool]:
    """Share of points with another height at the same easting and northing, and whether points form a raster."""
    if len(points) > _ENOUGH:
        half = 0.5 * np.ptp(points[:, :2], axis=0) * (_ENOUGH / len(points)) ** 0.5
        middle = np.median(points[:, :2], axis=0)
        points = points[(np.abs(points[:, :2] - middle) <= half).all(axis=1)]
    points = points[np.lexsort(points.T[::-1])]
    is_new = np.diff(points, axis=0, prepend=np.nan) != 0.0
    # Distinct heights at each place.
    count = np.add.reduceat(is_new.any(axis=1), np.flatnonzero(is_new[:, :2].any(axis=1)), dtype=np.int64)
    # A few corners above each other, of a box.
    if len(count) < _FEWEST and count.sum() < _FEWEST * len(count):
        return 0.0, False
    rows = np.prod([len(np.unique(values)) for values in points[:, :2].T], dtype=np.float64)
    return float(count[count > 1].sum() / count.sum()), bool(count.max() == 1 and len(count) > _RASTER * rows)


def _rounded_heights(height: np.ndarray, metres: float, path: Path) -> tuple[str, ...]:
    """A note where all heights are multiples of centimetres or more, and there are more points than heights."""
    step = _step(height, metres)
    if not np.isfinite(step) or step * metres <= 0.02 or len(np.unique(height)) * 5 > len(height):
        return ()
    # A box has few heights, and few vertices.
    if len(np.unique(height)) < _FEWEST and len(height) < _SAMPLE:
        return ()
    return (f"the heights of {path} are multiples of {step:g}: smaller differences are not known from it",)


def _no_data_notes(height: np.ndarray, path: Path) -> tuple[str, ...]:
    """A note where the lowest or highest of heights (N,) may be a no-data value; UnreadableFile where it must be."""
    for value in {float(height.min()), float(height.max())}:
        has_value = height == value
        other_heights = height[~has_value]
        known, num = value in _NO_DATA_VALUES or abs(value) >= _BEYOND_EARTH, int(has_value.sum())
        # No-data values may have been scaled and shifted with the heights.
        if not len(other_heights) or not (known or value == 0.0 or num >= _FEWEST):
            continue
        low, high = np.quantile(other_heights, [0.01, 0.99])
        gap = max(low - value, value - high)
        message = (
            f"{num} of the {len(height)} heights of {path} are exactly {value:.10g}, most of the others from "
            f"{low:.6g} to {high:.6g}"
        )
        far = _FAR if known or value == 0.0 else _FAR_UNKNOWN
        if gap > max(_SPREADS * (high - low), far) and (known or num > 2):
            raise UnreadableFile(
                f"{message}: a no-data value that the file does not declare; declare it (of a raster: gdal_translate "
                f"-a_nodata {value:.10g} {path.name} new.tif), or remove those points."
            )
        if (
            (known or value == 0.0)
            and num > max(_SHARE * len(height), 20)
            and len(np.unique(other_heights)) > 0.5 * len(other_heights)
        ):
            return (f"{message}: if that is a no-data value, declare it (gdal_translate -a_nodata {value:.10g})",)
    return ()


def _read_raster(path: Path) -> Mesh:
    # rasterio and what it loads take half a second.
    from geo.raster import read_raster

    return read_raster(path)


_READERS = {
    ".ply": read_ply,
    ".obj": read_obj,
    ".las": read_cloud,
    ".laz": read_cloud,  # COPC too: .copc.laz
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".tif": _read_raster,
    ".tiff": _read_raster,
    ".bag": _read_raster,
    ".e57": read_e57,
}


def read_reference(path: str | Path) -> Mesh | Cloud:
    """Read a mesh or cloud in crs coordinates, float64, by the suffix of its name.

    PLY, OBJ and glTF give a `Mesh` where they have faces, else a `Cloud`; a GeoTIFF gives a `Mesh`, LAS, LAZ and E57 a
    `Cloud`. Raises UnreadableFile if the file has no points, does not exist, has another suffix, needs a
    library that is not installed, is damaged, or its values were rounded or have undeclared no-data values.
    """
    path = existing_file(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        suffixes = ", ".join(_READERS)
        raise UnreadableFile(f'{path} has the suffix "{path.suffix}"; export it as one of {suffixes}.')
    shape = reader(path)
    points = vertices_of(shape)
    if not len(points):
        raise UnreadableFile(f"{path} has no points; expected a mesh or a cloud with at least one.")
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    if bad:
        raise UnreadableFile(
            f"{path} has {bad} of {len(points)} vertices whose coordinates are not finite; remove them and "
            "export it again."
        )
    if isinstance(shape, Mesh):
        _require_faces(shape, path)
    return replace(shape, notes=(*shape.notes, *check_values(points, shape.crs, path)))


def _require_faces(mesh: Mesh, path: Path) -> None:
    if not len(mesh.faces):
        raise UnreadableFile(f"{path} has faces of fewer than three corners only; export it with triangles.")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        face = int(np.flatnonzero(((mesh.faces < 0) | (mesh.faces >= len(mesh.vertices))).any(axis=1))[0])
        raise UnreadableFile(
            f"{path} has a face (triangle {face}) that names a vertex beyond its {len(mesh.vertices)}; it is "
            "damaged: export it again."
        )
