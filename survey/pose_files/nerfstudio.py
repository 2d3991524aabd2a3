"""nerfstudio's transforms.json: poses in the frame of [local], once what its converter applied to them is undone.

And the camera paths of its viewer, once the normalisation of the poses for a training is undone.
"""

import math
from pathlib import Path

import numpy as np

from refract.lens import Lens, LensError
from survey.errors import PosesError
from survey.files.foreign_text import finite_number, finite_numbers, read_foreign_json
from survey.files.paths import begins_with
from survey.photos.exif import SUFFIXES
from survey.photos.pixels import open_image, stored_size
from survey.photos.poses import Pose, PoseFile, PoseFrame, is_rotation, nearest_rotation
from survey.pose_files.format import Format, brown_lens, lens_number, lens_size, require_understood

_NAME = "transforms.json"
_EXPORT = "write it again with ns-process-data"
# Beside the settings of a training: saved = scale * (transform @ original).
_NORMALISATION = "dataparser_transforms.json"
# Matrices are written with seven digits at least.
_ROUNDED = 1e-4
# From cameras of computer graphics (x right, y up, z back) to ours.
_CAM_FROM_GRAPHICS = np.diag([1.0, -1.0, -1.0])
_SUPPORTED = ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE")
# What says how long the focal length is, along each side.
_FOCALS = (("fl_x", "camera_angle_x", "x_fov"), ("fl_y", "camera_angle_y", "y_fov"))
# What is read of a lens.
_READ = (
    "camera_model", "is_fisheye", "w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2",
    "camera_angle_x", "camera_angle_y", "x_fov", "y_fov",
)  # fmt: skip
_REMEDY = "undistort the photographs, or export OPENCV or OPENCV_FISHEYE"


def read_nerfstudio(path: Path) -> PoseFile:
    """Poses and lenses of the frames."""
    data = read_foreign_json(path, PosesError)
    if is_camera_path := isinstance(data, dict) and "camera_path" in data:
        data = _as_frames(path, data)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise PosesError(f"{path} has no list of frames, expected that of nerfstudio; {_EXPORT}")
    # What the converter did: saved = scale * (rotation @ original + shift).
    given = data.get("applied_transform", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])
    applied, scale = _matrix(given, 3), finite_number(data.get("applied_scale", 1.0))
    if applied is None or not is_rotation(applied[:, :3], _ROUNDED):
        raise PosesError(f"{path}: applied_transform is not a 3 x 4 matrix of a rotation and a shift; {_EXPORT}")
    if scale is None or scale <= 0.0:
        raise PosesError(f"{path}: applied_scale is {scale}, expected a number above 0; {_EXPORT}")
    turn, shift = applied[:, :3], applied[:, 3]
    poses: list[Pose] = []
    for frame in frames:
        name = frame.get("file_path")
        if not isinstance(name, str) or not name:
            raise PosesError(f"{path}: a frame has no file_path, expected the name of its image; {_EXPORT}")
        where = f"{path}, frame {name}"
        try:
            # Of the frame, else of the root; a focal length of the frame leaves no other one of the root.
            own = {key for keys in _FOCALS for key in keys if any(key in frame for key in keys)}
            values = {**{key: value for key, value in data.items() if key not in own}, **frame}
            lens = _lens(values if {"w", "h"} & values.keys() else values | _size_of_photograph(path, name))
        except LensError as error:
            raise PosesError(f"{where}: {error}") from error
        saved_from_cam = _matrix(frame.get("transform_matrix"), 4)
        if saved_from_cam is None or not np.array_equal(saved_from_cam[3], [0.0, 0.0, 0.0, 1.0]):
            raise PosesError(f"{where}: its transform_matrix is not a 4 x 4 matrix of a pose; {_EXPORT}")
        rotation, centre = saved_from_cam[:3, :3], turn.T @ (saved_from_cam[:3, 3] / scale - shift)
        if not is_rotation(rotation, _ROUNDED):
            raise PosesError(f"{where}: its transform_matrix is not a rotation and a position; {_EXPORT}")
        poses.append(Pose(name, centre, _CAM_FROM_GRAPHICS @ (turn.T @ nearest_rotation(rotation)).T, lens))
    notes = () if "applied_transform" in data else (
        f"{path.name} has no applied_transform: its axes are taken as those of [local]",
    )  # fmt: skip
    tool = "the program behind nerfstudio"
    masks, local = _masks(path, frames), PoseFrame.LOCAL
    return PoseFile(tuple(poses), local, None, tool, masks, notes, is_camera_path=is_camera_path)


