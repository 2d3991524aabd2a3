"""COLMAP models, text and binary, of versions 3 and 4: cameras, images and points in the topocentric frame of [local].

The layouts are those of COLMAP's ``doc/format.rst`` and ``reconstruction_io_binary.cc``. Images carry the pose of each
photograph, also where version 4 has rigs and frames beside them.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from refract.lens import MODELS, Lens, LensError
from survey.errors import PosesError
from survey.files.paths import begins_with
from survey.photos.poses import FileTies, Pose, PoseFile, PoseFrame, rotation_from_quaternion
from survey.pose_files.format import Format

# Where models lie in a survey folder; a mapper numbers those of blocks without common points.
_PLACES = ("sparse/[0-9]*", "sparse", "colmap/sparse/[0-9]*", "colmap/sparse", "colmap", "[0-9]*")
# How models begin that come from an adjustment with bent rays, see `survey.adjust.applied`.
_OWN_FIRST_WORDS = b"# In survey.toml:"
# Models that are OPENCV_FISHEYE with fewer numbers: the places of fx fy cx cy k1 k2 k3 k4 among these.
_AS_FISHEYE = {
    "SIMPLE_RADIAL_FISHEYE": (0, 0, 1, 2, 3), "RADIAL_FISHEYE": (0, 0, 1, 2, 3, 4), "SIMPLE_FISHEYE": (0, 0, 1, 2),
    "FISHEYE": (0, 1, 2, 3),
}  # fmt: skip
# Models by their number in binary files, with how many numbers each has: those that are read, and the others.
_BY_NUMBER = {number: (name, len(params)) for name, (number, params) in MODELS.items() if number is not None} | {
    7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4), 9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16), 12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4), 16: ("EUCM", 6), 17: ("EQUIRECTANGULAR", 2),
}  # fmt: skip
_FEATURE = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])

# Model, parameters, width and height: a lens only where an image uses it, as others may be of any model.
_Camera = tuple[str, tuple[float, ...], int, int]
_Point = tuple[int, list[float], int]  # number, coordinates, number of views


@dataclass(frozen=True, eq=False)
class _Image:
    pose: list[float]  # list of 7 float: quaternion (w first) and translation, from world to cam
    camera: int
    name: str
    xy: np.ndarray  # (M, 2) float64 [px], img
    point: np.ndarray  # (M,) int64: number of the point of each feature; -1 for none


def lens_of(model: str, params: tuple[float, ...], width: int, height: int) -> Lens:
    """The lens of a camera of a model; raises LensError."""
    places = _AS_FISHEYE.get(model)
    if places is not None and len(params) == max(places) + 1:
        return Lens("OPENCV_FISHEYE", (*(params[i] for i in places), *[0.0] * (8 - len(places))), width, height)
    return Lens(model, params, width, height)


def _cameras_txt(path: Path) -> dict[int, _Camera]:
    cameras = {}
    for line in _lines(path):
        number, model, width, height, *params = line.split()
        cameras[int(number)] = (model, tuple(map(float, params)), int(width), int(height))
    return cameras


def _images_txt(path: Path) -> Iterator[_Image]:
    # Every image has two lines, and the second one (its points) may be empty: never drop blank lines before
    # pairing.
    lines = iter(path.read_text(encoding="utf-8").splitlines())
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        parts = line.strip().split(maxsplit=9)
        if len(parts) != 10:
            raise ValueError(f"the line of an image has {len(parts)} words, expected 10")
        _, *pose, camera, name = parts
        features = next(lines, "").split()
        if len(features) % 3:
            raise ValueError(f"the line after image {name} is not a list of points (x, y, id) and not empty")
        xy = np.array([features[0::3], features[1::3]], dtype=np.float64).T
        yield _Image([float(v) for v in pose], int(camera), name, xy, np.array(features[2::3], dtype=np.int64))


def _points_txt(path: Path) -> Iterator[_Point]:
    for line in _lines(path):
        numbers = line.split()
        if len(numbers) < 8 or len(numbers) % 2:
            raise ValueError(f"the line of point {numbers[0]} has {len(numbers)} numbers")
        yield int(numbers[0]), [float(v) for v in numbers[1:4]], (len(numbers) - 8) // 2


def _lines(path: Path) -> Iterator[str]:
    return (line for line in path.read_text(encoding="utf-8").splitlines() if line.strip() and not line.startswith("#"))


def _cameras_bin(path: Path) -> dict[int, _Camera]:
    data, cameras, at = path.read_bytes(), dict[int, _Camera](), 8
    for _ in range(_count(data)):
        number, model, width, height = struct.unpack_from("<IiQQ", data, at)
        if model not in _BY_NUMBER:
            # How many parameters it has, nobody knows: what follows cannot be read.
            raise LensError(f"camera model number {model} is not supported, expected one of {', '.join(MODELS)}")
        name, size = _BY_NUMBER[model]
        cameras[number] = (name, struct.unpack_from(f"<{size}d", data, at + 24), width, height)
        at += 24 + 8 * size
    return cameras


def _images_bin(path: Path) -> Iterator[_Image]:
    data, at = path.read_bytes(), 8
    for _ in range(_count(data)):
        _, *pose, camera = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        name, (num,) = data[at + 64 : end].decode("utf-8"), struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + _FEATURE.itemsize * num
        if at > len(data):
            raise ValueError(f"it ends after {len(data)} bytes, within the points of {name}")
        found = np.frombuffer(data, dtype=_FEATURE, count=num, offset=end + 9)
        yield _Image(pose, camera, name, np.column_stack([found["x"], found["y"]]), found["point"])


def _points_bin(path: Path) -> Iterator[_Point]:
    data, at = path.read_bytes(), 8
    for _ in range(_count(data)):
        number, x, y, z, *_, length = struct.unpack_from("<Q3d3BdQ", data, at)
        at += 51 + 8 * length
        if at > len(data):
            raise ValueError(f"it ends after {len(data)} bytes, within its points")
        yield number, [x, y, z], length


def _count(data: bytes) -> int:
    return struct.unpack_from("<Q", data)[0]


_READERS = {
    "cameras.txt": _cameras_txt, "images.txt": _images_txt, "points3D.txt": _points_txt,
    "cameras.bin": _cameras_bin, "images.bin": _images_bin, "points3D.bin": _points_bin,
}  # fmt: skip


def _read(path: Path):
    """The content of a file of a model; errors name the file."""
    try:
        content = _READERS[path.name](path)
        return content if isinstance(content, dict) else list(content)
    except LensError as error:
        raise PosesError(f"{path}: {error}") from error
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise PosesError(
            f"{path} is damaged or not a COLMAP file ({error}); write the model again with COLMAP's model_converter"
        ) from error
    except OSError as error:
        raise PosesError(f"{path} cannot be read ({error.strerror}); correct its permissions") from error


def is_model(folder: Path) -> bool:
    """Whether a folder holds a COLMAP model: cameras and images, both .bin or both .txt."""
    return any((folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file() for s in (".bin", ".txt"))


def read_model(folder: Path) -> PoseFile:
    """Poses and lenses of a model in a topocentric frame; binary files take precedence over text, as in COLMAP."""
    suffix = _suffix(folder)
    cameras, lenses = _read(folder / f"cameras{suffix}"), dict[int, Lens]()
    path = folder / f"images{suffix}"
    poses: list[Pose] = []
    for image in _read(path):
        name = image.name
        if not np.isfinite(image.pose).all() or not np.any(image.pose[:4]):
            raise PosesError(
                f"{path}: the pose of {name} is {[float(f'{v:.6g}') for v in image.pose]}, expected a quaternion "
                "and a translation of finite numbers; correct it or remove the image from the model"
            )
        if image.camera not in cameras:
            raise PosesError(f"{path}: image {name} has camera {image.camera}, not in cameras{suffix}; save both again")
        if image.camera not in lenses:
            try:
                lenses[image.camera] = lens_of(*cameras[image.camera])
            except LensError as error:
                raise PosesError(f"{folder / f'cameras{suffix}'}: {error}") from error
        cam_from_local = rotation_from_quaternion(*image.pose[:4])
        centre = -cam_from_local.T @ np.array(image.pose[4:])
        poses.append(Pose(image.name, centre, cam_from_local, lenses[image.camera], where=str(path)))
    # From an adjustment with bent rays; where it is binary, text files are in the same folder.
    text = folder / "cameras.txt"
    is_own = text.is_file() and begins_with(text, _OWN_FIRST_WORDS)
    return PoseFile(tuple(poses), PoseFrame.LOCAL, tool=None if is_own else "COLMAP")


def read_ties(folder: Path) -> FileTies | None:
    """Points of a model with their places in its images; None without a file of points, or with an empty one."""
    path = next((folder / f"points3D{s}" for s in (".bin", ".txt") if (folder / f"points3D{s}").is_file()), None)
    points: Iterable[_Point] = () if path is None else _read(path)
    points = sorted((point for point in points if np.isfinite(point[1]).all()), key=lambda point: point[0])
    if not points:
        return None
    number, xyz, num_views = (np.array(column) for column in zip(*points, strict=True))
    images: list[_Image] = _read(folder / f"images{_suffix(folder)}")
    of_image = np.repeat(np.arange(len(images)), [len(image.point) for image in images])
    seen = np.concatenate([np.empty(0, dtype=np.int64), *(image.point for image in images)])
    pixel = np.concatenate([np.empty((0, 2)), *(image.xy for image in images)])
    at = np.searchsorted(number, seen).clip(max=len(number) - 1)
    known = (number[at] == seen) & np.isfinite(pixel).all(axis=1)
    return FileTies(xyz, num_views, tuple(image.name for image in images), at[known], of_image[known], pixel[known])


def _suffix(folder: Path) -> str:
    return ".bin" if (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file() else ".txt"


def _model_of(path: Path) -> Path | None:
    """The folder of the model that a path names: itself, or that of its images or cameras file."""
    is_file_of_it = path.suffix in (".txt", ".bin") and path.stem in ("images", "cameras")
    folder = path.parent if is_file_of_it else path
    return folder if is_model(folder) else None


FORMAT = Format(
    name="the folder of a COLMAP model (cameras and images, .txt or .bin)",
    find=lambda folder: [
        p for p in (folder, *(p for place in _PLACES for p in sorted(folder.glob(place)))) if is_model(p)
    ],
    recognises=lambda path: _model_of(path) is not None,
    read=lambda path: read_model(_model_of(path) or path),
    files=lambda path: [path.with_name(name) for name in _READERS],
    read_ties=lambda path: read_ties(_model_of(path) or path),
)
