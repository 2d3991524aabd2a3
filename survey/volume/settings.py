"""The options of a training from the command line and from [field] in survey.toml."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from survey.errors import FILE_NAME
from survey.export.loaded import LoadedRun, survey_folder
from survey.settings.config import read_config
from survey.settings.tables import FieldConfig
from survey.volume.options import VolumeOptions


def field_config(run: str | Path, survey: str | None) -> FieldConfig:
    """[field] of the survey that a run is of, as its survey.toml has it now; paths in it are absolute.

    Parameters
    ----------
    survey : str, optional
        Folder of the survey, if it was moved since the run.

    Raises
    ------
    SurveyError, ConfigError
        If the run or its survey.toml cannot be read.
    """
    with LoadedRun(run) as loaded:
        folder = survey_folder(loaded, survey)
    toml = folder / FILE_NAME
    config = read_config(toml).field if toml.is_file() else FieldConfig()
    if config.monocular is None:
        return config
    return replace(config, monocular=str((folder / config.monocular).absolute()))


def volume_options(config: FieldConfig, **others: Any) -> VolumeOptions:
    """`VolumeOptions` of what a configuration says; what it leaves open has its default."""
    said = {each.name: value for each in fields(config) if (value := getattr(config, each.name)) is not None}
    if config.monocular is not None:
        said["monocular"] = Path(config.monocular)
    return VolumeOptions(**said, **others)
