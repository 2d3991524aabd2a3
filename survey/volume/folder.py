"""The folder that `bathynerf field` leaves: what tells it from a run, and the run that its field was trained on."""

from __future__ import annotations

from pathlib import Path

from survey.errors import SurveyError
from survey.files.json_values import read_json_object
from survey.run.stored import FIELD_SETTINGS, FIELD_STATE

SUBMODULES = "submodules"  # Folder of the submodules, where there are some


def is_field(folder: Path) -> bool:
    """Whether a folder is one of `bathynerf field`."""
    return (folder / FIELD_SETTINGS).is_file() and ((folder / FIELD_STATE).is_file() or (folder / SUBMODULES).is_dir())


def run_of(folder: Path) -> Path:
    """The run that the field in a folder was trained on."""
    if not is_field(folder):
        raise SurveyError(f"{folder} holds no trained field ({FIELD_SETTINGS} and {FIELD_STATE}); expected one")
    run = read_json_object(folder / FIELD_SETTINGS).get("run")
    if not isinstance(run, str) or not Path(run).is_dir():
        raise SurveyError(
            f"the field in {folder} was trained on the run {run}, which is not there; give the same options to "
            "bathynerf field with its present folder, which writes that down"
        )
    return Path(run)
