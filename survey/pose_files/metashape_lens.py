"""Lens of a sensor in XML of Metashape, as a lens of COLMAP.

Metashape counts the principal point from the middle of the image, writes p1 and p2 in the other order than OpenCV, adds
b1 to the horizontal focal length, and shears columns by b2 (its manual, Camera models).
"""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element

from refract.lens import Lens, LensError
from survey.files.csv_table import shortened
from survey.pose_files.lens_keys import require_understood

# What is read of a calibration, and when it was made.
_READ = ("resolution", "f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "date")
_FISHEYE = ("fisheye", "equidistant_fisheye", "fisheye_equidistant")
# What a fisheye lens here has no place for may move no pixel by more than this.
_LOST_PX = 0.02
_MEND = "export the cameras to COLMAP's format from Metashape (undistorted), or calibrate without it"


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
