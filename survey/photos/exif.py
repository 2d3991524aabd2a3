"""Metadata of a photograph: size, position, focal length, time; from EXIF and XMP, by Pillow."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags

from geo.crs import utm_code
from survey.photos.exif_focal import FocalCandidate, focal_candidates, focal_px
from survey.photos.opening import HEIC_SUFFIXES, damage_named, open_image, without_complaints
from survey.photos.pixels import channel_bits, stored_size
from survey.photos.png import exif_of_png
from survey.photos.xmp import Motion, Rtk, height_datum, motion_of, number, rtk_of, stated_std, xmp_number

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", *HEIC_SUFFIXES)

_LONGEST_XMP, _LONGEST_WORDS = 1_000_000, 60
# Longer ones stand in files whose camera writes a filler.
_LONGEST_EXPOSURE_S = 60.0


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
        DJI's and Autel's height over the take-off point [m].
    taken : datetime or None
        In UTC: of the GPS clock, else of the camera's with its offset; None where neither is there.
    focal_candidates : tuple of FocalCandidate
        All that the head says of the focal length, which may disagree; for the search of a calibration.
    rtk : Rtk or None
        Accuracy of the position by the receiver, where DJI's XMP has it.
    motion : Motion
        Attitudes, speed and shutter at the exposure, by XMP.
    std_m : (east, north, up) [m] or None
        Accuracy of the position where XMP states it in the namespace of Pix4D, as senseFly and Parrot do.
    height_datum : str or None
        What XMP says that the height counts from; see `survey.photos.xmp.height_datum`.
    bits : int
        Of one channel.
    has_pages : bool
        Whether a TIFF has more images than the first one, which is used.
    clock : datetime or None
        By the camera's own clock, to the fraction of a second that it has: for the time between photographs.
    exposure_s : float or None
        How long the shutter was open [s].
    """

    size_px: tuple[int, int]
    lat_lon_height: tuple[float, float, float] | None
    focal_px: float | None
    orientation: int
    camera: str
    above_start_m: float | None
    taken: datetime | None = None
    focal_candidates: tuple[FocalCandidate, ...] = ()
    rtk: Rtk | None = None
    motion: Motion = field(default_factory=Motion)
    std_m: tuple[float, float, float] | None = None
    height_datum: str | None = None
    bits: int = 8
    has_pages: bool = False
    clock: datetime | None = None
    exposure_s: float | None = None


def read_exif(path: Path) -> Exif:
    """Read the head of an image; the pixels are not decoded.

    Raises
    ------
    ImageError
        Where the file is no image, or one that is too large for this machine.
    """
    with (
        open_image(path) as image,
        without_complaints(),
        damage_named(f"{path} has EXIF that cannot be read"),
    ):
        exif = exif_of_png(path) if image.format == "PNG" else image.getexif()
        size, xmp = stored_size(image), image.info.get("xmp", b"")
        bits = channel_bits(image)
        has_pages = image.format == "TIFF" and getattr(image, "is_animated", False)
        gps, details = exif.get_ifd(ExifTags.IFD.GPSInfo), exif.get_ifd(ExifTags.IFD.Exif)
    xmp = _text_of_xmp(xmp)
    camera = " ".join(_words(exif.get(tag, "")) for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    return Exif(
        size_px=size,
        lat_lon_height=_position(gps),
        focal_px=focal_px(size, details, xmp),
        orientation=orientation if orientation in range(1, 9) else 1,
        camera=camera.strip(),
        above_start_m=xmp_number(xmp, "RelativeAltitude"),
        taken=_taken(gps, details),
        focal_candidates=focal_candidates(size, details, xmp),
        rtk=rtk_of(xmp),
        motion=motion_of(xmp),
        std_m=stated_std(xmp),
        height_datum=height_datum(xmp),
        bits=bits,
        has_pages=has_pages,
        clock=_clock(details),
        exposure_s=_exposure(details),
    )


def _text_of_xmp(value: Any) -> str:
    if isinstance(value, bytes):
        value = value[:_LONGEST_XMP].decode("utf-8", errors="replace")
    return value[:_LONGEST_XMP] if isinstance(value, str) else ""


def _words(value: Any) -> str:
    """A text of EXIF for messages: without what a terminal obeys, and not longer than a line."""
    text = str(value)[:_LONGEST_WORDS]
    return "".join(letter for letter in text if letter.isprintable()).strip()


def _position(gps: dict) -> tuple[float, float, float] | None:
    latitude = _degrees(gps.get(ExifTags.GPS.GPSLatitude), gps.get(ExifTags.GPS.GPSLatitudeRef), "S")
    longitude = _degrees(gps.get(ExifTags.GPS.GPSLongitude), gps.get(ExifTags.GPS.GPSLongitudeRef), "W")
    # A receiver without a fix writes 0, 0.
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0) or latitude == longitude == 0.0:
        return None
    height = number(gps.get(ExifTags.GPS.GPSAltitude))
    if gps.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01"):
        height = -height
    return latitude, longitude, height


def _taken(gps: dict, details: dict) -> datetime | None:
    day = str(gps.get(ExifTags.GPS.GPSDateStamp, "")).strip("\0 ")
    clock = gps.get(ExifTags.GPS.GPSTimeStamp)
    try:
        if day and clock is not None:
            hours, minutes, seconds = (number(part) for part in clock)
            passed = timedelta(hours=hours, minutes=minutes, seconds=seconds)
            return datetime.strptime(day, "%Y:%m:%d").replace(tzinfo=UTC) + passed
        local = str(details.get(ExifTags.Base.DateTimeOriginal, "")).strip("\0 ")
        offset = str(details.get(ExifTags.Base.OffsetTimeOriginal, "")).strip("\0 ")
        return datetime.strptime(local + offset, "%Y:%m:%d %H:%M:%S%z").astimezone(UTC)
    except (TypeError, ValueError, OverflowError):
        return None


def _clock(details: dict) -> datetime | None:
    text = str(details.get(ExifTags.Base.DateTimeOriginal, "")).strip("\0 ")
    # Digits behind the decimal point, as many as the camera counts.
    digits = str(details.get(ExifTags.Base.SubsecTimeOriginal, "")).strip("\0 ")
    fraction = float(f"0.{digits}") if digits.isascii() and digits.isdigit() else 0.0
    try:
        return datetime.strptime(text, "%Y:%m:%d %H:%M:%S") + timedelta(seconds=fraction)
    except ValueError:
        return None


def _exposure(details: dict) -> float | None:
    seconds = number(details.get(ExifTags.Base.ExposureTime))
    return seconds if 0.0 < seconds < _LONGEST_EXPOSURE_S else None


def _degrees(parts, reference, negative: str) -> float:
    try:
        value = sum(number(part) / 60.0**i for i, part in enumerate(parts[:3]))
    except TypeError:
        return math.nan
    return -value if str(reference).strip("\0 ").upper() == negative else value


def utm_code_of(heads: Mapping[str, Exif]) -> int | None:
    """EPSG code of the UTM zone (WGS 84) in which the GPS positions of photographs lie; None without positions."""
    places = [head.lat_lon_height[:2] for head in heads.values() if head.lat_lon_height is not None]
    return utm_code(*np.median(np.array(places), axis=0)) if places else None
