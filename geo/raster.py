"""Terrain models as GeoTIFF: the surface through the middles of their cells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from geo.errors import UnreadableFile
from geo.files import existing_file
from geo.shapes import Mesh
from geo.stated import height_unit_said, unit_named


def read_raster(path: str | Path) -> Mesh:
    """Read the first band of a GeoTIFF as heights, two triangles between each four neighbouring cells.

    Cells without data, and triangles that would touch one, are holes. Heights are those of the file, a declared scale
    and offset applied; where the CRS has no vertical part, the unit of the band is their unit. Triangles face up,
    whichever row is the first.

    Raises
    ------
    UnreadableFile
        If it does not exist, is damaged, has fewer than 2 x 2 cells with data, a band in another unit than the
        heights of its CRS, of depths or of red.
    """
    path = existing_file(path)
    # It takes a while to load, and most references are meshes or clouds.
    import rasterio
    from rasterio.enums import ColorInterp

    try:
        with rasterio.open(path) as raster:
            stored = raster.read(1, masked=True)
            heights = stored.astype(np.float64).filled(np.nan) * raster.scales[0] + raster.offsets[0]
            t, wkt = raster.transform, raster.crs.to_wkt() if raster.crs else None
            unit_name = raster.units[0]
            band, is_picture = raster.descriptions[0] or "", raster.colorinterp[0] == ColorInterp.red
    except rasterio.errors.RasterioError as error:
        said = str(error).splitlines()[0][:100]
        raise UnreadableFile(f"{path} cannot be read as a GeoTIFF ({said}); export it again.") from error
    if is_picture:
        raise UnreadableFile(f"{path} is a picture, whose first band is red; expected heights in its first band.")
    if "depth" in band.casefold():
        raise UnreadableFile(
            f"the first band of {path} is called {band[:40]!r}; expected heights: subtract the depths from the level "
            "that they count from."
        )
    try:
        crs = CRS(wkt) if wkt else None
    except CRSError:
        crs = None
    rows, columns = np.mgrid[0 : heights.shape[0], 0 : heights.shape[1]] + 0.5
    east, north = t.a * columns + t.b * rows + t.c, t.d * columns + t.e * rows + t.f
    unit = unit_named(unit_name)
    notes: tuple[str, ...] = ()
    if unit is None and unit_name:
        notes = (f"{path} gives its heights in {unit_name[:40]!r}, which is no unit of length that is known.",)
    height_unit = height_unit_said(crs, unit, path, f"the unit of its band, {unit_name},")
    faces = _triangles(np.isfinite(heights))
    # From south to north, or mirrored, the triangles would face down.
    if t.a * t.e - t.b * t.d > 0.0:
        faces = faces[:, ::-1]
    if not len(faces):
        raise UnreadableFile(f"{path} has no four neighbouring cells with data; expected heights in its first band.")
    # Only vertices that a triangle uses: the others may have no height.
    used, corners = np.unique(faces, return_inverse=True)
    vertices = np.stack([east.ravel(), north.ravel(), heights.ravel()], axis=1)[used]
    return Mesh(vertices, corners.reshape(faces.shape), crs=crs, height_unit_m=height_unit, notes=notes)


def _triangles(known: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) between cells (rows, columns) that are known, facing up if rows run south, columns east."""
    number = np.arange(known.size).reshape(known.shape)
    nw, ne, sw, se = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    both = []
    for a, b, c in ((nw, sw, ne), (ne, sw, se)):
        corners = np.stack([a.ravel(), b.ravel(), c.ravel()], axis=1)
        both.append(corners[known.ravel()[corners].all(axis=1)])
    return np.concatenate(both)
