"""Poses files, one module per format: each reads a file into `survey.photos.cameras.Pose`s."""

from __future__ import annotations

from pathlib import Path

from survey.errors import PosesError
from survey.photos.cameras import Pose
from survey.photos.formats import colmap, opk_csv

# Files of other programs that are not read; warnings name them.
_NOT_READ = ("cameras.xml", "transforms.json", "reconstruction.json", "nvm", "bundle.out")


def find_poses(folder: Path) -> list[Path]:
    """Poses files and model folders of a known format, in their usual places in a survey folder."""
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
