"""Clouds as E57 (the extra ``e57``): all scans of a file in their common frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geo.errors import EmptyCloud, UnreadableFile
from geo.files import existing_file
from geo.optional import library_for
from geo.shapes import Cloud


def read_e57(path: str | Path) -> Cloud:
    """Read the points of all scans of an E57 file, each moved by its pose; files rarely name a CRS.

    Raises
    ------
    EmptyCloud
        If it has no points.
    UnreadableFile
        If it does not exist, is damaged, or pye57 is not installed.
    """
    path = existing_file(path)
    pye57 = library_for(path, "pye57", "e57")
    # libE57Format raises its own errors and RuntimeError for damaged files.
    try:
        with pye57.E57(str(path)) as file:
            scans = [file.read_scan(i, ignore_missing_fields=True) for i in range(file.scan_count)]
    except Exception as error:
        said = (str(error).splitlines() or [type(error).__name__])[0][:100]
        raise UnreadableFile(f"{path} cannot be read as E57 ({said}); copy or export it again.") from error
    points = [np.stack([scan[f"cartesian{axis}"] for axis in "XYZ"], axis=1) for scan in scans]
    cloud = np.concatenate([np.empty((0, 3)), *points])
    if not len(cloud):
        raise EmptyCloud(f"{path} has no points; expected a cloud with at least one.")
    return Cloud(cloud)
