"""COLMAP models, text and binary: cameras, images and points in the topocentric frame of [local].

The layouts are those of COLMAP's ``doc/format.rst`` and ``reconstruction_io_binary.cc``; rigs and frames are not
needed, because images still carry the pose of each photograph.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from refract.lens import MODELS, Lens, LensError
from survey.errors import PosesError
from survey.photos.cameras import Pose, rotation_from_quaternion
from survey.photos.formats.format import Format

# Where models lie in a survey folder, beside the folder itself.
_PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "colmap")
_NAME_OF_ID = {number: name for name, (number, _) in MODELS.items()}
# Names and number of parameters of the models that COLMAP has beyond ours, so that an error can name them.
_OTHER_IDS = {
    7: "FOV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION", 13: "DIVISION", 14: "SIMPLE_FISHEYE",
    15: "FISHEYE", 16: "EUCM", 17: "EQUIRECTANGULAR",
}  # fmt: skip


def is_model(folder: Path) -> bool:
    """Whether a folder holds a COLMAP model: cameras and images, both .bin or both .txt."""
    return any((folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file() for s in (".bin", ".txt"))


def read_model(folder: Path) -> list[Pose]:
    """Poses and lenses of a model in a topocentric frame; binary files take precedence over text, as in COLMAP.

    Raises
    ------
    PosesError
        Where a file is damaged, a camera model is not supported, a pose is not finite or an image has no
        camera.
    """
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    suffix, cameras, images = (".bin", _cameras_bin, _images_bin) if binary else (".txt", _cameras_txt, _images_txt)
    lenses = _guarded(cameras, folder / f"cameras{suffix}")
    poses: dict[str, Pose] = {}
    path = folder / f"images{suffix}"
    for name, camera_id, numbers in _guarded(images, path):
        if not np.isfinite(numbers).all() or not np.any(numbers[:4]):
            raise PosesError(
                f"{path}: the pose of {name} is {[float(f'{v:.6g}') for v in numbers]}, expected a quaternion and a "
                "translation of finite numbers; correct it or remove the image from the model"
            )
        if camera_id not in lenses:
            raise PosesError(f"{path}: image {name} has the camera {camera_id}, which cameras{suffix} does not have")
        if name in poses:
            raise PosesError(f"{path}: image {name} has a second pose; keep one of the two")
        cam_from_local = rotation_from_quaternion(*numbers[:4])
        centre = -cam_from_local.T @ np.array(numbers[4:])
        poses[name] = Pose(name, centre, cam_from_local, in_crs=False, lens=lenses[camera_id])
    return list(poses.values())


def read_points(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) [m] of a model, in its frame, and how many images see each, (N,); empty without a file of them.

    Raises
    ------
    PosesError
        Where the file is damaged.
    """
    for name, reader in (("points3D.bin", _points_bin), ("points3D.txt", _points_txt)):
        if (folder / name).is_file():
            found = _guarded(reader, folder / name)
            points = np.array([point for point, _ in found], dtype=np.float64).reshape(-1, 3)
            good = np.isfinite(points).all(axis=1)
            return points[good], np.array([count for _, count in found], dtype=np.int64)[good]
    return np.empty((0, 3)), np.empty(0, dtype=np.int64)


def _guarded(reader, path: Path):
    """The result of a reader; its errors name the file."""
    try:
        return reader(path)
    except (PosesError, LensError) as error:
        raise PosesError(f"{path}: {error}") from error
    except (struct.error, ValueError, IndexError) as error:
        raise PosesError(
            f"{path} is damaged or not a COLMAP file ({error}); write the model again with COLMAP's model_converter"
        ) from error


def _cameras_txt(path: Path) -> dict[int, Lens]:
    lenses = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.strip() and not line.startswith("#"):
            number, model, width, height, *params = line.split()
            lenses[int(number)] = Lens(model, tuple(float(p) for p in params), int(width), int(height))
    return lenses


def _images_txt(path: Path) -> list[tuple[str, int, list[float]]]:
    # Every image has two lines, and the second one (its points) may be empty: never drop blank lines before
    # pairing.
    images, lines = [], iter(path.read_text(encoding="utf-8").splitlines())
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        parts = line.split(maxsplit=9)
        images.append((parts[9].strip(), int(parts[8]), [float(v) for v in parts[1:8]]))
        if len(next(lines, "").split()) % 3:
            raise ValueError(f"the line after image {images[-1][0]} is no list of points (x, y, id) and not empty")
    return images


def _cameras_bin(path: Path) -> dict[int, Lens]:
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, lenses = 8, {}
    for _ in range(count):
        number, model_id, width, height = struct.unpack_from("<IiQQ", data, at)
        if model_id not in _NAME_OF_ID:
            model = _OTHER_IDS.get(model_id, f"number {model_id}")
            return {number: Lens(model, (), width, height)}  # refused there, by name
        model = _NAME_OF_ID[model_id]
        size = len(MODELS[model][1])
        params = struct.unpack_from(f"<{size}d", data, at + 24)
        lenses[number] = Lens(model, params, width, height)
        at += 24 + 8 * size
    return lenses


def _images_bin(path: Path) -> list[tuple[str, int, list[float]]]:
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, images = 8, []
    for _ in range(count):
        _, *numbers, camera_id = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        images.append((data[at + 64 : end].decode("utf-8"), camera_id, numbers))
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
        if at > len(data):
            raise ValueError(f"it ends after {len(data)} bytes, within the points of {images[-1][0]}")
    return images


def _points_txt(path: Path) -> list[tuple[tuple[float, ...], int]]:
    points = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.strip() and not line.startswith("#"):
            numbers = line.split()
            if len(numbers) < 8 or len(numbers) % 2:
                raise ValueError(f"the line of point {numbers[0]} has {len(numbers)} numbers")
            points.append((tuple(float(v) for v in numbers[1:4]), (len(numbers) - 8) // 2))
    return points


def _points_bin(path: Path) -> list[tuple[tuple[float, ...], int]]:
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, points = 8, list[tuple[tuple[float, ...], int]]()
    for _ in range(count):
        _, x, y, z, *_, length = struct.unpack_from("<Q3d3BdQ", data, at)
        points.append(((x, y, z), length))
        at += 51 + 8 * length
    if at > len(data):
        raise ValueError(f"it ends after {len(data)} bytes, within its points")
    return points


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
    read_points=lambda path: read_points(_model_of(path) or path),
)
