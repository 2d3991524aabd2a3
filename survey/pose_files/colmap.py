"""COLMAP models, text and binary, versions 3 and 4: cameras, images and points in the topocentric frame of [local].

Images carry the pose of each photograph. Rigs and frames, where version 4 wrote them, must say the same.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from refract.lens import LensError
from survey.errors import PosesError
from survey.files.csv_table import shortened
from survey.photos.poses import DuplicatePose, FileTies, Pose, PoseFile, PoseFrame
from survey.photos.rotations import rotation_from_quaternion
from survey.pose_files import colmap_files as files
from survey.pose_files.format import Format

# Where models lie in a survey folder, beside the folder itself.
_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "colmap")
_READERS = {
    "cameras.txt": files.cameras_txt, "images.txt": files.images_txt, "points3D.txt": files.points_txt,
    "rigs.txt": files.rigs_txt, "frames.txt": files.frames_txt,
    "cameras.bin": files.cameras_bin, "images.bin": files.images_bin, "points3D.bin": files.points_bin,
    "rigs.bin": files.rigs_bin, "frames.bin": files.frames_bin,
}  # fmt: skip
# How models begin that come from an adjustment with bent rays, see `survey.adjust.applied`.
_OWN_FIRST_WORDS = b"# In survey.toml:"
# Poses of a rig and of its images are written with 17 digits; further apart than this they are not the same.
_SAME_POSE = 1e-6


def is_model(folder: Path) -> bool:
    """Whether a folder holds a COLMAP model: cameras and images, both .bin or both .txt."""
    return any((folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file() for s in (".bin", ".txt"))


def read_model(folder: Path) -> PoseFile:
    """Poses and lenses of a model in a topocentric frame; binary files take precedence over text, as in COLMAP.

    Raises
    ------
    PosesError
        Where a file is damaged, a camera model is not supported, a pose is not finite, an image has no camera, or rigs
        and frames contradict the images.
    """
    suffix = _suffix(folder)
    lenses = _read(folder / f"cameras{suffix}")
    path = folder / f"images{suffix}"
    photos = _read(path)
    poses: dict[str, Pose] = {}
    for photo in photos:
        name = shortened(photo.name)
        if not np.isfinite(photo.pose).all() or not np.any(photo.pose[:4]):
            raise PosesError(
                f"{path}: the pose of {name} is {[float(f'{v:.6g}') for v in photo.pose]}, expected a quaternion "
                "and a translation of finite numbers; correct it or remove the image from the model"
            )
        lens = lenses.get(photo.camera)
        if isinstance(lens, LensError):
            raise PosesError(f"{folder / f'cameras{suffix}'}: {lens}")
        if lens is None:
            raise PosesError(
                f"{path}: image {name} has the camera {photo.camera}, which cameras{suffix} does not have; write "
                "the model again"
            )
        if photo.name in poses:
            raise DuplicatePose(photo.name, str(path))
        cam_from_local = rotation_from_quaternion(*photo.pose[:4])
        centre = -cam_from_local.T @ np.array(photo.pose[4:])
        poses[photo.name] = Pose(photo.name, centre, cam_from_local, lens)
    if (folder / f"frames{suffix}").is_file() and (folder / f"rigs{suffix}").is_file():
        _require_rigs_agree(folder, suffix, photos)
    return PoseFile(tuple(poses.values()), PoseFrame.LOCAL, tool=None if _is_own(folder) else "COLMAP")


def _is_own(folder: Path) -> bool:
    """Whether a model comes from an adjustment with bent rays; its text lies beside it where it is binary."""
    path = folder / "cameras.txt"
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_OWN_FIRST_WORDS)) == _OWN_FIRST_WORDS


def read_ties(folder: Path) -> FileTies | None:
    """Points of a model with their places in its images; None without a file of points, or with an empty one.

    Raises
    ------
    PosesError
        Where a file is damaged.
    """
    path = next((folder / f"points3D{s}" for s in (".bin", ".txt") if (folder / f"points3D{s}").is_file()), None)
    if path is None:
        return None
    number, points, num_views = _read(path)
    if not len(points):
        return None
    photos = _read(folder / f"images{_suffix(folder)}")
    image = np.repeat(np.arange(len(photos)), [len(photo.point) for photo in photos])
    seen = np.concatenate([np.empty(0, dtype=np.int64), *(photo.point for photo in photos)])
    pixel = np.concatenate([np.empty((0, 2)), *(photo.xy for photo in photos)])
    at = np.searchsorted(number, seen).clip(max=len(number) - 1)
    known = (number[at] == seen) & np.isfinite(pixel).all(axis=1)
    return FileTies(points, num_views, tuple(photo.name for photo in photos), at[known], image[known], pixel[known])


def _require_rigs_agree(folder: Path, suffix: str, photos: list[files.Photo]) -> None:
    """Raise where the poses of frames and rigs, which COLMAP 4 goes by, are not those of the images."""
    rigs = _read(folder / f"rigs{suffix}")
    by_number = {photo.number: photo for photo in photos}
    for rig, rig_from_world, data in _read(folder / f"frames{suffix}"):
        for camera, image in data:
            photo, cam_from_rig = by_number.get(image), rigs.get((rig, camera))
            if photo is None or cam_from_rig is None:
                continue
            # A pose that is not finite, or too large, differs from every other.
            with np.errstate(over="ignore", invalid="ignore"):
                expected = _matrix(cam_from_rig) @ _matrix(rig_from_world)
                difference = np.abs(expected - _matrix(photo.pose)).max()
            if not difference <= _SAME_POSE * max(1.0, np.abs(expected).max()):
                raise PosesError(
                    f"{folder}: the pose of {shortened(photo.name)} in images{suffix} is not that of its rig in "
                    f"frames{suffix} and rigs{suffix}; write the model again, or remove these two "
                    f"files if images{suffix} is right"
                )


def _matrix(pose: list[float]) -> np.ndarray:
    """(3, 4) and a last row."""
    found = np.eye(4)
    has_rotation = np.any(pose[:4]) and np.isfinite(pose[:4]).all()
    found[:3, :3] = rotation_from_quaternion(*pose[:4]) if has_rotation else np.nan
    found[:3, 3] = pose[4:]
    return found


def _suffix(folder: Path) -> str:
    return ".bin" if (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file() else ".txt"


def _read(path: Path):
    """The content of a file of a model; errors name the file."""
    try:
        return _READERS[path.name](path)
    except (PosesError, LensError) as error:
        raise PosesError(f"{path}: {error}") from error
    except (struct.error, ValueError, IndexError, OverflowError, MemoryError) as error:
        raise PosesError(
            f"{path} is damaged or not a COLMAP file ({shortened(str(error))}); write the model again with "
            "COLMAP's model_converter"
        ) from error
    except OSError as error:
        raise PosesError(f"{path} cannot be read ({error.strerror}); correct its permissions") from error


def _model_of(path: Path) -> Path | None:
    """The folder of the model that a path names: itself, or that of its images or cameras file."""
    is_file_of_it = path.suffix in (".txt", ".bin") and path.stem in ("images", "cameras")
    folder = path.parent if is_file_of_it else path
    return folder if is_model(folder) else None


FORMAT = Format(
    name="the folder of a COLMAP model (cameras and images, .txt or .bin)",
    find=lambda folder: [p for p in (folder, *(folder / name for name in _PLACES)) if is_model(p)],
    recognises=lambda path: _model_of(path) is not None,
    read=lambda path: read_model(_model_of(path) or path),
    files=lambda path: [path.with_name(name) for name in _READERS],
    read_ties=lambda path: read_ties(_model_of(path) or path),
)
