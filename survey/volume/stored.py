"""A volume in training, and trained, in a folder: the state that goes on after an interruption."""

from __future__ import annotations

import json
import pickle
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from geo.files import disk_refusals, write_whole
from survey.errors import OutputError, SurveyError
from survey.files.json_values import read_json_object
from survey.files.outputs import ReadFiles, require_folder

STATE, SETTINGS = "state.pt", "settings.json"
# Seconds between two states.
_EVERY_S = 30.0


class VolumeFolder:
    """The folder of a volume.

    Parameters
    ----------
    path : Path
    settings : dict
        All that the training depends on.
    inputs : ReadFiles
        What is read, and must not be written over.

    Raises
    ------
    OutputError
        If the folder holds a volume of other settings, or something else.
    """

    def __init__(self, path: Path, settings: dict[str, Any], inputs: ReadFiles):
        self.path = path
        require_folder("-o", path, inputs)
        self._saved_at = time.monotonic()
        # As a file would give them back.
        settings = json.loads(json.dumps(settings))
        if (path / SETTINGS).is_file():
            self._require_same(read_json_object(path / SETTINGS), settings)
        elif path.is_dir() and any(path.iterdir()):
            raise OutputError(f"-o names {path}, which is not empty and holds no volume; name another folder")
        with disk_refusals(path):
            path.mkdir(parents=True, exist_ok=True)
        with write_whole(path / SETTINGS) as stream:
            stream.write(json.dumps(settings, indent=2).encode())

    def _require_same(self, before: dict[str, Any], settings: dict[str, Any]) -> None:
        keys = [key for key in {**before, **settings} if before.get(key) != settings.get(key)]
        if keys:
            differ = "; ".join(f"{key}: {before.get(key)} there, {settings.get(key)} asked for" for key in keys)
            raise OutputError(f"-o names {self.path}, which holds a volume of other settings ({differ}); name another")

    def load(self) -> dict[str, Any] | None:
        """The state that was saved last; None where there is none.

        Raises
        ------
        SurveyError
            If it is damaged.
        """
        state = self.path / STATE
        if not state.is_file():
            return None
        try:
            return torch.load(state, weights_only=True)
        except (OSError, RuntimeError, ValueError, KeyError, EOFError, pickle.UnpicklingError) as error:
            raise SurveyError(
                f"{state} cannot be read ({str(error)[:80]}); delete it, and training begins anew"
            ) from error

    def save(self, make: Callable[[], dict[str, Any]], *, last: bool) -> None:
        """Save a state, if it is the last or the one before is half a minute old."""
        if last or time.monotonic() - self._saved_at > _EVERY_S:
            with write_whole(self.path / STATE) as stream:
                torch.save(make(), stream)
        self._saved_at = time.monotonic()
