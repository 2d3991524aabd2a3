"""XMP of a photograph: accuracy and datum of the position, attitudes of drone and camera, speed, shutter.

DJI, Parrot, Autel and Skydio have their own namespaces; senseFly, Parrot, older Autel and many others use that of
Pix4D, `Camera`; programs that rewrite XMP put the position into that of EXIF. The text is searched, not parsed as XML,
so that there are no entities to expand, and damaged XMP loses only the damaged values.
"""

import math
import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

_DJI, _AUTEL, _PARROT, _PIX4D, _SKYDIO, _EXIF = "drone-dji", "drone", "drone-parrot", "Camera", "drone-skydio", "exif"
# Namespaces by a part of their address, whatever prefix a program uses.
_ADDRESSES = {
    "drone-dji": _DJI, "autel": _AUTEL, "drone-parrot": _PARROT, "pix4d.com/camera": _PIX4D, "skydio": _SKYDIO,
}  # fmt: skip
_AXES = ("Yaw", "Pitch", "Roll")
# The address must end here: that of lenses continues (aux/).
_ADOBE_EXIF = "ns.adobe.com/exif/1.0/"
_PREFIX = re.compile(r"xmlns:([\w-]{1,40})\s*=\s*[\"']([^\"'<>]{1,200})[\"']")
# Degrees, minutes and perhaps seconds, with the hemisphere behind them.
_ANGLE = re.compile(r"(\d{1,3}),(\d{1,2}(?:\.\d*)?)(?:,(\d{1,2}(?:\.\d*)?))?([NSEWnsew])")
# XML allows both quotes.
_VALUE = r"(?<![\w-]){}:{}\s{{0,40}}(?:=\s{{0,40}}[\"']|>)\s{{0,40}}([^\"'<]{{1,60}})[\"'<]"
_NUMBER = re.compile(r"[+-]?[0-9.]+(?:[eE][+-]?[0-9]{1,3})?")
# As of EXIF or ISO 8601, to a microsecond.
_UTC = re.compile(r"(\d{4})[:-](\d\d)[:-](\d\d)[T ](\d\d:\d\d:\d\d)(\.\d{1,6})?\d*(?:Z|\+00:00)?")
_MECHANICAL = re.compile(r"drone-dji:ShutterType\s*(?:=\s*[\"']|>)\s*mechanical", re.IGNORECASE)
# No receiver is this wrong and still reports a standard deviation; files without one have 0, or a filler.
_MOST_STD_M = 100.0
# Nearer to the vertical than this sine, the camera's yaw and roll turn about the same axis.
_VERTICAL = 1.0 - 1e-12
ELLIPSOIDAL = "ellipsoidal"
SEA_LEVEL = "mean sea level"
_ELLIPSOIDS = ("ELLIPSOID", "EPSG:4326", "EPSG:4979", "EPSG:6318", "EPSG:6319")


@dataclass(frozen=True)
class Rtk:
    """Accuracy of a position by DJI's receiver."""

    flag: int  # 0 no position, 16 single, 32 to 49 float, 50 fixed
    std_m: tuple[float, float, float]  # (east, north, up) [m]: all above zero


@dataclass(frozen=True)
class Motion:
    """Attitude, speed and shutter at an exposure; None where XMP does not have them."""

    # (yaw, pitch, roll) [deg] or None: of the camera: turned in this order from north, east, down; yaw from true north.
    # With the pitch -90 it looks straight down.
    gimbal_deg: tuple[float, float, float] | None = None
    # (east, north, up) [m/s] or None: over ground. XMP counts it north, east, down.
    velocity: tuple[float, float, float] | None = None
    is_mechanical: bool = False  # Whether the shutter is said to be mechanical: all rows are then exposed at once


def rtk_of(xmp: str) -> Rtk | None:
    """The accuracy of the position, where DJI's XMP has a flag and three standard deviations."""
    flag, std = xmp_number(xmp, "RtkFlag"), _three(xmp, _DJI, "RtkStdLon", "RtkStdLat", "RtkStdHgt")
    if flag is None or not abs(flag) < 1000.0 or std is None or not all(0.0 < s <= _MOST_STD_M for s in std):
        return None
    return Rtk(int(flag), std)


