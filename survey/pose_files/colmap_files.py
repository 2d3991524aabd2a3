"""The files of COLMAP models, text and binary, of versions 3 and 4.

The layouts are those of COLMAP's ``doc/format.rst`` and ``reconstruction_io_binary.cc``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from refract.lens import MODELS, Lens, LensError
from survey.files.csv_table import shortened

_NAME_OF_ID = {number: name for name, (number, _) in MODELS.items() if number is not None}
# Models that are the same as OPENCV_FISHEYE with fewer numbers: their id and the places of these among its own,
# fx fy cx cy k1 k2 k3 k4.
_AS_FISHEYE = {
    "SIMPLE_RADIAL_FISHEYE": (8, (0, 0, 1, 2, 3)), "RADIAL_FISHEYE": (9, (0, 0, 1, 2, 3, 4)),
    "SIMPLE_FISHEYE": (14, (0, 0, 1, 2)), "FISHEYE": (15, (0, 1, 2, 3)),
}  # fmt: skip
_FISHEYE_OF_ID = {number: name for name, (number, _) in _AS_FISHEYE.items()}
# Names of the models that are not read, so that an error can name them.
_OTHER_IDS = {
    7: ("FOV", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16), 12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5), 16: ("EUCM", 6), 17: ("EQUIRECTANGULAR", 2),
}  # fmt: skip
_CAMERA = "CAMERA"
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])


@dataclass(frozen=True, eq=False)
class Photo:
    """Image of a model."""

    number: int
    camera: int
    name: str
    pose: list[float]  # list of 7 float: quaternion (w first) and translation, from world to cam
    xy: np.ndarray  # (M, 2) float64 [px], img
    point: np.ndarray  # (M,) int64: number of the point of each feature; -1 for none


def lens_of(model: str, params: tuple[float, ...], width: int, height: int) -> Lens:
    """The lens of a camera of a model; raises LensError."""
    if model in _AS_FISHEYE and len(params) == max(_AS_FISHEYE[model][1]) + 1:
        params = tuple(params[i] for i in _AS_FISHEYE[model][1])
        return Lens("OPENCV_FISHEYE", (params + (0.0,) * 8)[:8], width, height)
    return Lens(model, params, width, height)


def cameras_txt(path: Path) -> dict[int, Lens | LensError]:
    """Lenses by the number of their camera, or why there is none: a camera may be one that no image uses."""
    lenses: dict[int, Lens | LensError] = {}
    for line in _lines(path):
        number, model, width, height, *params = line.split()
        lenses[int(number)] = _lens_or_error(model, tuple(float(p) for p in params), int(width), int(height))
    return lenses


def _lens_or_error(model: str, params: tuple[float, ...], width: int, height: int) -> Lens | LensError:
    try:
        return lens_of(shortened(model), params, width, height)
    except LensError as error:
        return error


def images_txt(path: Path) -> list[Photo]:
    """Images with their features."""
    # Every image has two lines, and the second one (its points) may be empty: never drop blank lines before
    # pairing.
    photos, lines = [], iter(path.read_text(encoding="utf-8").splitlines())
    for line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        parts = line.split(maxsplit=9)
        name = parts[9].strip()
        features = next(lines, "").split()
        if len(features) % 3:
            raise ValueError(f"the line after image {name} is not a list of points (x, y, id) and not empty")
        xy = np.array([features[0::3], features[1::3]], dtype=np.float64).T
        point = np.array(features[2::3], dtype=np.int64)
        photos.append(Photo(int(parts[0]), int(parts[8]), name, _pose_numbers(parts[1:8]), xy, point))
    return photos


def points_txt(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers (N,), coordinates (N, 3) and numbers of views (N,) of points."""
    found = []
    for line in _lines(path):
        numbers = line.split()
        if len(numbers) < 8 or len(numbers) % 2:
            raise ValueError(f"the line of point {numbers[0][:20]} has {len(numbers)} numbers")
        found.append((int(numbers[0]), [float(v) for v in numbers[1:4]], (len(numbers) - 8) // 2))
    return _points(found)


def rigs_txt(path: Path) -> dict[tuple[int, int], list[float] | None]:
    """Poses of cameras in their rig, cam from rig, by the numbers of rig and camera; None where there is none."""
    found: dict[tuple[int, int], list[float] | None] = {}
    for line in _lines(path):
        numbers = line.split()
        rig, count, at = int(numbers[0]), int(numbers[1]), 4
        if count > 0 and numbers[2] == _CAMERA:
            found[rig, int(numbers[3])] = [1.0, *[0.0] * 6]
        for _ in range(count - 1):
            kind, sensor, has_pose = numbers[at], int(numbers[at + 1]), int(numbers[at + 2])
            pose = _pose_numbers(numbers[at + 3 : at + 10]) if has_pose else None
            at += 10 if has_pose else 3
            if kind == _CAMERA:
                found[rig, sensor] = pose
    return found


def frames_txt(path: Path) -> list[tuple[int, list[float], list[tuple[int, int]]]]:
    """Number of the rig of each frame, its pose (rig from world), and the camera and image of each photograph in it."""
    found = []
    for line in _lines(path):
        numbers = line.split()
        count = int(numbers[9])
        if len(numbers) < 10 + 3 * count:
            raise ValueError(f"the line of frame {numbers[0][:20]} has {len(numbers)} words for {count} photographs")
        data = [numbers[10 + 3 * i : 13 + 3 * i] for i in range(count)]
        photos = [(int(sensor), int(image)) for kind, sensor, image in data if kind == _CAMERA]
        found.append((int(numbers[1]), _pose_numbers(numbers[2:9]), photos))
    return found


def cameras_bin(path: Path) -> dict[int, Lens | LensError]:
    """Cameras of a binary file, as `cameras_txt`."""
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    lenses: dict[int, Lens | LensError] = {}
    at = 8
    for _ in range(count):
        number, model_id, width, height = struct.unpack_from("<IiQQ", data, at)
        if model_id in _FISHEYE_OF_ID:
            model = _FISHEYE_OF_ID[model_id]
            size = max(_AS_FISHEYE[model][1]) + 1
        elif model_id in _NAME_OF_ID:
            model = _NAME_OF_ID[model_id]
            size = len(MODELS[model][1])
        elif model_id in _OTHER_IDS:
            model, size = _OTHER_IDS[model_id]
        else:
            # How long its parameters are, nobody knows: what follows cannot be read.
            return {number: Lens(f"number {model_id}", (), width, height)}  # refused there, by name
        lenses[number] = _lens_or_error(model, struct.unpack_from(f"<{size}d", data, at + 24), width, height)
        at += 24 + 8 * size
    return lenses


def images_bin(path: Path) -> list[Photo]:
    """Images of a binary file, as `images_txt`."""
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, photos = 8, []
    for _ in range(count):
        number, *pose, camera = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8")
        (num,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * num
        if at > len(data):
            raise ValueError(f"it ends after {len(data)} bytes, within the points of {name}")
        features = np.frombuffer(data, dtype=_OBSERVATION, count=num, offset=end + 9)
        photos.append(
            Photo(number, camera, name, pose, np.column_stack([features["x"], features["y"]]), features["point"])
        )
    return photos


def points_bin(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a binary file, as `points_txt`."""
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, found = 8, []
    for _ in range(count):
        number, x, y, z, *_, length = struct.unpack_from("<Q3d3BdQ", data, at)
        found.append((number, [x, y, z], length))
        at += 51 + 8 * length
    if at > len(data):
        raise ValueError(f"it ends after {len(data)} bytes, within its points")
    return _points(found)


def rigs_bin(path: Path) -> dict[tuple[int, int], list[float] | None]:
    """Rigs of a binary file, as `rigs_txt`."""
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    found: dict[tuple[int, int], list[float] | None] = {}
    for _ in range(count):
        rig, num = struct.unpack_from("<II", data, at)
        at += 8
        for i in range(num):
            kind, sensor = struct.unpack_from("<iI", data, at)
            at += 8
            pose: list[float] | None = [1.0, *[0.0] * 6]
            if i > 0:
                (has_pose,) = struct.unpack_from("<B", data, at)
                pose = list(struct.unpack_from("<7d", data, at + 1)) if has_pose else None
                at += 57 if has_pose else 1
            if kind == 0:
                found[rig, sensor] = pose
    return found


def frames_bin(path: Path) -> list[tuple[int, list[float], list[tuple[int, int]]]]:
    """Frames of a binary file, as `frames_txt`."""
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, found = 8, []
    for _ in range(count):
        _, rig, *pose, num = struct.unpack_from("<II7dI", data, at)
        at += 68
        photos = []
        for _ in range(num):
            kind, sensor, image = struct.unpack_from("<iIQ", data, at)
            at += 16
            if kind == 0:
                photos.append((sensor, image))
        found.append((rig, list(pose), photos))
    return found


def _lines(path: Path) -> Iterator[str]:
    return (line for line in path.read_text(encoding="utf-8").splitlines() if line.strip() and not line.startswith("#"))


def _pose_numbers(texts: list[str]) -> list[float]:
    """The numbers of a pose."""
    if len(texts) != 7:
        raise ValueError(f"a pose has {len(texts)} numbers, expected 7")
    return [float(text) for text in texts]


def _points(found: list) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points with finite coordinates, sorted by number."""
    found = sorted(found, key=lambda point: point[0])
    number = np.array([point[0] for point in found], dtype=np.int64)
    xyz = np.array([point[1] for point in found], dtype=np.float64).reshape(-1, 3)
    good = np.isfinite(xyz).all(axis=1)
    return number[good], xyz[good], np.array([point[2] for point in found], dtype=np.int64)[good]
