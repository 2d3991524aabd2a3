"""Keys of foreign files that change a lens: each is read, or the file is refused, and none is passed over.

The one place for all formats: a reader names the keys that it reads, and what is left is held against this. The lens of
a Metashape sensor is read here, too.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from typing import Any
from xml.etree.ElementTree import Element

from refract.lens import Lens, LensError
from survey.files.csv_table import shortened

# Names of coefficients, what only says which lens it is, and words in the names of keys that are about a lens.
_COEFFICIENT = re.compile(r"(k|p|b|s|tau|sx|sy)_?\d{1,2}")
_LABEL = re.compile(r"(lens|camera)_(make|maker|name|serial|serial_number|id)|lens_model")
_WORDS = re.compile(
    r"fish_?eye|distort|lens|skew|shear|aspect|focal|fov|principal|ppx|ppy|^[fc]_?[xy]$|^fl_|ftheta|projection|"
    r"equirect|lat_?long|panorama|spherical|cylindrical|omnidirectional|camera_model|camera_type|prism|radial|"
    r"tangential|affin|intrinsic|rolling|shutter|decent(er|r)ing|dist_?coeff?"
)
# What is read of a calibration, and when it was made.
_READ = ("resolution", "f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "date")
_FISHEYE = ("fisheye", "equidistant_fisheye", "fisheye_equidistant")
# What a fisheye lens here has no place for may move no pixel by more than this.
_LOST_PX = 0.02
_MEND = "export the cameras to COLMAP's format from Metashape (undistorted), or calibrate without it"


def require_understood(
    values: Mapping[str, Any], known: Collection[str], *, mend: str, are_all_of_lens: bool = False
) -> None:
    """Raise LensError where a key that changes the lens is none of those that a reader knows.

    Parameters
    ----------
    values : mapping
        Keys and values of a file, or of an object in it.
    known : collection of str
        What the reader reads, and what it knows to change nothing.
    mend : str
        What to do instead, after the semicolon of the error.
    are_all_of_lens : bool
        Whether the object is that of a lens alone, so that each key is one of it; else names tell it.

    Raises
    ------
    LensError
    """
    for key, value in values.items():
        is_of_lens = are_all_of_lens or is_lens_key(key)
        if is_of_lens and key not in known and not _changes_nothing(value):
            raise LensError(
                f"{shortened(key)} is {shortened(str(value))}, a part of the lens that is not read, expected none; "
                f"{mend}"
            )


def is_lens_key(key: str) -> bool:
    """Whether the name of a key or column is that of a part of a lens."""
    name = key.casefold()
    if _LABEL.fullmatch(name):
        return False
    return _COEFFICIENT.fullmatch(name) is not None or _WORDS.search(name) is not None


def _changes_nothing(value: Any) -> bool:
    """Zero, false or empty, as a number, its text, or a list of those."""
    if isinstance(value, list | tuple):
        return all(_changes_nothing(part) for part in value)
    if isinstance(value, dict):
        return all(_changes_nothing(part) for part in value.values())
    if isinstance(value, str):
        text = value.strip().casefold()
        try:
            return all(float(word) == 0.0 for word in text.replace(",", " ").split())
        except ValueError:
            return text in ("false", "none", "null")
    return not value


def read_lens(sensor: Element) -> Lens:
    """The adjusted lens of a sensor, else the one that it began with.

    Raises
    ------
    LensError
        If there is none, it is of a kind that is not supported, or a number is not finite.
    """
    by_class = {tag.get("class", "adjusted"): tag for tag in sensor.iterfind("calibration")}
    calibration = by_class.get("adjusted", by_class.get("initial"))
    if calibration is None:
        raise LensError("there is no calibration; align the photos, and export the cameras again")
    kind = (calibration.get("type") or sensor.get("type") or "frame").casefold()
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise LensError("there is no resolution; export the cameras again")
    width, height = (_whole(size.get(key), key) for key in ("width", "height"))
    f, b1, b2 = (_number(calibration, key) for key in ("f", "b1", "b2"))
    cx, cy = 0.5 * width + _number(calibration, "cx"), 0.5 * height + _number(calibration, "cy")
    k1, k2, k3, k4 = (_number(calibration, key) for key in ("k1", "k2", "k3", "k4"))
    p1, p2 = _number(calibration, "p2"), _number(calibration, "p1")
    parts = {tag.tag: tag.text or "" for tag in calibration}
    require_understood(parts, _READ, mend=_MEND, are_all_of_lens=True)
    if kind in _FISHEYE:
        reach = math.hypot(width, height) / f if f > 0.0 else math.inf
        lost = 0.5 * abs(b2) * reach + 0.75 * f * max(abs(p1), abs(p2)) * reach**2
        if lost > _LOST_PX:
            raise LensError(
                f"p1, p2 and b2 of a fisheye lens move pixels by up to {lost:.2g} px, expected none; {_MEND}"
            )
        return Lens("OPENCV_FISHEYE", (f + b1, f, cx, cy, k1, k2, k3, k4), width, height)
    if kind != "frame":
        raise LensError(f"a lens of the type {shortened(kind)} is not supported, expected frame or fisheye; {_MEND}")
    inner = (f + b1, f, cx, cy, k1, k2, p1, p2)
    if k4 or b2:
        return Lens("BROWN_AFFINE", (*inner, k3, k4, b2 / (f + b1) if f + b1 else math.nan), width, height)
    if k3:
        return Lens("FULL_OPENCV", (*inner, k3, 0.0, 0.0, 0.0), width, height)
    return Lens("OPENCV", inner, width, height)


def _number(calibration: Element, key: str) -> float:
    """A number of a calibration; what is left out is zero."""
    text = (calibration.findtext(key) or "0").strip()
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise LensError(f"{key} is {shortened(text)}, expected a finite number; export the cameras again")
    return value


def _whole(text: str | None, key: str) -> int:
    if text is None or not text.isdecimal() or len(text) > 9:
        raise LensError(f"its {key} is {shortened(text or 'missing')}, expected whole pixels; export the cameras again")
    return int(text)
