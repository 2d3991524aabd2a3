"""Rasters: read, and written window by window as cloud-optimised GeoTIFF or BAG, whole or not at all."""

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import rasterio
import rasterio.shutil
from pyproj import CRS
from pyproj.exceptions import CRSError
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.io import MemoryFile
from rasterio.windows import Window

import geo.crs
from geo.compatibility import crs_difference
from geo.errors import UnreadableFile, UnwritableFile, first_line
from geo.files import disk_error_text, existing_file, write_whole_at
from geo.shapes import Mesh

# Tag "Software" of every raster, by which bathynerf recognises its own files.
SOFTWARE = f"bathynerf {version('bathynerf')}"
_BLOCK = 512


# GDAL goes by content, and some of its formats (VRT, services of maps) name other files and addresses, which it reads.
_DRIVERS = {".tif": "GTiff", ".tiff": "GTiff", ".bag": "BAG"}


@dataclass(frozen=True)
class RasterBand:
    name: str  # What it holds, e.g. "height".
    unit: str = ""  # E.g. "metre"; empty for none.


@dataclass(frozen=True)
class RasterForm:
    crs: CRS
    # Coefficients a to f of ``east = a column + b row + c, north = d column + e row + f``, from outer corners
    transform: tuple[float, float, float, float, float, float]
    shape: tuple[int, int]  # (rows, columns)
    bands: tuple[RasterBand, ...]
    dtype: str = "float32"  # Of all bands
    nodata: float | None = None
    tags: dict[str, str] = field(default_factory=dict)  # Metadata, e.g. how the values were computed
    resampling: str = "AVERAGE"  # How overviews are made: "AVERAGE", or "NEAREST" for codes
    is_colour: bool = False  # Whether the bands are red, green, blue and transparency


# Rows and columns from the top left corner, and the values (bands, rows, columns) there.
Part = tuple[int, int, np.ndarray]


def write_cog(path: str | Path, form: RasterForm, parts: Iterable[Part]) -> None:
    """Write a raster as cloud-optimised GeoTIFF: tiles of 512 cells, overviews, compressed without loss.

    Parts are windows that cover the raster, in any order; blocks that none covers are left without data.
    """
    with write_whole_at(path) as part, _working_folder(part, Path(path)) as work:
        # GDAL copies a plain GeoTIFF into this form.
        plain, copy = work / "plain.tif", work / "copy.tif"
        profile = {"tiled": True, "blockxsize": _BLOCK, "blockysize": _BLOCK, "sparse_ok": True, "bigtiff": "IF_SAFER"}
        if form.is_colour:
            profile |= {"photometric": "RGB", "interleave": "pixel"}
        else:
            profile |= {"photometric": "MINISBLACK", "interleave": "band"}
        _write(plain, form, parts, driver="GTiff", **profile)
        rasterio.shutil.copy(
            plain, copy, driver="COG", blocksize=_BLOCK, compress="DEFLATE", predictor="YES",
            overview_resampling=form.resampling, bigtiff="IF_SAFER",
        )  # fmt: skip
        _require_readable(copy, Path(path), form)
        copy.replace(part)


def write_bag(path: str | Path, form: RasterForm, parts: Iterable[Part], variables: dict[str, str]) -> None:
    """Write heights and their uncertainty, two bands [m], as a Bathymetric Attributed Grid (HDF5).

    ``variables`` are those of GDAL's metadata template, without the VAR\\_ before them, e.g. "ABSTRACT".
    """
    with write_whole_at(path) as part, _working_folder(part, Path(path)) as work:
        # GDAL knows the format by the suffix.
        copy = work / "copy.bag"
        if geo.crs.vertical_crs(form.crs) is None and geo.crs.has_height(form.crs):
            variables = variables | {"VERT_WKT": geo.crs.ellipsoidal_wkt1(form.crs)}
        template = {f"VAR_{name}": value for name, value in variables.items()}
        # In memory first: on a full disk HDF5 prints a page of its own messages, and fails again when closed.
        with MemoryFile(ext=".bag") as memory:
            _write(memory.name, form, parts, driver="BAG", **template)
            copy.write_bytes(memory.read())
        _require_readable(copy, Path(path), form)
        copy.replace(part)


def _write(path: Path | str, form: RasterForm, parts: Iterable[Part], **profile) -> None:
    rows, columns = form.shape
    crs = rasterio.crs.CRS.from_wkt(stored_crs(form.crs).to_wkt())
    raster = rasterio.open(
        path, "w", width=columns, height=rows, count=len(form.bands), dtype=form.dtype, crs=crs,
        transform=rasterio.Affine(*form.transform), nodata=form.nodata, **profile,
    )  # fmt: skip
    with raster:
        if profile["driver"] == "GTiff":
            heights = {}
            if geo.crs.has_height(form.crs) and not geo.crs.has_height(stored_crs(form.crs)):
                heights["HEIGHT_DATUM"] = (
                    f"ellipsoid {geo.crs.ellipsoid(form.crs).name}, {form.crs.axis_info[2].unit_name}"
                )
            raster.update_tags(TIFFTAG_SOFTWARE=SOFTWARE, AREA_OR_POINT="Area", **heights, **form.tags)
            if form.is_colour:
                raster.colorinterp = [getattr(ColorInterp, name) for name in ("red", "green", "blue", "alpha")]
            for number, band in enumerate(form.bands, start=1):
                raster.set_band_description(number, band.name)
                if band.unit:
                    raster.set_band_unit(number, band.unit)
        for row, column, values in parts:
            raster.write(values, window=Window(column, row, values.shape[2], values.shape[1]))


def _require_readable(copy: Path, path: Path, form: RasterForm) -> None:
    """Open a raster that will become ``path`` once more, and read its last cell and its CRS."""
    rows, columns = form.shape
    # Without files beside the raster, which stay behind.
    with rasterio.Env(GDAL_PAM_ENABLED="NO"), rasterio.open(copy) as raster:
        raster.read(window=Window(columns - 1, rows - 1, 1, 1))
        wkt = "" if raster.crs is None else raster.crs.to_wkt()
    crs = stored_crs(form.crs)
    try:
        read = CRS.from_wkt(wkt)
    except CRSError:
        read = None
    if read is None:
        raise UnwritableFile(
            f"cannot write {path}: the CRS {crs.name} cannot be read back from this format; export in one of common "
            "EPSG codes (--crs), e.g. the UTM zone with a height datum."
        )
    reason = crs_difference(read, crs) or (
        "its heights have no datum" if geo.crs.has_height(crs) > geo.crs.has_height(read) else None
    )
    if reason is not None:
        raise UnwritableFile(
            f"cannot write {path}: the CRS {crs.name} reads as another one ({reason}); choose another --crs."
        )


def stored_crs(crs: CRS) -> CRS:
    """The CRS that a raster can store: for a projected one with ellipsoidal heights, its horizontal part.

    No GeoTIFF keys that GDAL reads back say "above the ellipsoid" of a projected CRS; a tag says it instead.
    """
    return geo.crs.horizontal_crs(crs) if crs.is_projected and geo.crs.vertical_crs(crs) is None else crs


@contextmanager
def _working_folder(part: Path, path: Path) -> Iterator[Path]:
    """A folder beside a file that is being written; errors of GDAL in the block become UnwritableFile."""
    try:
        with TemporaryDirectory(prefix=".", suffix=".part", dir=part.parent) as work, warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            yield Path(work)
    except RasterioError as error:
        # GDAL hides the system's error.
        text = disk_error_text(OSError(first_line(error)), path) or f"cannot write {path} ({first_line(error)})"
        raise UnwritableFile(f"{text}.") from error


def open_raster(path: Path) -> rasterio.io.DatasetReader:
    """Open a GeoTIFF or BAG with rasterio, whose errors are raised."""
    return rasterio.open(path.absolute(), driver=_DRIVERS[path.suffix.lower()])