def stated_std(xmp: str) -> tuple[float, float, float] | None:
    """Standard deviation of the position, (east, north, up) [m], where XMP has both in the namespace of Pix4D."""
    across, up = (_number_in(xmp, _PIX4D, name) for name in ("GPSXYAccuracy", "GPSZAccuracy"))
    if across is None or up is None or not (0.0 < across <= _MOST_STD_M and 0.0 < up <= _MOST_STD_M):
        return None
    return across, across, up


def height_datum(xmp: str) -> str | None:
    """Vertical datum in XMP: "ellipsoidal", a name such as "EGM96", or None where it has none.

    DJI's receivers with corrections give heights above the ellipsoid (AltitudeType RtkAlt).
    """
    is_rtk = _text_in(xmp, _DJI, "AltitudeType") == "RtkAlt"
    datum = _text_in(xmp, "CRSInfo", "VERTCRS") or _text_in(xmp, _PIX4D, "VertCS")
    return ELLIPSOIDAL if is_rtk or (datum and datum.upper().startswith(_ELLIPSOIDS)) else datum


def horizontal_datum(xmp: str) -> str:
    """Horizontal datum in XMP, e.g. "EPSG:4326"; empty where it has none."""
    return _text_in(xmp, "CRSInfo", "HORIZCRS") or _text_in(xmp, _PIX4D, "HorizCS") or ""


def with_known_prefixes(xmp: str) -> str:
    """XMP with the prefixes that namespaces have here, where a program gave them others."""
    for prefix, address in _PREFIX.findall(xmp):
        named = next((name for part, name in _ADDRESSES.items() if part in address.lower()), prefix)
        known = _EXIF if address.lower().endswith(_ADOBE_EXIF) else named
        if known != prefix:
            xmp = re.sub(rf"(?<![\w-]){re.escape(prefix)}:(?=\w)", f"{known}:", xmp)
    return xmp


def xmp_place(xmp: str) -> tuple[tuple[float, float, float], float] | None:
    """The position in XMP, by a drone or as programs rewrite it, and the step [deg] of its last digit; None for none.

    Latitude, longitude [deg] and height [m], NaN where there is none, of unknown datum as those of EXIF.
    Older firmware of DJI spells the longitude GpsLongtitude. A receiver without a fix writes 0, 0.
    """
    latitude, longitude = (
        next((text for space, name in names if (text := _text_in(xmp, space, name))), "")
        for names in (
            ((_DJI, "GpsLatitude"), (_AUTEL, "GpsLatitude"), (_SKYDIO, "Latitude")),
            ((_DJI, "GpsLongitude"), (_DJI, "GpsLongtitude"), (_AUTEL, "GpsLongitude"), (_SKYDIO, "Longitude")),
        )
    )
    if _NUMBER.fullmatch(latitude) and _NUMBER.fullmatch(longitude):
        height = xmp_number(xmp, "AbsoluteAltitude")
        height = _number_in(xmp, _SKYDIO, "AbsoluteAltitude") if height is None else height
        digits = min(len(text.partition(".")[2]) for text in (latitude, longitude))
        lat, lon, step = number(latitude), number(longitude), 10.0**-digits
    else:
        north, east = (_ANGLE.fullmatch(_text_in(xmp, _EXIF, f"GPS{name}") or "") for name in ("Latitude", "Longitude"))
        if north is None or east is None or north[4] not in "NSns" or east[4] not in "EWew":
            return None
        height = _number_in(xmp, _EXIF, "GPSAltitude")
        if height is not None and _text_in(xmp, _EXIF, "GPSAltitudeRef") in ("1", "3"):
            height = -abs(height)
        steps = [10.0 ** -len((a[3] or a[2]).partition(".")[2]) / (3600.0 if a[3] else 60.0) for a in (north, east)]
        lat, lon, step = _degrees(north), _degrees(east), max(steps)
    is_fix = (lat != 0.0 or lon != 0.0) and abs(lat) <= 90.0 and abs(lon) <= 180.0
    return ((lat, lon, math.nan if height is None else height), step) if is_fix else None


