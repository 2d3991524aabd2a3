"""Libraries that only some file formats need: extras of the distribution, imported when such a file is read."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import ModuleType

from geo.errors import UnreadableFile


def library_for(path: Path, module: str, extra: str) -> ModuleType:
    """The module that reads a file.

    Raises
    ------
    UnreadableFile
        If it is not installed; the message names the extra that brings it.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise UnreadableFile(
            f"{path} is read by {module.split('.')[0]}, which is not installed: pip install 'bathynerf[{extra}]', or "
            "export it in another format."
        ) from error
