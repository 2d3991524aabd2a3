"""Libraries that only some file formats need: extras of the distribution, imported when such a file is met."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import ModuleType

from geo.errors import UnreadableFile, UnwritableFile


def library_for(path: str | Path, module: str, extra: str, *, to_write: bool = False) -> ModuleType:
    """The module that reads, or writes, a file.

    Raises
    ------
    UnreadableFile, UnwritableFile
        If it is not installed; the message names the extra that brings it.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        verb, mend = ("written", "name") if to_write else ("read", "export it in")
        raise (UnwritableFile if to_write else UnreadableFile)(
            f"{path} is {verb} by {module.split('.')[0]}, which is not installed: pip install 'bathynerf[{extra}]', or "
            f"{mend} another format."
        ) from error
