"""A survey folder without survey.toml: where its photographs lie; whether poses and tables tell its CRS."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import crs_code
from survey.errors import FILE_NAME, ConfigError
from survey.folder.plausible import SAME_PLACE_M, distances_to_exif
from survey.folder.pose_frames import points_in_crs
from survey.photos.exif import SUFFIXES, Exif
from survey.photos.images import photographs_below
from survey.photos.names import ImageNames
from survey.photos.poses import PoseFile


def image_folder_of(folder: Path) -> str:
    """Where photographs lie in a folder: in images/, in it itself, or in the one folder below it that has some."""
    if (folder / "images").is_dir():
        return "images"
    if any(path.suffix.lower() in SUFFIXES for path in folder.iterdir()):
        return "."
    places = photographs_below(folder)
    if len(places) == 1:
        return next(iter(places))
    found = f"photographs in {', '.join(places)}" if places else "no photographs"
    raise ConfigError(f"{folder} has {found} and no {FILE_NAME}; put those of the survey into {folder / 'images'}")


def table_crs(headers: Mapping[str, Exif]) -> str | None:
    """Code of the CRS of the table that gives positions of photographs; None without a table, or of degrees."""
    table = next((header.table_place.crs for header in headers.values() if header.table_place is not None), None)
    return None if table is None or not table.is_projected else crs_code(table)


NO_WATER = (
    "no water was given, rays were not bent; ground under water lies about a quarter of its depth too high; write "
    f"[water] level_m in {FILE_NAME}, or dry = true, above its first table, where no ground is under water"
)


def fits_positions(crs: CRS, file: PoseFile, poses_path: Path | None, headers: Mapping[str, Exif]) -> bool:
    """Whether poses as coordinates in crs lie at the GPS positions of their photographs."""
    centres = points_in_crs(file, np.array([pose.centre for pose in file.poses]), crs, "crs")
    names = ImageNames(headers)
    image_names = [names.find(pose.name, str(poses_path)) for pose in file.poses]
    known = {name: centre for name, centre in zip(image_names, centres, strict=True) if name is not None}
    distances = distances_to_exif(crs, known, headers)
    return bool(distances.size) and bool(np.median(distances) <= SAME_PLACE_M)