def is_our_tiff(path: Path) -> bool:
    """Whether a file is a TIFF that bathynerf wrote, by its tag "Software"."""
    with path.open("rb") as stream:
        head = stream.read(1 << 16)
    return head[:2] in (b"II", b"MM") and b"\0bathynerf " in head.replace(b"\n", b"\0")


def read_raster(path: str | Path) -> Mesh:
    """Read the first band of a GeoTIFF as heights, two triangles, facing up, between each four neighbouring cells.

    Cells without data are holes. A declared scale and offset is applied; where the CRS has no vertical part, the unit
    of the band is that of the heights.
    """
    path = existing_file(path)
    heights, t, crs, named = _read_band(path)
    rows, columns = np.mgrid[0 : heights.shape[0], 0 : heights.shape[1]] + 0.5
    east, north = t.a * columns + t.b * rows + t.c, t.d * columns + t.e * rows + t.f
    unit = geo.crs.unit_named(named)
    note = f"{path} gives its heights in {(named or '')[:40]!r}, which is not a known unit of length."
    height_unit = geo.crs.checked_height_unit(crs, unit, path, f"the unit of its band, {named},")
    faces = _triangles(np.isfinite(heights))
    # From south to north, or mirrored, the triangles would face down.
    if t.a * t.e - t.b * t.d > 0.0:
        faces = faces[:, ::-1]
    if not len(faces):
        raise UnreadableFile(f"{path} has no four neighbouring cells with data; expected heights in its first band.")
    # Only vertices that a triangle uses: the others may have no height.
    used, corners = np.unique(faces, return_inverse=True)
    vertices = np.stack([east.ravel(), north.ravel(), heights.ravel()], axis=1)[used]
    return Mesh(
        vertices,
        corners.reshape(faces.shape),
        crs=crs,
        height_unit_m=height_unit,
        notes=(note,) * bool(named and unit is None),
    )


def _read_band(path: Path) -> tuple[np.ndarray, rasterio.Affine, CRS | None, str | None]:
    """The first band of a file: heights (rows, columns), NaN without data, transform, CRS, and unit as it is named."""
    try:
        with warnings.catch_warnings():
            # Said below in words of this program.
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            raster = open_raster(path)
        with raster:
            stored = raster.read(1, masked=True)
            heights = stored.astype(np.float64).filled(np.nan) * raster.scales[0] + raster.offsets[0]
            transform, wkt = raster.transform, raster.crs.to_wkt() if raster.crs else None
            unit = raster.units[0]
            name, is_picture = raster.descriptions[0] or "", raster.colorinterp[0] == ColorInterp.red
    except RasterioError as error:
        raise UnreadableFile(f"{path} cannot be read as a GeoTIFF ({first_line(error)}); export it again.") from error
    if transform == rasterio.Affine.identity():
        raise UnreadableFile(
            f"{path} has no georeference, expected a GeoTIFF that states where its cells lie; give it the bounds "
            "(gdal_edit -a_ullr WEST NORTH EAST SOUTH), or put its world file (.tfw) beside it."
        )
    if is_picture:
        raise UnreadableFile(f"{path} is a picture, whose first band is red; expected heights in its first band.")
    if "depth" in name.casefold():
        raise UnreadableFile(
            f"the first band of {path} is called {name[:40]!r}; expected heights: subtract the depths from the level "
            "that they count from."
        )
    try:
        crs = CRS(wkt) if wkt else None
    except CRSError:
        crs = None
    return heights, transform, crs, unit


def _triangles(known: np.ndarray) -> np.ndarray:
    """Triangles (F, 3) between cells (rows, columns) that are known, facing up if rows run south, columns east."""
    number = np.arange(known.size).reshape(known.shape)
    nw, ne, sw, se = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    both = []
    for a, b, c in ((nw, sw, ne), (ne, sw, se)):
        corners = np.stack([a.ravel(), b.ravel(), c.ravel()], axis=1)
        both.append(corners[known.ravel()[corners].all(axis=1)])
    return np.concatenate(both)
