"""Which formats GDAL may take a file for, by the suffix of its name.

GDAL goes by content, and some of its formats (VRT, services of maps) name other files and addresses, which it reads.
"""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import rasterio

from geo.errors import UnreadableFile
from geo.files import library_for

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

_RASTERS = {".tif": "GTiff", ".tiff": "GTiff", ".bag": "BAG"}
# How files of vectors begin: pyogrio offers no choice of drivers. A DXF begins with a group of its first section, or
# with comments.
_BEGINNINGS = {
    ".gpkg": rb"SQLite format 3\x00",
    ".shp": rb"\x00\x00\x27\x0a",
    ".dxf": rb"AutoCAD Binary DXF\r\n\x1a\x00|(\xef\xbb\xbf)?(\s*999[^\S\n]*\n[^\n]*\n)*\s*0\s+SECTION\b",
}
# Drivers that go by a tag of XML find it anywhere at the beginning.
_TAG = re.compile(rb"<[A-Za-z?!]")
_LOOKED_AT_BYTES = 1 << 16


def open_raster(path: Path) -> DatasetReader:
    """Open a GeoTIFF or BAG with rasterio, whose errors are raised."""
    return rasterio.open(path.absolute(), driver=_RASTERS[path.suffix.lower()])


def vector_library(path: Path) -> ModuleType:
    """`pyogrio`, for a GeoPackage, shapefile or DXF that may be given to it."""
    library = library_for(path, "pyogrio", "vector")
    with path.open("rb") as stream:
        beginning = stream.read(_LOOKED_AT_BYTES)
    suffix = path.suffix.lower()
    is_foreign = suffix == ".dxf" and _TAG.search(beginning) is not None
    if is_foreign or re.match(_BEGINNINGS[suffix], beginning) is None:
        raise UnreadableFile(
            f"{path} does not begin as a file with the suffix {path.suffix} does; export it again in that format."
        )
    return library
