"""Clouds as E57 (the extra ``e57``): all scans of a file read in their common frame; one scan written."""

from __future__ import annotations

import time
import uuid
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from pyproj import CRS

from geo.crs import crs_named, horizontal_crs, wkt1
from geo.errors import UnreadableFile, UnwritableFile, first_line
from geo.files import existing_file, library_for, write_whole_at
from geo.shapes import Cloud

# E57 counts GPS time, which began on 6 January 1980, and has been 18 s ahead of UTC since 2017.
_GPS_EPOCH_S, _LEAP_S = 315_964_800.0, 18.0


def read_e57(path: str | Path) -> Cloud:
    """Read the points of all scans of an E57 file, each moved by its pose, with the CRS of its header."""
    path = existing_file(path)
    pye57 = library_for(path, "pye57", "e57")
    # libE57Format raises its own errors and RuntimeError for damaged files.
    try:
        with pye57.E57(str(path)) as file:
            scans = [file.read_scan(i, ignore_missing_fields=True) for i in range(file.scan_count)]
            named = "coordinateMetadata"
            stated = file.root[named].value().strip() if file.root.isDefined(named) else ""
    except Exception as error:
        raise UnreadableFile(f"{path} cannot be read as E57 ({first_line(error)}); copy or export it again.") from error
    points = [np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1) for scan in scans]
    cloud = np.concatenate([np.empty((0, 3)), *points])
    if not len(cloud):
        raise UnreadableFile(f"{path} has no points; expected a cloud with at least one.")
    crs, notes = crs_named(stated, path) if stated else (None, ())
    return Cloud(cloud, crs=crs, notes=notes)


def require_metres(path: str | Path, crs: CRS) -> None:
    """Raise UnwritableFile where a CRS is not in metres, which E57 is."""
    if not horizontal_crs(crs).is_projected or any(a.unit_name != "metre" for a in crs.axis_info):
        raise UnwritableFile(
            f"cannot write {path}: E57 is in metres, but the CRS is {crs.name} "
            f"({' and '.join(dict.fromkeys(axis.unit_name for axis in crs.axis_info))}); give --crs with "
            "a CRS in metres, e.g. the UTM zone with a vertical part in metres, or write LAS or PLY."
        )


def write_e57(path: str | Path, points_crs: np.ndarray, crs: CRS, *, rgb: np.ndarray) -> None:
    """Write a cloud (N, 3), N at least 1, in crs, with colours (N, 3) uint8 as one scan of an E57 file.

    pye57 writes coordinates in single precision: they are stored relative to the middle of the cloud, which becomes the
    pose of the scan, and have steps of 0.06 mm within 1 km. The CRS is the coordinateMetadata of the file, as WKT 1.
    """
    require_metres(path, crs)
    pye57 = library_for(path, "pye57", "e57", to_write=True)
    points = np.asarray(points_crs, dtype=np.float64)
    origin = np.floor(0.5 * (points.min(axis=0) + points.max(axis=0)))
    columns = (points - origin).astype(np.float32).T
    data = {f"cartesian{axis}": column for axis, column in zip("XYZ", columns, strict=True)}
    data |= {f"color{name}": column for name, column in zip(("Red", "Green", "Blue"), rgb.T, strict=True)}
    with write_whole_at(path) as part:
        try:
            file = _with_crs(pye57, wkt1(crs))(str(part), mode="w")
            file.write_scan_raw(data, name="bathynerf", translation=origin, scan_header=_header(columns, origin))
            file.close()
            with pye57.E57(str(part)) as written:
                written.get_header(0)
        except pye57.libe57.E57Exception as error:
            raise UnwritableFile(f"cannot write {path} ({error}); most likely no space is left on the disk.") from error


def _gps_seconds() -> float:
    return time.time() - _GPS_EPOCH_S + _LEAP_S


def _header(columns: np.ndarray, origin: np.ndarray) -> SimpleNamespace:
    """What pye57 takes for a scan of columns (3, N): bounds before the pose, as E57 wants them, and dates."""
    low, high = columns.min(axis=1).astype(float), columns.max(axis=1).astype(float)
    bounds = {f"{axis}Minimum": value for axis, value in zip("xyz", low, strict=True)}
    bounds |= {f"{axis}Maximum": value for axis, value in zip("xyz", high, strict=True)}
    dates = dict.fromkeys(("acquisitionStart_dateTimeValue", "acquisitionEnd_dateTimeValue"), _gps_seconds())
    return SimpleNamespace(translation=origin, rotation=np.array([1.0, 0.0, 0.0, 0.0]), **bounds, **dates)


def _with_crs(pye57: Any, wkt: str) -> type:
    """The writer of pye57, which leaves the CRS in the header empty, extended to fill it in."""
    lib = pye57.libe57

    class WithCrs(pye57.E57):
        def write_default_header(self) -> None:
            image = self.image_file
            image.extensionsAdd("", lib.E57_V1_0_URI)
            made = lib.StructureNode(image)
            made.set("dateTimeValue", lib.FloatNode(image, _gps_seconds()))
            made.set("isAtomicClockReferenced", lib.IntegerNode(image, 0))
            for name, node in {
                "formatName": lib.StringNode(image, "ASTM E57 3D Imaging Data File"),
                "guid": lib.StringNode(image, f"{{{uuid.uuid4()}}}"),
                "versionMajor": lib.IntegerNode(image, lib.E57_FORMAT_MAJOR),
                "versionMinor": lib.IntegerNode(image, lib.E57_FORMAT_MINOR),
                "e57LibraryVersion": lib.StringNode(image, lib.E57_LIBRARY_ID),
                "coordinateMetadata": lib.StringNode(image, wkt),
                "creationDateTime": made,
                "data3D": lib.VectorNode(image, True),
                "images2D": lib.VectorNode(image, True),
            }.items():
                self.root.set(name, node)

    return WithCrs
