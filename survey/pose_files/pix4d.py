"""Pix4D's calibrated cameras: full positions and angles in one file, lens and local positions in another.

The local positions lack an offset, which lies in a third file; the map of all is that of a fourth. Radial and
tangential coefficients have OpenCV's order and sense.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.crs import has_height, horizontal_crs, horizontal_unit
from refract.lens import LensError
from survey.errors import PosesError
from survey.files.csv_table import text_lines
from survey.files.foreign_text import crs_of_text
from survey.photos import poses as pose_data
from survey.pose_files.format import Format, brown_lens, numbers_in

_EXTERNAL, _CAMERAS = "_calibrated_external_camera_parameters.txt", "_calibrated_camera_parameters.txt"
_OFFSET, _MAP = "_offset.xyz", "_wkt.prj"
_PLACES = (".", "params", "1_initial/params")
# In the head of a file of cameras whose lens is not that of a matrix, radial and tangential coefficients.
_OTHER_LENSES = ("fisheye", "affine", "polynomial", "spherical")
_LAST_OF_HEAD, _LINES_OF_IMAGE = "camera model", 10
_AGREE = 1e-3
_EXPORT = "export it again in Pix4D (1. Initial Processing > Calibration > Camera Internals and Externals)"


def read_pix4d(path: Path) -> pose_data.PoseFile:
    """Poses in crs, with lenses where the file of cameras is there."""
    path = _files_in(path)[0] if path.is_dir() else path
    stem = _stem(path)
    cameras_path, external_path = (path.with_name(stem + ending) for ending in (_CAMERAS, _EXTERNAL))
    cameras = _cameras(cameras_path) if cameras_path.is_file() else {}
    crs = _crs(path.with_name(stem + _MAP))
    if external_path.is_file():
        poses = list(_external(external_path, cameras))
    else:
        offset = _offset(path.with_name(stem + _OFFSET), path)
        poses = [replace(pose, centre=pose.centre + offset) for pose in cameras.values()]
    notes: tuple[str, ...] = ()
    unit_m = None
    if crs is not None:
        # Pix4D has one unit for all three coordinates.
        unit_m = None if has_height(crs) or not crs.is_projected else horizontal_unit(crs)
        heights = "" if unit_m is None else f", its heights in {horizontal_crs(crs).axis_info[0].unit_name}"
        notes = (f"the poses are in {crs.name}{heights}, as {stem}{_MAP} says",)
    return pose_data.PoseFile(tuple(poses), pose_data.PoseFrame.GRID, crs, "Pix4D", notes=notes, height_unit_m=unit_m)


def _external(path: Path, cameras: Mapping[str, pose_data.Pose]) -> Iterator[pose_data.Pose]:
    """The pose of each image; names may hold spaces."""
    for number, line in text_lines(path, PosesError):
        where, cells = f"{path}, line {number}", line.split()
        if not cells or cells[0].casefold() == "imagename":
            continue
        if len(cells) < 7:
            raise PosesError(f"{where}: {len(cells)} values were found, expected a name and six numbers; {_EXPORT}")
        name, numbers = line.strip().rsplit(None, 6)[0], numbers_in(cells[-6:], 6, where, _EXPORT)
        cam_from_grid = (pose_data.grid_from_opk(*map(math.radians, numbers[3:])) @ pose_data.CAM_FROM_OPK_CAM).T
        camera = cameras.get(name)
        if camera is not None and not np.abs(cam_from_grid - camera.cam_from_world).max() < _AGREE:
            raise PosesError(
                f"{where}: the angles of {name} are not those of its rotation in the file of cameras, expected "
                f"both of one project; {_EXPORT}"
            )
        yield pose_data.Pose(name, np.array(numbers[:3]), cam_from_grid, None if camera is None else camera.lens)


def _cameras(path: Path) -> dict[str, pose_data.Pose]:
    """Poses and lenses of a file of cameras by the names of their images; positions lack the offset."""
    found: dict[str, pose_data.Pose] = {}
    lines = [(f"{path}, line {number}", line.strip()) for number, line in text_lines(path, PosesError)]
    head = next((i for i, (_, line) in enumerate(lines) if line.startswith(_LAST_OF_HEAD)), None)
    if head is None:
        raise PosesError(f'{path} has no line "{_LAST_OF_HEAD} ...", expected cameras of Pix4D; {_EXPORT}')
    for where, line in lines[: head + 1]:
        if any(word in line.casefold() for word in _OTHER_LENSES):
            raise PosesError(f'{where}: "{line}" is of another lens, expected a perspective one; {_EXPORT}')
    lines = [(where, line) for where, line in lines[head + 1 :] if line]
    for first in range(0, len(lines), _LINES_OF_IMAGE):
        block = lines[first : first + _LINES_OF_IMAGE]
        where, title = block[0]
        if len(block) < _LINES_OF_IMAGE:
            raise PosesError(f"{where}: {len(block)} lines of an image, expected {_LINES_OF_IMAGE}; {_EXPORT}")
        pose = _camera(where, title, [line for _, line in block])
        found[pose.name] = pose
    return found


def _camera(where: str, title: str, lines: list[str]) -> pose_data.Pose:
    name, *size = title.rsplit(None, 2)
    if len(size) != 2 or not all(text.isdecimal() and len(text) < 10 for text in size):
        raise PosesError(f'{where}: "{title}" was found, expected a name, width and height; {_EXPORT}')
    rows = [numbers_in(line.split(), 2 if i == 4 else 3, where, _EXPORT) for i, line in enumerate(lines[1:])]
    inner, (k1, k2, k3), (p1, p2), local, rotation = (rows[:3], rows[3], rows[4], np.array(rows[5]), np.array(rows[6:]))
    if not pose_data.is_rotation(rotation, _AGREE) or inner[0][1] != 0.0 or inner[2] != [0.0, 0.0, 1.0]:
        raise PosesError(f"{where}: its matrices are not a rotation and a camera without skew; {_EXPORT}")
    params = (inner[0][0], inner[1][1], inner[0][2], inner[1][2], k1, k2, p1, p2)
    try:
        lens = brown_lens(params, (int(size[0]), int(size[1])), k3=k3)
    except LensError as error:
        raise PosesError(f"{where}: {error}") from error
    return pose_data.Pose(name, local, pose_data.nearest_rotation(rotation), lens)


def _offset(path: Path, wanted_by: Path) -> np.ndarray:
    if not path.is_file():
        raise PosesError(f"{wanted_by} lacks the offset in {path.name}; put that beside it, or *{_EXTERNAL} instead")
    cells = [cell for _, line in text_lines(path, PosesError) for cell in line.split()]
    return np.array(numbers_in(cells, 3, str(path), _EXPORT))


def _crs(path: Path) -> CRS | None:
    if not path.is_file():
        return None
    text = " ".join(line for _, line in text_lines(path, PosesError))
    return crs_of_text(text, str(path), "correct or remove it", PosesError)


def _stem(path: Path) -> str:
    """The name of the project."""
    return path.name.removesuffix(_EXTERNAL).removesuffix(_CAMERAS)


def _files_in(folder: Path) -> list[Path]:
    """The file of positions of each project in a folder, or in the params folder of Pix4D below it."""
    found: dict[str, Path] = {}
    for place in _PLACES:
        for ending in (_EXTERNAL, _CAMERAS):
            for path in sorted((folder / place).glob(f"*{ending}")):
                found.setdefault(path.name.removesuffix(ending), path)
    return list(found.values())


def is_pix4d(path: Path) -> bool:
    """Whether a path is one of the two files of cameras, or a folder that has them."""
    if path.is_dir():
        return len(_files_in(path)) == 1
    return path.name.endswith((_EXTERNAL, _CAMERAS))


FORMAT = Format(
    name="the calibrated camera parameters of Pix4D (params/..._calibrated_external_camera_parameters.txt)",
    find=_files_in,
    recognises=is_pix4d,
    read=read_pix4d,
    files=lambda path: [path.with_name(_stem(path) + ending) for ending in (_EXTERNAL, _CAMERAS, _OFFSET, _MAP)],
)
