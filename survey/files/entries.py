"""What lies in the folders of surveys and runs: files and folders, no pipe or device, whose reading may not end."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from survey.errors import SurveyError


def require_plain_entries(folder: Path) -> None:
    """Raise SurveyError where a folder holds, at any depth, something that is neither a file nor a folder."""
    for place, folders, files in os.walk(folder):
        require_plain(Path(place, name) for name in (*folders, *files))


def require_plain(paths: Iterable[Path]) -> None:
    """Raise SurveyError where one of paths exists and is, or leads to, neither a file nor a folder."""
    for path in paths:
        if not path.is_file() and not path.is_dir() and path.exists():
            raise SurveyError(f"{path} is a pipe, a socket or a device, expected a file or folder; remove it")
