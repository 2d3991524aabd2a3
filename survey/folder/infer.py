"""Settings of a survey without survey.toml, inferred from its images and a single poses file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import EGM96_HEIGHT, crs_code, has_height, horizontal_crs, utm_code
from survey.control.gcp_list import read_gcp_list
from survey.errors import FILE_NAME, ConfigError, ControlError, Findings
from survey.folder.plausible import SAME_PLACE_M, distances_to_exif
from survey.folder.pose_frames import middle_of_geocentric, points_in_crs
from survey.photos.exif import SUFFIXES, Exif, position_sources, utm_code_of
from survey.photos.images import photographs_elsewhere
from survey.photos.names import ImageNames
from survey.photos.poses import PoseFile, PoseFrame
from survey.pose_files import read_poses
from survey.settings.config import ImagesConfig, SurveyConfig, settings_of
from survey.words import GCP_LIST, GEO_TXT

_EXAMPLE = 'at least crs = "EPSG:25832+5778", [cameras] and, for water, [water] level_m = 12.34'


def settings_or_inferred(folder: Path) -> SurveyConfig:
    """Settings of a folder: those of its survey.toml, else as `config_of_folder`; raises ConfigError."""
    settings = settings_of(folder)
    return config_of_folder(folder) if settings is None else settings


def config_of_folder(folder: Path) -> SurveyConfig:
    """Settings with the image folder: images/ where it exists, else the survey folder itself."""
    if (folder / "images").is_dir():
        return SurveyConfig()
    if any(path.suffix.lower() in SUFFIXES for path in folder.iterdir()):
        return SurveyConfig(images=ImagesConfig(dir="."))
    raise ConfigError(
        f"{folder} has no {FILE_NAME} and no images to infer it from{photographs_elsewhere(folder)}; put the "
        f"photographs into {folder / 'images'} and write {FILE_NAME} with {_EXAMPLE}"
    )


def config_of_images(
    folder: Path,
    config: SurveyConfig,
    headers: dict[str, Exif],
    poses_path: Path | None,
) -> tuple[SurveyConfig, Findings]:
    """Settings inferred from the GPS positions in EXIF, else from geocentric poses, and the assumptions made."""
    file = None if poses_path is None else read_poses(poses_path)
    by_exif = utm_code_of(headers)
    table = table_crs(headers)
    if table is not None and file is None:
        crs, name = (table, "") if "+" in table else (f"{table}+{EGM96_HEIGHT}", ": above mean sea level")
        message = f'crs = "{crs}", that of {GEO_TXT}, with heights taken as they are there{name}'
        return replace(config, crs=crs), Findings((message,))
    code = by_exif
    if code is None and file is not None and file.frame is PoseFrame.GEOCENTRIC:
        lon, lat = middle_of_geocentric(file)
        code = utm_code(lat, lon)
    control = folder / GCP_LIST
    if code is None and file is None and control.is_file():
        crs, heights = _crs_of_control(control)
        message = f'crs = "{crs}", that of {GCP_LIST}{heights}; its points place the photographs'
        return replace(config, crs=crs, control=replace(config.control, gcps=GCP_LIST)), Findings((message,))
    if code is None:
        raise ConfigError(f"{folder} has no {FILE_NAME} and no image a GPS position; write {FILE_NAME} with {_EXAMPLE}")
    crs = f"EPSG:{code}+{EGM96_HEIGHT}"
    is_located = by_exif is not None and file is not None and file.frame is not PoseFrame.LOCAL
    if file is not None and is_located and not fits_positions(CRS(crs), file, poses_path, headers):
        raise ConfigError(
            f"{poses_path} does not fit the GPS positions of the images in the UTM zone EPSG:{code}; "
            f'write {FILE_NAME} with the crs of the poses, e.g. crs = "EPSG:25832+5778"'
        )
    source = position_sources(headers) if poses_path is None else poses_path.name
    assumptions = [
        f'crs = "{crs}", the UTM zone of the {"GPS positions" if by_exif is not None else "poses"}, with heights '
        f"taken as they are in {source}: above mean sea level",
    ]
    if config.water is not None and config.water.gives_level:
        assumptions.append("the level of the water counts from mean sea level, too, as [water] comes without a crs")
    return replace(config, crs=crs), Findings(tuple(assumptions))


def _crs_of_control(path: Path) -> tuple[str, str]:
    """Code of the projected CRS of gcp_list.txt, and in words the datum assumed for its heights where it has none."""
    points = read_gcp_list(path).points
    if not points:
        raise ControlError(f"{path} has no points after the line with its CRS; add them")
    crs = points[0].crs
    plan = None if crs is None else horizontal_crs(crs)
    code = plan.to_epsg() if plan is not None and plan.is_projected else None
    if crs is None or code is None or (has_height(crs) and crs_code(crs) is None):
        raise ConfigError(
            f"{path} is not in a projected CRS of EPSG, with or without heights of EPSG, and nothing else tells where "
            f'the survey lies; write {FILE_NAME} with {_EXAMPLE}, and [control] gcps = "{path.name}"'
        )
    if has_height(crs):
        return str(crs_code(crs)), ""
    return f"EPSG:{code}+{EGM96_HEIGHT}", ", with its heights taken as above mean sea level"


def table_crs(headers: Mapping[str, Exif]) -> str | None:
    """Code of the CRS of the table that gives positions of photographs; None without a table, or of degrees."""
    table = next((header.table_place.crs for header in headers.values() if header.table_place is not None), None)
    return None if table is None or not table.is_projected else crs_code(table)


def crs_advice(headers: dict[str, Exif]) -> str:
    """Advice on crs, with the UTM zone of the images if they have positions."""
    code = utm_code_of(headers) or 25832
    return (
        "give the one that positions and heights in survey.toml and its files count in, with a vertical part: "
        f'crs = "EPSG:{code}+{EGM96_HEIGHT}" where heights are above mean sea level (EGM96), as those of GPS are'
    )


def says_no_place(config: SurveyConfig) -> bool:
    """Whether the settings hold no coordinates, and no height but a level, so that a crs may be chosen."""
    area, local = config.area, config.local
    return (
        (config.water is None or config.water.has_no_place)
        and not config.control.files
        and area.bounds is None
        and area.heights is None
        and local.origin is None
    )


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
