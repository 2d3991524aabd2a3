"""Poses files, one module per format: each reads a file into `survey.photos.cameras.Pose`s."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from survey.errors import PosesError
from survey.photos.cameras import Pose
from survey.photos.formats import colmap, opk_csv
from survey.photos.formats.format import Format
from survey.photos.tie_points import MIN_TRACK

# Files of other programs that are not read; warnings name them.
_NOT_READ = ("cameras.xml", "transforms.json", "reconstruction.json", "nvm", "bundle.out")
# Asked in this order which of them a path is of.
FORMATS = (opk_csv.FORMAT, colmap.FORMAT)


def find_poses(folder: Path) -> list[Path]:
    """Poses files and model folders of a known format, in their usual places in a survey folder."""
    return [path for known in FORMATS for path in known.find(folder)]


def find_unread(folder: Path) -> list[str]:
    """Names of poses files in a survey folder whose format is not read yet."""
    return [name for name in _NOT_READ if (folder / name).is_file()]


def read_poses(path: Path) -> list[Pose]:
    """Poses in a file (cameras.csv) or folder (COLMAP model, text or binary).

    Raises
    ------
    PosesError
        Where the path does not exist, its format is not known, or its content cannot be true.
    """
    if not path.exists():
        raise PosesError(f"the poses file {path} does not exist; correct [cameras] poses in survey.toml")
    known = _format_of(path)
    if known is None:
        expected = " or ".join(known.name for known in FORMATS)
        raise PosesError(f"{path} is not a known kind of poses file; expected {expected}")
    return known.read(path)


def read_points(path: Path) -> np.ndarray | None:
    """Matched points (N, 3) [m], local, that came with poses and that three photographs see; None where none came.

    Raises
    ------
    PosesError
        Where their file is damaged.
    """
    known = _format_of(path)
    if known is None or known.read_points is None:
        return None
    points, num_views = known.read_points(path)
    return points[num_views >= MIN_TRACK] if len(points) else None


def _format_of(path: Path) -> Format | None:
    return next((known for known in FORMATS if known.recognises(path)), None)
