"""Clouds as E57 (the extra ``e57``): all scans of a file in their common frame."""

from pathlib import Path

import numpy as np

from geo.crs import crs_named
from geo.errors import UnreadableFile, first_line
from geo.files import existing_file, library_for
from geo.shapes import Cloud


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
