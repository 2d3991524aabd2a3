"""The files of a survey that no result may overwrite."""

from __future__ import annotations

from pathlib import Path

from survey.errors import FILE_NAME
from survey.files.outputs import ReadFiles
from survey.folder import infer
from survey.folder.geo_txt import find_geo_txt
from survey.photos.exif import SUFFIXES
from survey.pose_files import find_poses, pose_files
from survey.settings.config import read_config


def survey_inputs(folder: Path) -> ReadFiles:
    """Settings, poses, photographs, masks, control and measured water levels of a survey folder.

    Raises
    ------
    ConfigError
        Where the settings cannot be read, or there are neither settings nor images.
    """
    if not folder.is_dir():
        return ReadFiles()
    toml = folder / FILE_NAME
    config = read_config(toml) if toml.is_file() else infer.config_of_folder(folder)
    named = [toml]
    if config.water is not None:
        named += [folder / path for path in config.water.sources.named.values()]
    named += [folder / name for name in config.control.files]
    poses = find_poses(folder) if config.cameras.poses is None else [folder / config.cameras.poses]
    table = find_geo_txt(folder, folder / config.images.dir)
    named += [] if table is None else [table]
    folders = [] if config.images.masks is None else [folder / config.images.masks]
    if config.images.dir == ".":
        named += [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]
    else:
        folders.append(folder / config.images.dir)
    return sum((poses_inputs(path) for path in poses), ReadFiles.of(*named, *folders))


def poses_inputs(path: Path) -> ReadFiles:
    """The files of poses: a table, or those of a model or project, but not what lies below its folder."""
    return ReadFiles.of(*pose_files(path))
