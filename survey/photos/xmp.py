"""What DJI's XMP says of an exposure: accuracy of the position, attitudes of drone and gimbal, speed, shutter."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

_DJI_NUMBER = r"drone-dji:{}\s*(?:=\s*\"|>)\s*([+-]?[0-9.]+)"
_MECHANICAL = re.compile(r"drone-dji:ShutterType\s*(?:=\s*\"|>)\s*mechanical", re.IGNORECASE)
# No receiver is this wrong and still reports a standard deviation; files without one have 0, or a filler.
_MOST_STD_M = 100.0


@dataclass(frozen=True)
class Rtk:
    """Accuracy of a position by the receiver.

    Attributes
    ----------
    flag : int
        0 no position, 16 single, 32 to 49 float, 50 fixed.
    std_m : (east, north, up) [m]
        All above zero.
    """

    flag: int
    std_m: tuple[float, float, float]


@dataclass(frozen=True)
class Motion:
    """Attitudes, speed and shutter at an exposure; None where XMP does not have them.

    Attributes
    ----------
    gimbal_deg, flight_deg : (yaw, pitch, roll) [deg] or None
        Of the camera and of the drone: turned in this order from north, east, down; yaw from true north. A camera
        with the pitch -90 looks straight down.
    speed : (east, north, up) [m/s] or None
        Over ground. XMP counts it north, east, down.
    is_mechanical : bool
        Whether the shutter is said to be mechanical: all rows are then exposed at once.
    """

    gimbal_deg: tuple[float, float, float] | None = None
    flight_deg: tuple[float, float, float] | None = None
    speed: tuple[float, float, float] | None = None
    is_mechanical: bool = False


def rtk_of(xmp: str) -> Rtk | None:
    """The accuracy of the position, where XMP has a flag and three standard deviations."""
    flag = xmp_number(xmp, "RtkFlag")
    std = _three(xmp, "RtkStdLon", "RtkStdLat", "RtkStdHgt")
    if flag is None or not abs(flag) < 1000.0 or std is None or not all(0.0 < s <= _MOST_STD_M for s in std):
        return None
    return Rtk(int(flag), std)


def motion_of(xmp: str) -> Motion:
    """Attitudes, speed and shutter, as far as XMP has them."""
    speed = _three(xmp, "FlightYSpeed", "FlightXSpeed", "FlightZSpeed")
    return Motion(
        gimbal_deg=_three(xmp, "GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"),
        flight_deg=_three(xmp, "FlightYawDegree", "FlightPitchDegree", "FlightRollDegree"),
        speed=None if speed is None else (speed[0], speed[1], 0.0 - speed[2]),
        is_mechanical=_MECHANICAL.search(xmp) is not None,
    )


def xmp_number(xmp: str, name: str) -> float | None:
    """A finite number in the namespace drone-dji, as an attribute or an element; None where there is none."""
    found = re.search(_DJI_NUMBER.format(name), xmp)
    value = number(found.group(1)) if found else math.nan
    return value if math.isfinite(value) else None


def _three(xmp: str, *names: str) -> tuple[float, float, float] | None:
    a, b, c = (xmp_number(xmp, name) for name in names)
    return None if a is None or b is None or c is None else (a, b, c)


def number(value: Any) -> float:
    """A value of EXIF or XMP as a number; NaN where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan
