"""Metadata of a photograph: size, position, focal length, time; from EXIF and DJI's XMP, by Pillow."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from PIL import ExifTags

from geo.crs import utm_code
from survey.errors import ImageError
from survey.photos.opening import open_image

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")

# Width of the film that "focal length in 35 mm film" refers to [mm].
_FILM_WIDTH_MM = 36.0
# A calibration further off the 35 mm equivalent than this belongs to another size of the image.
_RESIZED = 1.5
_DJI_NUMBER = r"drone-dji:{}\s*(?:=\s*\"|>)\s*([+-]?[0-9.]+)"


@dataclass(frozen=True)
class Exif:
    """Head of an image file.

    Attributes
    ----------
    size_px : (width, height)
        As stored, without the rotation in `orientation`.
    lat_lon_height : (latitude [deg], longitude [deg], height [m]) or None
        GPS position, WGS 84; the height is NaN where the file has none. Its vertical datum is not known.
    focal_px : float or None
        Focal length [px] of the stored size, from the 35 mm equivalent or DJI's calibration (a design value).
    orientation : int
        1 where the image is stored upright.
    camera : str
        Maker and model.
    above_start_m : float or None
        DJI's height over the take-off point [m].
    taken : datetime or None
        In UTC: of the GPS clock, else of the camera's with its offset; None where neither is there.
    """

    size_px: tuple[int, int]
    lat_lon_height: tuple[float, float, float] | None
    focal_px: float | None
    orientation: int
    camera: str
    above_start_m: float | None
    taken: datetime | None = None


def read_exif(path: Path) -> Exif:
    """Read the head of an image; the pixels are not decoded.

    Raises
    ------
    ImageError
        Where the file is no image, or one that is too large for this machine.
    """
    with open_image(path) as image:
        try:
            size, exif, xmp = image.size, image.getexif(), image.info.get("xmp", b"")
            gps, details = exif.get_ifd(ExifTags.IFD.GPSInfo), exif.get_ifd(ExifTags.IFD.Exif)
        except (SyntaxError, ValueError) as error:
            raise ImageError(f"{path} has EXIF that cannot be read ({error}); copy it again or remove it") from error
    if isinstance(xmp, bytes):
        xmp = xmp.decode("utf-8", errors="replace")
    camera = " ".join(str(exif.get(tag, "")).strip("\0 ") for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    return Exif(
        size_px=size,
        lat_lon_height=_position(gps),
        focal_px=_focal(size, details, xmp),
        orientation=orientation if orientation in range(1, 9) else 1,
        camera=camera.strip(),
        above_start_m=_dji(xmp, "RelativeAltitude"),
        taken=_taken(gps, details),
    )


def _position(gps: dict) -> tuple[float, float, float] | None:
    latitude = _degrees(gps.get(ExifTags.GPS.GPSLatitude), gps.get(ExifTags.GPS.GPSLatitudeRef), "S")
    longitude = _degrees(gps.get(ExifTags.GPS.GPSLongitude), gps.get(ExifTags.GPS.GPSLongitudeRef), "W")
    # A receiver without a fix writes 0, 0.
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0) or latitude == longitude == 0.0:
        return None
    height = _number(gps.get(ExifTags.GPS.GPSAltitude))
    if gps.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01"):
        height = -height
    return latitude, longitude, height


def _taken(gps: dict, details: dict) -> datetime | None:
    day = str(gps.get(ExifTags.GPS.GPSDateStamp, "")).strip("\0 ")
    clock = gps.get(ExifTags.GPS.GPSTimeStamp)
    try:
        if day and clock is not None:
            hours, minutes, seconds = (_number(part) for part in clock)
            passed = timedelta(hours=hours, minutes=minutes, seconds=seconds)
            return datetime.strptime(day, "%Y:%m:%d").replace(tzinfo=UTC) + passed
        local = str(details.get(ExifTags.Base.DateTimeOriginal, "")).strip("\0 ")
        offset = str(details.get(ExifTags.Base.OffsetTimeOriginal, "")).strip("\0 ")
        return datetime.strptime(local + offset, "%Y:%m:%d %H:%M:%S%z").astimezone(UTC)
    except (TypeError, ValueError):
        return None


def _degrees(parts, reference, negative: str) -> float:
    try:
        value = sum(_number(part) / 60.0**i for i, part in enumerate(parts))
    except TypeError:
        return math.nan
    return -value if str(reference).strip("\0 ").upper() == negative else value


def _focal(size: tuple[int, int], details: dict, xmp: str) -> float | None:
    calibrated = _dji(xmp, "CalibratedFocalLength")
    # Valid only for the image size of the calibration.
    full_width = details.get(ExifTags.Base.ExifImageWidth, size[0])
    film = _number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
    by_film = film / _FILM_WIDTH_MM * max(size) if film > 0.0 else None
    if calibrated and full_width == size[0] and (by_film is None or 1.0 / _RESIZED < calibrated / by_film < _RESIZED):
        return calibrated
    return by_film


def _dji(xmp: str, name: str) -> float | None:
    found = re.search(_DJI_NUMBER.format(name), xmp)
    try:
        return float(found.group(1)) if found else None
    except ValueError:
        return None


def _number(value) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan


def utm_code_of(heads: Mapping[str, Exif]) -> int | None:
    """EPSG code of the UTM zone (WGS 84) in which the GPS positions of photographs lie; None without positions."""
    places = [head.lat_lon_height[:2] for head in heads.values() if head.lat_lon_height is not None]
    return utm_code(*np.median(np.array(places), axis=0)) if places else None
