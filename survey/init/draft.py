"""A draft of survey.toml for a folder, from its files, with a comment at every uncertain value."""

from contextlib import suppress
from pathlib import Path

import numpy as np

from geo.crs import vertical_crs
from geo.files import write_text
from survey.control.points import GivenPoint
from survey.control.reading import read_control
from survey.errors import FILE_NAME, ConfigError, ControlError, OutputError
from survey.files.json_values import write_json
from survey.files.toml_table import schema_of
from survey.folder.found import Found, find_survey, image_folder_of, require_survey_folder
from survey.folder.headers import read_headers
from survey.folder.sfm_views import require_solvable
from survey.init.crs import FolderPhotographs, SettingsTable, write_crs, write_origin
from survey.photos.images import list_images
from survey.pose_files import find_poses, read_poses
from survey.settings.config import SurveyConfig, WaterConfig, parse_config, settings_of
from survey.settings.tables import InitOptions
from survey.sfm.gps import is_whole, positions_in_crs
from survey.water.level import FRESH_WATER, SEA_WATER, SODIUM_NM
from survey.words import printable

# The form in which TOML extensions of editors find a schema (Taplo, Even Better TOML, Tombi).
SCHEMA_NAME = "survey.schema.json"
SCHEMA_LINE = f"#:schema {SCHEMA_NAME}\n"
# Fewer photographs cannot determine the level of the water.
_FEWEST_FOR_LEVEL = 3
# Usual names of files by their key in [water]; the first that exists is used.
_WATER_FILES = {
    "gauge": ("gauge", "tide", "tides", "waterlevel", "water_level"),
    "gnss_points": ("gnss_points", "surface", "water_surface"),
    "shoreline": ("shoreline", "waterline"),
    "image_levels": ("image_levels", "levels"),
    "clicks": ("clicks",),
}
_CONTROL_FILES = {
    "gcps": ("gcp_list", "gcps", "gcp"),
    "marks": ("marks", "markers"),
    "checkpoints": ("checkpoints", "check_points"),
}
_SUFFIXES = (".csv", ".txt", ".geojson", ".json", ".gpx", ".kml")


def write_schema(folder: Path) -> Path:
    """Write the JSON schema of survey.toml into a folder, for editors; returns its path."""
    path = require_survey_folder(folder) / SCHEMA_NAME
    write_json(path, schema_of(SurveyConfig))
    return path


def settings_or_draft(folder: Path) -> SurveyConfig:
    """The settings in a folder, else those that `write_settings` would write there."""
    settings = settings_of(folder)
    return parse_config(draft(folder, InitOptions())) if settings is None else settings


def write_settings(
    folder: str | Path, options: InitOptions = InitOptions(), *, force: bool = False, names_schema: bool = False
) -> Path:
    """Write survey.toml into a folder, with the schema of `write_schema` in its first line if it is to be named there.

    Returns its path. Raises SurveyError where something is missing that neither a file nor an option states.
    """
    folder = require_survey_folder(folder)
    path = folder / FILE_NAME
    if path.exists() and not force:
        raise OutputError(f"{path} exists; --force replaces it")
    write_text(path, (SCHEMA_LINE if names_schema else "") + draft(folder, options))
    return path


def require_settings(folder: Path, options: InitOptions) -> Path | None:
    """Write survey.toml where there is none, and return its path; raise ConfigError where one says other than told.

    Nothing is written of a survey that `process` would refuse for it, as with a level that no camera fits.
    """
    if (config := settings_of(require_survey_folder(folder))) is None:
        text = draft(folder, options)
        found = find_survey(folder, config=parse_config(text))
        if found.poses_path is None:
            require_solvable(found)
        write_text(folder / FILE_NAME, text)
        return folder / FILE_NAME
    water = config.water or WaterConfig()
    given = (water.level_m, water.refractive_index == SEA_WATER or None, config.dry, config.crs, config.local.origin)
    for name, value in zip(("level_m", "sea", "dry", "crs", "origin"), given, strict=True):
        told = getattr(options, name)
        if told not in (None, False, value):
            says = "does not say so" if value is None else f"has {value}"
            raise ConfigError(f"{name} is told to be {told}, but {folder / FILE_NAME} {says}; change it there")
    return None


