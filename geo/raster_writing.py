"""Rasters written as cloud-optimised GeoTIFF and as BAG, window by window, whole or not at all."""

from __future__ import annotations

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
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.windows import Window

from geo.errors import UnwritableFile
from geo.files import refusal, written_whole

# In the tag "Software" of every raster, by which bathynerf knows its own again.
SOFTWARE = f"bathynerf {version('bathynerf')}"
_BLOCK = 512


@dataclass(frozen=True)
class Band:
    """One band of a raster.

    Attributes
    ----------
    name : str
        What it holds, e.g. "height".
    unit : str
        E.g. "metre"; empty for none.
    """

    name: str
    unit: str = ""


@dataclass(frozen=True)
class RasterForm:
    """What is said of a raster beside its values.

    Attributes
    ----------
    crs : pyproj.CRS
    transform : six floats
        Coefficients a to f of ``east = a column + b row + c, north = d column + e row + f``, from outer corners.
    shape : (rows, columns)
    bands : tuple of Band
    dtype : str
        Of all bands, e.g. "float32".
    nodata : float or None
    tags : dict of str to str
        Metadata, e.g. how the values were computed.
    resampling : str
        How overviews are made: "AVERAGE", or "NEAREST" for codes.
    is_colour : bool
        Whether the bands are red, green, blue and transparency.
    """

    crs: CRS
    transform: tuple[float, float, float, float, float, float]
    shape: tuple[int, int]
    bands: tuple[Band, ...]
    dtype: str = "float32"
    nodata: float | None = None
    tags: dict[str, str] = field(default_factory=dict)
    resampling: str = "AVERAGE"
    is_colour: bool = False


# Rows and columns from the top left corner, and the values (bands, rows, columns) there.
Part = tuple[int, int, np.ndarray]


def write_cog(path: str | Path, form: RasterForm, parts: Iterable[Part]) -> None:
    """Write a raster as cloud-optimised GeoTIFF: tiles of 512 cells, overviews, compressed without loss.

    Parameters
    ----------
    path : .tif
    form : RasterForm
    parts : iterable of (row, column, values)
        Windows that cover the raster, in any order; blocks that none covers are left without data.

    Raises
    ------
    UnwritableFile
        If the system or GDAL refuses.
    """
    options = {
        "driver": "COG",
        "blocksize": _BLOCK,
        "compress": "DEFLATE",
        "predictor": "YES",
        "overview_resampling": form.resampling,
        "bigtiff": "IF_SAFER",
    }
    _write(Path(path), form, parts, options)


def write_bag(path: str | Path, form: RasterForm, parts: Iterable[Part], said: dict[str, str]) -> None:
    """Write heights and their uncertainty as a Bathymetric Attributed Grid (HDF5).

    Parameters
    ----------
    path : .bag
    form : RasterForm
        Of two bands, height and uncertainty [m].
    parts : iterable of (row, column, values)
    said : dict
        Variables of GDAL's metadata template, without the VAR\\_ before them, e.g. "ABSTRACT".

    Raises
    ------
    UnwritableFile
        If the system or GDAL refuses.
    """
    options = {"driver": "BAG", **{f"VAR_{name}": value for name, value in said.items()}}
    _write(Path(path), form, parts, options)


def _write(path: Path, form: RasterForm, parts: Iterable[Part], options: dict) -> None:
    """Write a plain GeoTIFF beside the target, and have GDAL copy it into its form."""
    with written_whole(path) as part, TemporaryDirectory(prefix=".", suffix=".part", dir=part.parent) as work:
        # GDAL chooses some formats by the suffix.
        plain, copy = Path(work) / "plain.tif", Path(work) / f"copy{path.suffix}"
        with _refusals(path):
            _write_plain(plain, form, parts)
            rasterio.shutil.copy(plain, copy, **options)
        copy.replace(part)


def _write_plain(path: Path, form: RasterForm, parts: Iterable[Part]) -> None:
    rows, columns = form.shape
    profile = {
        "driver": "GTiff",
        "width": columns,
        "height": rows,
        "count": len(form.bands),
        "dtype": form.dtype,
        "crs": rasterio.crs.CRS.from_wkt(form.crs.to_wkt()),
        "transform": rasterio.Affine(*form.transform),
        "nodata": form.nodata,
        "tiled": True,
        "blockxsize": _BLOCK,
        "blockysize": _BLOCK,
        "sparse_ok": True,
        "bigtiff": "IF_SAFER",
        "interleave": "pixel" if form.is_colour else "band",
    }
    if form.is_colour:
        profile |= {"photometric": "RGB", "alpha": "unspecified" if len(form.bands) == 4 else "no"}
    with rasterio.open(path, "w", **profile) as raster:
        raster.update_tags(TIFFTAG_SOFTWARE=SOFTWARE, AREA_OR_POINT="Area", **form.tags)
        for number, band in enumerate(form.bands, start=1):
            raster.set_band_description(number, band.name)
            if band.unit:
                raster.set_band_unit(number, band.unit)
        for row, column, values in parts:
            raster.write(values, window=Window(column, row, values.shape[2], values.shape[1]))


@contextmanager
def _refusals(path: Path) -> Iterator[None]:
    """Turn errors of GDAL into UnwritableFile."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            yield
    except RasterioError as error:
        said = (str(error).splitlines() or [type(error).__name__])[0][:120]
        # GDAL hides the system's error.
        text = refusal(OSError(said), path) or f"cannot write {path} ({said})"
        raise UnwritableFile(f"{text}.") from error


def is_our_tiff(path: Path) -> bool:
    """Whether a file is a TIFF whose tag "Software" names bathynerf."""
    with path.open("rb") as stream:
        head = stream.read(1 << 16)
    return head[:2] in (b"II", b"MM") and b"\0bathynerf " in head.replace(b"\n", b"\0")