def _degrees(angle: re.Match[str]) -> float:
    """Degrees of a position in the namespace of EXIF: "47,52.1234N"."""
    size = float(angle[1]) + float(angle[2]) / 60.0 + float(angle[3] or 0.0) / 3600.0
    return -size if angle[4] in "SsWw" else size


def exposure_time(xmp: str) -> datetime | None:
    """The time of the exposure in UTC by DJI's XMP (UTCAtExposure), with its fraction; None where there is none."""
    found = _UTC.fullmatch(_text_in(xmp, _DJI, "UTCAtExposure") or "")
    if found is None:
        return None
    try:
        return datetime.fromisoformat("{}-{}-{} {}{}".format(*found.groups(""))).replace(tzinfo=UTC)
    except ValueError:
        return None


def motion_of(xmp: str) -> Motion:
    """Attitude, speed and shutter, as far as XMP has them, whichever maker has written them."""
    spaces = ((_DJI, "Gimbal"), (_AUTEL, "Gimbal"), (_PARROT, "Camera"))
    sets = (_three(xmp, space, *(f"{name}{axis}Degree" for axis in _AXES)) for space, name in spaces)
    gimbal = next((each for each in sets if each is not None), None)
    frame, speed = _three(xmp, _PIX4D, *_AXES), _three(xmp, _DJI, "FlightYSpeed", "FlightXSpeed", "FlightZSpeed")
    return Motion(
        gimbal_deg=gimbal_from_pix4d(*frame) if gimbal is None and frame is not None else gimbal,
        velocity=None if speed is None else (speed[0], speed[1], 0.0 - speed[2]),
        is_mechanical=_MECHANICAL.search(xmp) is not None,
    )


def gimbal_from_pix4d(yaw: float, pitch: float, roll: float) -> tuple[float, float, float]:
    """Yaw, pitch, roll [deg] of a camera as Pix4D counts them, as those of a gimbal.

    Pix4D turns a frame whose camera looks down with the top of the image forward, a gimbal one whose camera looks
    forward: all zero here is a pitch of -90 there.
    """
    down = Rotation.from_matrix([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    turned = (Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True) * down).as_matrix()
    sine = float(np.clip(-turned[2, 0], -1.0, 1.0))
    if abs(sine) > _VERTICAL:
        return math.degrees(math.atan2(-turned[0, 1], turned[1, 1])), math.copysign(90.0, sine), 0.0
    angles = ((turned[1, 0], turned[0, 0]), (sine, math.sqrt(1.0 - sine**2)), (turned[2, 1], turned[2, 2]))
    y, p, r = (math.degrees(math.atan2(*pair)) for pair in angles)
    return y, p, r


def xmp_number(xmp: str, name: str) -> float | None:
    """A finite number in the namespace of DJI, else of Autel, which has the same names; None where there is none."""
    found = _number_in(xmp, _DJI, name)
    return _number_in(xmp, _AUTEL, name) if found is None else found


def serial_of(xmp: str) -> str:
    """The serial number of the camera by DJI or Parrot; empty where there is none."""
    names = ((_DJI, "CameraSerialNumber"), (_PARROT, "SerialNumber"))
    return next((text for space, name in names if (text := _text_in(xmp, space, name))), "")


def _three(xmp: str, namespace: str, *names: str) -> tuple[float, float, float] | None:
    a, b, c = (_number_in(xmp, namespace, name) for name in names)
    return None if a is None or b is None or c is None else (a, b, c)


def _number_in(xmp: str, namespace: str, name: str) -> float | None:
    """A finite number, as an attribute or an element; a fraction, as Parrot writes them, is divided."""
    parts = (_text_in(xmp, namespace, name) or "").split("/")
    values = [number(part) if _NUMBER.fullmatch(part) else math.nan for part in parts]
    value = values[0] if len(values) == 1 else values[0] / values[1] if len(values) == 2 and values[1] else math.nan
    return value if math.isfinite(value) else None


def _text_in(xmp: str, namespace: str, name: str) -> str | None:
    found = re.search(_VALUE.format(namespace, name), xmp)
    return found.group(1).strip() if found else None


def number(value: Any) -> float:
    """A value of EXIF or XMP as a number; NaN where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return math.nan
