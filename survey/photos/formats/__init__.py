"""Poses files, one module per format: each reads a file into a `survey.photos.poses.PoseFile`."""

from __future__ import annotations

from pathlib import Path

from survey.errors import PosesError
from survey.photos.formats import colmap, metashape, opensfm, opk_csv
from survey.photos.formats.format import Format
from survey.photos.poses import FileTies, PoseFile

# Files of other programs that are not read; warnings name them.
_NOT_READ = ("transforms.json", "nvm", "bundle.out")
# Asked in this order which of them a path is of.
FORMATS = (opk_csv.FORMAT, colmap.FORMAT, opensfm.FORMAT, metashape.FORMAT)


def find_poses(folder: Path) -> list[Path]:
    """Poses files and model folders of a known format, in their usual places in a survey folder."""
    return [path for known in FORMATS for path in known.find(folder)]


def find_unread(folder: Path) -> list[str]:
    """Names of poses files in a survey folder whose format is not read yet."""
    return [name for name in _NOT_READ if (folder / name).is_file()]


def read_poses(path: Path) -> PoseFile:
    """What a poses file, or the folder of a model, holds.

    Raises
    ------
    PosesError
        Where the path does not exist, its format is not known, or its content cannot be true.
    """
    if not path.exists():
        raise PosesError(f"the poses file {path} does not exist; correct [cameras] poses in survey.toml")
    known = _format_of(path)
    if known is None:
        expected = "; ".join(known.name for known in FORMATS)
        raise PosesError(f"{path} is not a known kind of poses file; expected one of: {expected}")
    return known.read(path)


def read_ties(path: Path) -> FileTies | None:
    """Tie points that came with poses, in the frame of these; None where none came.

    Raises
    ------
    PosesError
        Where their file is damaged.
    """
    known = _format_of(path)
    return None if known is None or known.read_ties is None else known.read_ties(path)


def _format_of(path: Path) -> Format | None:
    return next((known for known in FORMATS if known.recognises(path)), None)
