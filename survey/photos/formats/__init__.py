"""Poses files, one module per format: each reads a file into `survey.photos.cameras.Pose`s."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from survey.errors import PosesError
from survey.photos.cameras import Pose
from survey.photos.formats import colmap, opk_csv

# Two photographs may agree by chance on a point that is not there; a third hardly does.
MIN_TRACK = 3
# What other programs leave beside the images; named so that nobody wonders why they are not read.
_NOT_READ = ("cameras.xml", "transforms.json", "reconstruction.json", "nvm", "bundle.out")


def find_poses(folder: Path) -> list[Path]:
    """Poses files and folders of a known format in a survey folder, best known places only."""
    tables = sorted(p for p in folder.glob("*.csv") if opk_csv.is_opk_csv(p))
    models = [folder, *(folder / name for name in ("sparse/0", "sparse", "colmap/sparse/0", "colmap"))]
    return tables + [path for path in models if colmap.is_model(path)]


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
    if path.suffix in (".txt", ".bin") and path.stem in ("images", "cameras") and colmap.is_model(path.parent):
        return colmap.read_model(path.parent)
    if colmap.is_model(path):
        return colmap.read_model(path)
    if path.is_file() and path.suffix.lower() in (".csv", ".txt"):
        return opk_csv.read_opk_csv(path)
    raise PosesError(
        f"{path} is no poses file that is known here; expected a table image,easting,northing,height,omega,phi,kappa "
        "(.csv) or the folder of a COLMAP model (cameras and images, .txt or .bin)"
    )


def read_points(path: Path) -> np.ndarray | None:
    """Matched points (N, 3) [m], local, that came with poses and that three photographs see; None where none came.

    Raises
    ------
    PosesError
        Where their file is damaged.
    """
    folder = path if path.is_dir() else path.parent
    if not colmap.is_model(folder) or path.suffix.lower() == ".csv":
        return None
    points, num_views = colmap.read_points(folder)
    return points[num_views >= MIN_TRACK] if len(points) else None
