"""Verification of written files: read again by their library and compared.

A disk that fills, or a library that drops what a format cannot hold, may leave a file that looks written.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import laspy
import numpy as np
import rasterio
from pyproj import CRS
from pyproj.exceptions import CRSError

from geo.compatibility import crs_difference
from geo.crs import has_height
from geo.errors import UnwritableFile

_PORTION = 100_000
# Tolerance of the transform, in cells: some formats store it in decimals.
_SAME_CELL = 1e-6


@dataclass
class ValueSums:
    """A checksum of values that does not depend on their order: count and sum of bit patterns, modulo 2^64."""

    nodata: float | None = None  # Not counted, nor is NaN
    count: int = 0
    total: np.uint64 = field(default_factory=lambda: np.uint64(0))

    def add(self, values: np.ndarray) -> None:
        """Add values, all of one type, to the checksum."""
        values = np.ascontiguousarray(values)
        known = values.ravel()
        if values.dtype.kind == "f":
            known = known[~np.isnan(known)]
        if self.nodata is not None and not np.isnan(self.nodata):
            known = known[known != self.nodata]
        bits = known.view(f"u{known.dtype.itemsize}").astype(np.uint64)
        self.count += len(known)
        self.total = np.uint64((int(self.total) + int(bits.sum(dtype=np.uint64))) % 2**64)


def read_back_error(path: Path, what: str) -> UnwritableFile:
    """The error for a file that, read again, differs from what was written."""
    return UnwritableFile(
        f"cannot write {path}: read again, {what}; most likely no space is left on the disk: free some or write "
        "elsewhere."
    )


def require_raster(
    part: Path, path: Path, crs: CRS, transform, shape: tuple[int, int], sums: Iterable[ValueSums]
) -> None:
    """Raise UnwritableFile unless a raster in ``part``, to be ``path``, reads as it was written.

    Parameters
    ----------
    transform : six floats
    shape : (rows, columns)
    sums : of each band, of all values that were written

    Raises
    ------
    UnwritableFile
        Naming what differs.
    """
    try:
        # Without files beside the raster, which stay behind.
        with rasterio.Env(GDAL_PAM_ENABLED="NO"), rasterio.open(part) as raster:
            if raster.shape != tuple(shape):
                raise read_back_error(path, f"it has {raster.shape} cells in place of {tuple(shape)}")
            cell = max(abs(transform[0]), abs(transform[4]))
            if np.abs(np.array(tuple(raster.transform)[:6]) - transform).max() > _SAME_CELL * cell:
                raise read_back_error(path, "it lies elsewhere")
            _require_crs(raster.crs, crs, path)
            for number, expected in enumerate(sums, start=1):
                found = ValueSums(expected.nodata)
                for _, window in raster.block_windows(number):
                    found.add(raster.read(number, window=window))
                if (found.count, found.total) != (expected.count, expected.total):
                    raise read_back_error(
                        path, f"its band {number} has {found.count} other values than the {expected.count}"
                    )
    except rasterio.errors.RasterioError as error:
        reason = (str(error).splitlines() or ["no raster"])[0]
        raise read_back_error(path, f"it is damaged ({reason[:80]})") from error


def _require_crs(found: rasterio.crs.CRS | None, crs: CRS, path: Path) -> None:
    try:
        read = None if found is None else CRS.from_wkt(found.to_wkt())
    except CRSError:
        read = None
    if read is None:
        raise UnwritableFile(
            f"cannot write {path}: the CRS {crs.name} cannot be read back from this format; export in one of common "
            "EPSG codes (--crs), e.g. the UTM zone with a height datum."
        )
    difference = crs_difference(read, crs)
    if difference is not None or (has_height(crs) and not has_height(read)):
        reason = difference or "its heights have no datum"
        raise UnwritableFile(
            f"cannot write {path}: the CRS {crs.name} reads as another one ({reason}); choose another --crs."
        )


def require_cloud(stream: BinaryIO, path: Path, count: int, sums: ValueSums) -> None:
    """Raise UnwritableFile unless LAS or LAZ in a stream has so many points, with these stored coordinates.

    Raises
    ------
    UnwritableFile
        Naming what differs.
    """
    found = ValueSums()
    try:
        stream.seek(0)
        with laspy.open(stream, closefd=False) as reader:
            if reader.header.point_count != count:
                raise read_back_error(path, f"it has {reader.header.point_count} points in place of {count}")
            for points in reader.chunk_iterator(_PORTION) if count else ():
                for values in (points.X, points.Y, points.Z):
                    found.add(np.asarray(values, dtype=np.int32))
    except UnwritableFile:
        raise
    except BaseException as error:
        # laspy and its decoder raise errors of many kinds; a panic of the decoder is no Exception.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise read_back_error(path, f"it is damaged ({str(error)[:80]})") from error
    if (found.count, found.total) != (sums.count, sums.total):
        raise read_back_error(path, "its points differ from those that were written")
