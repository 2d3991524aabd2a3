"""A format of pose files: how it is found, recognised and read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from survey.photos.poses import FileTies, PoseFile


@dataclass(frozen=True)
class Format:
    """A format of poses files."""

    name: str  # In a sentence: "expected ..."
    # callable: files or folders of this format in a survey folder, best known places only
    find: Callable[[Path], list[Path]]
    recognises: Callable[[Path], bool]  # callable: whether a path, which exists, is of this format
    read: Callable[[Path], PoseFile]  # callable: what such a path holds; raises PosesError
    # callable, optional: the files beside such a path, which is one, that are read with it
    files: Callable[[Path], list[Path]] | None = None
    # callable, optional: tie points that came with the poses, in their frame; None where none came; raises PosesError
    read_ties: Callable[[Path], FileTies | None] | None = None