def draft(folder: Path, options: InitOptions) -> str:
    """Settings in TOML for a folder of photographs, and of poses, control and water levels found with them."""
    top, images, cameras, water, control, area, local = (
        SettingsTable(name) for name in ("", "images", "cameras", "water", "control", "area", "local")
    )
    top.set("name", printable(folder.resolve().name))
    place = image_folder_of(folder)
    paths = list_images(folder / place, deep=place != ".")
    if place != "images":
        images.set("dir", place, f"{len(paths)} photographs")
    if (folder / "masks").is_dir():
        images.set("masks", "masks", "black is left out")
    headers, findings = read_headers(folder, folder / place, paths)
    poses = find_poses(folder)
    if poses:
        others = ", ".join(path.relative_to(folder).as_posix() for path in poses[1:])
        not_certain = f"not certain: there are also {others}" if others else ""
        cameras.set("poses", poses[0].relative_to(folder).as_posix(), not_certain)
    else:
        cameras.add_comments(f"No poses found: structure from motion computes them from the {len(paths)} photographs.")
    cameras.add_comments(*(f"Found: {sentence}." for sentence in findings.assumptions))
    cameras.add_comments(*(f"Not certain: {sentence}." for sentence in findings.warnings))
    path, file = (poses[0], read_poses(poses[0])) if poses else (None, None)
    photographs = FolderPhotographs(headers, path, file, _control_points(folder))
    if file is not None and any(pose.lens is None for pose in file.poses):
        cameras.add_comments(
            "Not certain: the lens, by EXIF where it states the focal length. With a calibration:",
            'model = "OPENCV"    # with size_px, focal_px, principal_point_px and distortion (docs/survey-toml.md)',
        )
    crs = write_crs(photographs, options, top, cameras)
    config = parse_config("\n".join(table.text() for table in (top, images, cameras)))
    write_origin(photographs, options, Found(folder, config, crs, paths, headers, path), local)
    places = np.array(list(positions_in_crs(headers, crs, config.cameras.gps_height)[0].values())).reshape(-1, 3)
    vertical = vertical_crs(crs)
    heights = "above the ellipsoid" if vertical is None else f"as {vertical.name}"
    if len(places):
        low, high = places.min(axis=0).tolist(), places.max(axis=0).tolist()
        bounds = [round(value, 1) for value in low[:2] + high[:2]]
        area.add_comments(f"bounds = {bounds}    # of the cameras; without it all is taken")
        heights += f", in which the cameras are at {low[2]:.1f} to {high[2]:.1f}"
    _write_water(folder, photographs, options, heights, top, water)
    _write_control(folder, control)
    text = "\n".join(table.text() for table in (top, images, cameras, local, area, control, water) if table.lines)
    parse_config(text)
    return text


def _write_water(
    folder: Path,
    photographs: FolderPhotographs,
    options: InitOptions,
    heights: str,
    top: SettingsTable,
    water: SettingsTable,
) -> None:
    files = _files(folder, _WATER_FILES)
    if options.level_m is None and not files and not options.dry:
        num_placed = sum(is_whole(header.lat_lon_height) for header in photographs.headers.values())
        can_do_without = photographs.poses_path is None and num_placed >= _FEWEST_FOR_LEVEL
        options = options.with_level(heights, can_do_without=can_do_without)
    if options.dry:
        top.set("dry", True, "no ground is under water")
        return
    if options.level_m is not None:
        water.set("level_m", options.level_m, "height of the water in the heights of crs")
    elif files:
        key = next(iter(files))
        water.set(key, files.pop(key), "taken by its name")
    else:
        water.add_comments(
            "level_m = 12.34    # not known: found from the photographs, where oblique views cross; better give it"
        )
    water.add_comments(*(f'{key} = "{name}"' for key, name in files.items()))
    if options.level_m is not None:
        water.add_comments("level_std_m = 0.02    # how well it is known, e.g. from a staff")
    if options.sea:
        water.set("refractive_index", SEA_WATER, "of the sea")
        water.set("index_wavelength_nm", SODIUM_NM, "that of handbooks")
    else:
        water.add_comments(
            f"refractive_index: not certain, taken as that of fresh water, {FRESH_WATER}; the sea has {SEA_WATER:.3f}."
        )


def _write_control(folder: Path, control: SettingsTable) -> None:
    files = _files(folder, _CONTROL_FILES)
    if "gcps" in files and "marks" not in files and not files["gcps"].endswith(".txt"):
        control.add_comments(
            f'gcps = "{files.pop("gcps")}"    # where photographs show the points is missing: marks = "marks.csv"'
        )
    if "gcps" not in files:
        files.pop("marks", None)
    for key, name in files.items():
        control.set(key, name, "taken by its name")


def _control_points(folder: Path) -> tuple[GivenPoint, ...]:
    """Points of the control file that is found; none where it cannot be read, which `check` says."""
    name = _files(folder, _CONTROL_FILES).get("gcps")
    with suppress(ControlError):
        return () if name is None else read_control(folder / name).points
    return ()


def _files(folder: Path, stems: dict[str, tuple[str, ...]]) -> dict[str, str]:
    """By key the file with one of its usual names, the first of them that is there."""
    names = {path.stem.lower(): path.name for path in sorted(folder.iterdir()) if path.suffix.lower() in _SUFFIXES}
    found = {key: [names[stem] for stem in usual if stem in names] for key, usual in stems.items()}
    return {key: own[0] for key, own in found.items() if own}
