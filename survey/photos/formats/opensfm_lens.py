"""The lens of a camera in OpenSfM's JSON, in pixels from the upper left corner."""

from __future__ import annotations

from refract.lens import Lens, LensError
from survey.files.csv_table import shortened
from survey.files.json_values import finite_number
from survey.photos.formats.lens_keys import require_understood

# The parameters of each projection besides focal lengths and principal point, in the order of our model.
_BROWN = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE = ("k1", "k2", "k3", "k4")
_COMMON = ("projection_type", "width", "height", "focal", "focal_x", "focal_y", "c_x", "c_y")
_SUPPORTED = ("perspective", "simple_radial", "radial", "brown", "fisheye", "fisheye_opencv")


def read_lens(camera: dict) -> Lens:
    """The lens of a camera, whose lengths are in units of the longer side of its image, from the middle of that.

    Raises
    ------
    LensError
        If its projection is not supported, or a number is missing or not finite.
    """
    kind = str(camera.get("projection_type", "perspective"))
    if kind not in _SUPPORTED:
        raise LensError(
            f"the projection {shortened(kind)} is not supported, expected one of {', '.join(_SUPPORTED)}; reconstruct "
            "with one of these, e.g. --camera-lens brown in OpenDroneMap"
        )
    # What the camera began with changes nothing.
    lens = {key: value for key, value in camera.items() if not key.endswith("_prior")}
    known = (*_COMMON, *(_FISHEYE if kind.startswith("fisheye") else _BROWN))
    require_understood(lens, known, mend="reconstruct with --camera-lens brown or fisheye", are_all_of_lens=True)
    width, height = (_number(camera, key) for key in ("width", "height"))
    if not (width.is_integer() and height.is_integer()):
        raise LensError(f"the image has {width:g} x {height:g} pixels, expected whole numbers; correct it")
    longer = max(width, height)
    fx, fy = (longer * _number(camera, key if key in camera else "focal") for key in ("focal_x", "focal_y"))
    cx, cy = (longer * _number(camera, key, 0.0) + 0.5 * side for key, side in (("c_x", width), ("c_y", height)))
    if kind.startswith("fisheye"):
        coefficients = [_number(camera, key, 0.0) for key in _FISHEYE]
        return Lens("OPENCV_FISHEYE", (fx, fy, cx, cy, *coefficients), int(width), int(height))
    k1, k2, p1, p2, k3 = (_number(camera, key, 0.0) for key in _BROWN)
    if k3 == 0.0:
        return Lens("OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2), int(width), int(height))
    return Lens("FULL_OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0), int(width), int(height))


def _number(camera: dict, key: str, default: float | None = None) -> float:
    found = finite_number(camera.get(key, default))
    if found is None:
        raise LensError(f"{key} is {shortened(str(camera.get(key)))}, expected a finite number; correct it")
    return found