def _as_frames(path: Path, data: dict) -> dict:
    """A camera path as a transforms.json, with the normalisation in the same folder as what was applied."""
    beside, views = path.with_name(_NORMALISATION), data["camera_path"]
    if not beside.is_file():
        raise PosesError(
            f"{path} is a camera path, in the normalised frame of a training; copy {_NORMALISATION} of that training "
            "from the folder of its config.yml into the folder of the path"
        )
    given, kind = read_foreign_json(beside, PosesError), data.get("camera_type", "perspective")
    if not isinstance(views, list) or not all(isinstance(each, dict) for each in (given, *views)):
        raise PosesError(f"{path} has no list of cameras, or {beside} no transform; save them again with nerfstudio")
    if _matrix(given.get("transform"), 3) is None or not (finite_number(given.get("scale")) or 0.0) > 0.0:
        raise PosesError(
            f"{beside} has a transform of {given.get('transform')!r:.60} and a scale of {given.get('scale')!r:.20}, "
            "expected a 3 x 4 matrix and a number above 0; copy it again from the folder of the training"
        )
    fovs = [finite_number(view.get("fov")) or 0.0 for view in views]
    if not all(0.0 < fov < 180.0 for fov in fovs):
        raise PosesError(
            f"{path} has a fov of {min(fovs):g} degrees, expected one between 0 and 180 at each camera; save the path "
            "again with nerfstudio's viewer"
        )
    frames = [
        {
            "file_path": f"view{number:04d}",
            "transform_matrix": view.get("camera_to_world"),
            # Of the height of the picture; pixels are square.
            "camera_angle_y": math.radians(fov),
        }
        for number, (view, fov) in enumerate(zip(views, fovs, strict=True))
    ]
    lens = {"camera_model": "PINHOLE" if kind == "perspective" else kind}
    lens |= {"w": data.get("render_width"), "h": data.get("render_height")}
    return {"frames": frames, **lens, "applied_transform": given.get("transform"), "applied_scale": given.get("scale")}


def _matrix(value, num_rows: int) -> np.ndarray | None:
    """(rows, 4) finite numbers; None for anything else. A pose may be without its last row, or row after row."""
    if not isinstance(value, list):
        return None
    if len(value) == 16:
        value = [value[first : first + 4] for first in range(0, 16, 4)]
    rows = [finite_numbers(row, 4) for row in value]
    if num_rows == 4 and len(rows) == 3:
        rows.append([0.0, 0.0, 0.0, 1.0])
    return None if len(rows) != num_rows or None in rows else np.array(rows, dtype=np.float64)


def _size_of_photograph(path: Path, name: str) -> dict[str, int]:
    """Its width and height, as files of Blender and instant-ngp that have an angle alone leave them to the photograph.

    LensError where it is not beside the file.
    """
    found = next((p for ending in ("", *SUFFIXES) if (p := path.parent / f"{name}{ending}").is_file()), None)
    if found is None:
        raise LensError("w and h are missing, and no photograph of that name is below the file; write them into it")
    with open_image(found) as image:
        width, height = stored_size(image)
    return {"w": width, "h": height}


def _lens(values: dict) -> Lens:
    """The lens of a frame, from its own numbers or those of all; k3 and k4 of OPENCV are powers of the radius."""
    model = str(values.get("camera_model", "OPENCV"))
    require_understood(values, _READ, remedy=_REMEDY)
    if values.get("is_fisheye"):
        # instant-ngp's word: k1 to k4 are then of the angle.
        if "camera_model" in values and model != "OPENCV_FISHEYE":
            raise LensError(f"is_fisheye is true, and camera_model is {model}; keep one of the two")
        model = "OPENCV_FISHEYE"
    if model not in _SUPPORTED:
        raise LensError(f"camera model {model} is not supported, expected one of {', '.join(_SUPPORTED)}")
    size = width, height = lens_size(values, "w", "h")
    angles = [finite_number(values.get(key)) or 0.0 for key in ("camera_angle_x", "camera_angle_y")]
    by_angle = [
        0.5 * side / math.tan(0.5 * angle) if 0.0 < angle < math.pi else None
        for side, angle in zip(size, angles, strict=True)
    ]
    fx = lens_number(values, "fl_x", by_angle[0] or by_angle[1])
    fy = lens_number(values, "fl_y", by_angle[1] or fx)
    cx, cy = lens_number(values, "cx", 0.5 * width), lens_number(values, "cy", 0.5 * height)
    k1, k2, k3, k4, p1, p2 = (lens_number(values, key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model == "OPENCV_FISHEYE":
        return Lens(model, (fx, fy, cx, cy, k1, k2, k3, k4), *size)
    return brown_lens((fx, fy, cx, cy, k1, k2, p1, p2), size, k3=k3, k4=k4)


def _masks(path: Path, frames: list[dict]) -> Path | None:
    """The folder of the masks of the frames, if it lies below that of the file."""
    masks = [mask for frame in frames if isinstance(mask := frame.get("mask_path"), str) and "\0" not in mask]
    if not masks:
        return None
    folder, root = (path.parent / masks[0]).parent.resolve(), path.parent.resolve()
    return folder if folder.is_relative_to(root) and folder.is_dir() else None


def is_nerfstudio(path: Path) -> bool:
    """Whether a path is an object in JSON, by its first character."""
    return path.is_file() and path.suffix.casefold() == ".json" and begins_with(path, b"{")


FORMAT = Format(
    name="nerfstudio's transforms.json or camera path",
    find=lambda folder: [folder / _NAME] if (folder / _NAME).is_file() else [],
    recognises=is_nerfstudio,
    read=read_nerfstudio,
)
