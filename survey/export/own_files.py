"""Whether a file that is there was written by bathynerf, by the mark that its format has a place for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from geo.e57 import is_our_e57
from geo.raster import is_our_tiff
from geo.vectors import is_our_dxf, is_our_shapefile
from survey.report.page import is_our_pdf

# Bytes at the beginning of a file that are searched for the mark of its writer.
_HEAD_BYTES = 1 << 16
# Where the header of LAS says which system made it.
_LAS_SYSTEM = slice(26, 58)


def _begins_with(start: bytes, *marks: bytes) -> Callable[[Path], bool]:
    """A test whether a file begins so, and has these marks soon after."""

    def is_ours(path: Path) -> bool:
        with path.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
        return head.startswith(start) and all(mark in head for mark in marks)

    return is_ours


def _is_our_las(path: Path) -> bool:
    with path.open("rb") as stream:
        head = stream.read(_LAS_SYSTEM.stop)
    return head.startswith(b"LASF") and head[_LAS_SYSTEM].startswith(b"bathynerf")


# What the files of each suffix are, and the test. XYZ has no place for a mark: one that a run wrote is known by its
# record alone, see `survey.export.export`.
_OWN: dict[str, tuple[str, Callable[[Path], bool]]] = {
    ".las": ("a cloud", _is_our_las),
    ".laz": ("a cloud", _is_our_las),
    ".ply": ("a cloud or mesh", _begins_with(b"ply\n", b"\ncomment bathynerf\n")),
    ".e57": ("a cloud", is_our_e57),
    ".obj": ("a mesh", _begins_with(b"# bathynerf\n")),
    ".glb": ("a mesh", _begins_with(b"glTF", b'"made_by":"bathynerf"')),
    ".tif": ("a raster", is_our_tiff),
    ".tiff": ("a raster", is_our_tiff),
    ".bag": ("a BAG", _begins_with(b"\x89HDF\r\n\x1a\n", b"made by bathynerf")),
    ".xyz": ("soundings", lambda _path: False),
    ".csv": ("soundings", _begins_with(b"easting,northing,height,depth_m,std_m,std_common_m,points,crs\n")),
    ".geojson": ("a layer", _begins_with(b"{", b'"made_by": "bathynerf"')),
    ".gpkg": ("a layer", _begins_with(b"SQLite format 3\0", b"bathynerf ")),
    ".zip": ("a layer", is_our_shapefile),
    ".dxf": ("a layer", is_our_dxf),
    ".json": ("cameras", _begins_with(b"{", b'"made_by": "bathynerf"')),
    ".pdf": ("a report", is_our_pdf),
}
# The file of a folder that has the mark.
_FOLDERS = {"cameras.txt": b"# bathynerf\n", "bed.qgs": b"<!-- made by bathynerf -->"}


def is_own(path: Path) -> bool:
    """Whether a file of a product's suffix, or a folder of a product, has the mark of bathynerf.

    A folder of rasters alone has it where all of them have.
    """
    if path.is_dir():
        rasters = list(path.rglob("*.tif"))
        return (bool(rasters) and all(is_our_tiff(each) for each in rasters)) or any(
            (path / name).is_file() and _begins_with(b"", mark)(path / name) for name, mark in _FOLDERS.items()
        )
    return _OWN[path.suffix.lower()][1](path)


def kind_of(path: Path) -> str:
    """What an own file of this suffix is, e.g. "a raster that bathynerf wrote"."""
    return f"{_OWN[path.suffix.lower()][0]} that bathynerf wrote"
