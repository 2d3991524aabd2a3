"""A format of pose files: how it is found, recognised and read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from survey.photos.poses import FileTies, PoseFile


@dataclass(frozen=True)
class Format:
    """A format of poses files.

    Attributes
    ----------
    name : str
        In a sentence: "expected ...".
    find : callable
        Files or folders of this format in a survey folder, best known places only.
    recognises : callable
        Whether a path, which exists, is of this format.
    read : callable
        What such a path holds; raises PosesError.
    files : callable, optional
        The files beside such a path, which is one, that are read with it.
    read_ties : callable, optional
        Tie points that came with the poses, in their frame; None where none came; raises PosesError.
    """

    name: str
    find: Callable[[Path], list[Path]]
    recognises: Callable[[Path], bool]
    read: Callable[[Path], PoseFile]
    files: Callable[[Path], list[Path]] | None = None
    read_ties: Callable[[Path], FileTies | None] | None = None
