"""Metadata of a photograph: size, position, focal length, time; from EXIF and XMP, by Pillow."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image
from pyproj import CRS

from geo.crs import middle_lon_lat, utm_code
from survey.photos.pixels import HEIC_SUFFIXES, channel_bits, damage_named, open_image, stored_size, without_complaints
from survey.photos.xmp import (
    SEA_LEVEL,
    Motion,
    Rtk,
    exposure_time,
    height_datum,
    horizontal_datum,
    motion_of,
    number,
    rtk_of,
    serial_of,
    stated_std,
    with_known_prefixes,
    xmp_number,
    xmp_place,
)

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", *HEIC_SUFFIXES)

_LONGEST_XMP = 1_000_000
# Longer exposure times are fillers that some cameras write.
_LONGEST_EXPOSURE_S = 60.0
# Clocks on Earth differ from UTC by up to 14 hours.
_MOST_OFFSET_H = 14
_VOID = "a valid measurement (GPSStatus is V)"
_SIGNATURE_BYTES, _CHECKSUM_BYTES = 8, 4
# EXIF of photographs has some kilobytes, with a preview some hundred.
_LONGEST_EXIF = 4_000_000
# Reference frames within 2 m of WGS 84, which receivers with corrections use, by the beginning of their bare names.
_LIKE_WGS84 = (
    *("WGS84", "WGS1984", "GCSWGS1984", "DWGS1984", "WORLDGEODETICSYSTEM1984", "ITRF"),
    *("4326", "EPSG4326", "4979", "EPSG4979"),
    *("ETRS89", "EPSG4258", "CGCS2000", "EPSG4490", "NAD832011", "EPSG6318"),
    *("GDA2020", "EPSG7844", "JGD2011", "EPSG6668", "SIRGAS2000", "EPSG4674"),
)
# No drone flies higher; receivers without a height write the largest number.
_HIGHEST_M = 20_000.0
# Of GPSAltitudeRef: below the ellipsoid, below the sea.
_BELOW = (1, 3)
# A position in XMP within this of that in EXIF (a tenth of a second and a half) is the same with more digits.
_SAME_PLACE_DEG = 1.5 * 0.1 / 3600.0
_LONGEST_WORDS = 60
# The film that "focal length in 35 mm film" refers to [mm].
_FILM_WIDTH_MM = 36.0
# A calibration further off the 35 mm equivalent than this belongs to another size of the image: the equivalent is
# rounded to a millimetre and may count the diagonal, which is 8 % off for 4:3.
_SAME_SIZE = math.log(1.2)
# Optical centres lie within this share of the side about the middle.
_OFF_CENTRE = 0.1


@dataclass(frozen=True)
class TablePlace:
    """Position of a photograph by a table beside the photographs."""

    source: str  # Name of the table
    crs: CRS  # With or without heights
    # (easting or longitude, northing or latitude, height): in units of the crs; the height is NaN where there is none
    place: tuple[float, float, float]
    # (east, north, up) [m] or None: None where the table does not say it
    std_m: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Exif:
    """Metadata of an image file."""

    size_px: tuple[int, int]  # (width, height): as stored, without the rotation in `orientation`
    # (latitude [deg], longitude [deg], height [m]) or None: GPS position, WGS 84; the height is NaN where the file has
    # none. Its vertical datum is not known. To some metres where there is a `table_place`.
    lat_lon_height: tuple[float, float, float] | None
    # Focal length [px] of the stored size, from the 35 mm equivalent or DJI's calibration (a design value)
    focal_px: float | None
    orientation: int  # 1 where the image is stored upright
    camera: str  # Maker and model
    above_start_m: float | None  # DJI's and Autel's height over the take-off point [m]
    # In UTC: by DJI's XMP, else of the GPS clock, else of the camera's with its offset; None where there is none
    taken: datetime | None = None
    rtk: Rtk | None = None  # Accuracy of the position by the receiver, where DJI's XMP has it
    motion: Motion = field(default_factory=Motion)  # Attitudes, speed and shutter at the exposure, by XMP
    # (east, north, up) [m] or None: accuracy of the position where XMP states it in the namespace of Pix4D, as senseFly
    # and Parrot do, or EXIF in GPSHPositioningError
    std_m: tuple[float, float, float] | None = None
    height_datum: str | None = None  # What XMP says that the height counts from; see `survey.photos.xmp.height_datum`
    bits: int = 8  # Of one channel
    has_pages: bool = False  # Whether a TIFF has more images than the first one, which is used
    # By the camera's own clock, to the fraction of a second that it has: for the time between photographs
    clock: datetime | None = None
    exposure_s: float | None = None  # How long the shutter was open [s]
    gps_fault: str = ""  # What EXIF lacks for a complete GPS position, where it has a part of one
    # Datum of the position by the file, where that is not WGS 84 or equivalent; empty otherwise
    gps_datum: str = ""
    # Whether the receiver had no fix and repeats an earlier position (GPSStatus V)
    is_void: bool = False
    focal_warning: str = ""  # why it may be that of another image: `focal_warning`
    serial: str = ""  # Serial number of the camera; empty where it is not known
    # Position by a table, which replaces that of the file itself
    table_place: TablePlace | None = None


def read_exif(path: Path) -> Exif:
    """Read the head of an image, once in a process as long as it does not change; the pixels are not decoded."""
    stat = path.stat()
    return _read_exif(path, stat.st_ctime_ns, stat.st_size)


@lru_cache(maxsize=1 << 16)
def _read_exif(path: Path, _changed: int, _size: int) -> Exif:
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
        changed = exif.get(ExifTags.Base.DateTime)
    xmp = xmp[:_LONGEST_XMP].decode("utf-8", errors="replace") if isinstance(xmp, bytes) else xmp
    xmp = with_known_prefixes(xmp[:_LONGEST_XMP]) if isinstance(xmp, str) else ""
    seconds = number(details.get(ExifTags.Base.ExposureTime))
    camera = " ".join(words(exif.get(tag, "")) for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    position, fault = position_of(gps, xmp)
    return Exif(
        size_px=size,
        lat_lon_height=position,
        focal_px=focal_px(size, details, xmp),
        orientation=orientation if orientation in range(1, 9) else 1,
        camera=camera.strip(),
        above_start_m=xmp_number(xmp, "RelativeAltitude"),
        taken=exposure_time(xmp) or _taken(gps, details, changed),
        rtk=rtk_of(xmp),
        motion=motion_of(xmp),
        std_m=stated_std(xmp) or std_of_gps(gps),
        height_datum=height_datum(xmp) or (SEA_LEVEL if altitude_reference(gps) in (2, 3) else None),
        bits=bits,
        has_pages=has_pages,
        clock=_clock(details),
        exposure_s=seconds if 0.0 < seconds < _LONGEST_EXPOSURE_S else None,
        gps_fault=fault,
        gps_datum=other_datum(gps, xmp) if position is not None else "",
        is_void=position is not None and plain(gps.get(ExifTags.GPS.GPSStatus))[:1].upper() == "V",
        focal_warning=focal_warning(size, details, xmp),
        serial=words(details.get(ExifTags.Base.BodySerialNumber, "")) or words(serial_of(xmp)),
    )


def without_void_fixes(headers: Mapping[str, Exif]) -> dict[str, Exif]:
    """Heads of photographs by name, without the positions that receivers call void, where their camera has others.

    Cameras that mark most of their positions as void do so wrongly: these positions are kept.
    """
    void = Counter(header.serial for header in headers.values() if header.is_void)
    known = Counter(header.serial for header in headers.values() if header.lat_lon_height is not None)
    return {
        name: replace(header, lat_lon_height=None, gps_fault=_VOID)
        if header.is_void and 2 * void[header.serial] <= known[header.serial]
        else header
        for name, header in headers.items()
    }


def _taken(gps: dict, details: dict, changed: Any) -> datetime | None:
    """Time of a photograph in UTC: by the GPS clock, else by the camera's with its offset.

    ``changed`` is EXIF's DateTime.
    """
    day = plain(gps.get(ExifTags.GPS.GPSDateStamp))
    clock = gps.get(ExifTags.GPS.GPSTimeStamp)
    with suppress(TypeError, ValueError, OverflowError):
        hours, minutes, seconds = (number(part) for part in clock or ())
        passed = timedelta(hours=hours, minutes=minutes, seconds=seconds)
        return datetime.strptime(day, "%Y:%m:%d").replace(tzinfo=UTC) + passed
    # A receiver that has no date yet hides no camera that has one.
    local = plain(details.get(ExifTags.Base.DateTimeOriginal))
    for offset in _offsets(details, local, changed):
        with suppress(ValueError, OverflowError):
            return datetime.strptime(local + offset, "%Y:%m:%d %H:%M:%S%z").astimezone(UTC)
    return None


def _offsets(details: dict, local: str, changed: Any) -> list[str]:
    """Offsets of the camera's clock from UTC in EXIF, as "+02:00"; the standard's own tag comes first.

    Offsets of DateTimeDigitized and DateTime are used only if these equal the time of exposure: programs that change a
    file write their own.
    """
    base = ExifTags.Base
    times = {
        base.OffsetTimeOriginal: "", base.OffsetTimeDigitized: plain(details.get(base.DateTimeDigitized)),
        base.OffsetTime: plain(changed),
    }  # fmt: skip
    offsets = [plain(details.get(tag)) for tag, time in times.items() if time in ("", local)]
    # Of TIFF/EP, before EXIF had a tag: whole hours, those of the exposure first.
    hours = first(details.get(base.TimeZoneOffset))
    if isinstance(hours, int) and abs(hours) <= _MOST_OFFSET_H:
        offsets.append(f"{hours:+03d}:00")
    return [offset.replace(" ", "") for offset in offsets]


def _clock(details: dict) -> datetime | None:
    # Digits behind the decimal point, as many as the camera counts.
    digits = plain(details.get(ExifTags.Base.SubsecTimeOriginal))
    fraction = float(f"0.{digits}") if digits.isascii() and digits.isdigit() else 0.0
    with suppress(ValueError):
        text = plain(details.get(ExifTags.Base.DateTimeOriginal))
        return datetime.strptime(text, "%Y:%m:%d %H:%M:%S") + timedelta(seconds=fraction)
    return None


def position_sources(headers: Mapping[str, Exif]) -> str:
    """Sources of the GPS positions of photographs, in words: EXIF, a table, or both."""
    places = [header for header in headers.values() if header.lat_lon_height is not None]
    sources = {"EXIF" if header.table_place is None else header.table_place.source for header in places}
    return " and ".join(sorted(sources)) or "EXIF"


def utm_code_of(headers: Mapping[str, Exif]) -> int | None:
    """EPSG code of the UTM zone (WGS 84) in which the GPS positions of photographs lie; None without positions."""
    middle = middle_of(headers)
    return None if middle is None else utm_code(*middle)


def exif_places(headers: Mapping[str, Exif]) -> np.ndarray:
    """Longitudes and latitudes (n, 2) [deg] of the photographs that have a position."""
    places = [header.lat_lon_height[1::-1] for header in headers.values() if header.lat_lon_height is not None]
    return np.array(places).reshape(-1, 2)


def middle_of(headers: Mapping[str, Exif]) -> tuple[float, float] | None:
    """Latitude and longitude [deg] of the middle of photographs; None without positions."""
    places = exif_places(headers)
    if not len(places):
        return None
    lon, lat = middle_lon_lat(places).tolist()
    return lat, lon


def exif_of_png(path: Path) -> Image.Exif:
    """The EXIF of a PNG file; empty where there is none."""
    exif = Image.Exif()
    with path.open("rb") as file:
        file.seek(_SIGNATURE_BYTES)
        while len(head := file.read(8)) == 8:
            length, kind = int.from_bytes(head[:4], "big"), head[4:]
            if kind == b"eXIf" and length <= _LONGEST_EXIF:
                exif.load(b"Exif\0\0" + file.read(length))
                break
            file.seek(length + _CHECKSUM_BYTES, 1)
    return exif


def position_of(gps: dict, xmp: str) -> tuple[tuple[float, float, float] | None, str]:
    """The position by EXIF, or by XMP if it has more digits or EXIF has none; and what EXIF lacks for a position."""
    (by_exif, fault), by_xmp = position_of_gps(gps), xmp_place(xmp)
    if by_xmp is None:
        return by_exif, fault
    latitude, longitude, height = by_xmp.latitude, by_xmp.longitude, by_xmp.height
    if by_exif is None:
        return (latitude, longitude, math.nan if height is None else height), ""
    is_near = max(abs(by_exif[0] - latitude), abs(by_exif[1] - longitude)) < _SAME_PLACE_DEG
    return ((latitude, longitude, by_exif[2]) if is_near and by_xmp.step_deg < _step_deg(gps) else by_exif), ""


def position_of_gps(gps: dict) -> tuple[tuple[float, float, float] | None, str]:
    """Latitude, longitude [deg] and height [m] by EXIF, and what EXIF lacks for a position."""
    places = []
    for name, value, reference, letters in (
        ("latitude", ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef, "NS"),
        ("longitude", ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef, "EW"),
    ):
        degrees = _degrees(gps.get(value))
        # The letter, or the word that begins with it.
        letter = plain(gps.get(reference))[:1].upper()
        if math.isfinite(degrees) and (not letter or letter not in letters):
            return None, f"{name}'s reference ({' or '.join(letters)})"
        places.append(-abs(degrees) if letter == letters[1] else degrees)
    latitude, longitude = places
    # A receiver without a fix writes 0, 0.
    if latitude == longitude == 0.0:
        return None, "a fix (latitude and longitude are 0)"
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        given = [tag for tag in (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLongitude) if tag in gps]
        return None, "a latitude and longitude that can be read" if given else ""
    height = number(first(gps.get(ExifTags.GPS.GPSAltitude)))
    height = height if abs(height) < _HIGHEST_M else math.nan
    return (latitude, longitude, -abs(height) if altitude_reference(gps) in _BELOW else height), ""


def std_of_gps(gps: dict) -> tuple[float, float, float] | None:
    """Standard deviation of the position, (east, north, up) [m], by the horizontal positioning error (Exif 2.31).

    This is a distance, so that each axis has its part; heights of GNSS are about half as good as places.
    """
    error = number(first(gps.get(ExifTags.GPS.GPSHPositioningError)))
    if not 0.0 < error < _HIGHEST_M:
        return None
    axis = error / math.sqrt(2.0)
    return axis, axis, 2.0 * axis


def other_datum(gps: dict, xmp: str) -> str:
    """The datum of a position by its name in EXIF or XMP; empty where there is none, or it is WGS 84 or alike."""
    for name in (words(plain(gps.get(ExifTags.GPS.GPSMapDatum))), horizontal_datum(xmp)):
        bare = "".join(letter for letter in name.upper() if letter.isalnum())
        if bare and not bare.startswith(_LIKE_WGS84) and bare not in ("NONE", "UNKNOWN", "UNDEFINED"):
            return name
    return ""


def altitude_reference(gps: dict) -> int | None:
    """0 and 1: above and below the ellipsoid, or the sea before Exif 3.0; 2 and 3: above and below the sea."""
    value = first(gps.get(ExifTags.GPS.GPSAltitudeRef))
    if isinstance(value, str):
        value = value.encode("ascii", errors="replace")
    if isinstance(value, bytes):
        bare = value.strip(b"\0 ")
        if not bare:
            return 0 if value else None
        # The number itself, its digit, or words that begin like it.
        words = {b"above": 0, b"below": 1}
        value = bare[0] if len(bare) == 1 and bare[0] < 0x20 else words.get(bare[:5].lower(), plain(bare))
    found = number(value)
    return int(found) if found in (0.0, 1.0, 2.0, 3.0) else None


def _step_deg(gps: dict) -> float:
    """Step [deg] of the coarser coordinate, by the denominators of degrees, minutes and seconds."""
    steps = []
    for tag in (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLongitude):
        with suppress(KeyError, TypeError, ValueError):
            parts = list(gps[tag])[:3]
            steps.append(min(60.0**-i / max(getattr(part, "denominator", 1), 1) for i, part in enumerate(parts)))
    return max(steps, default=1.0 / 3600.0)


def _degrees(parts: Any) -> float:
    if isinstance(parts, bytes | str) or not hasattr(parts, "__getitem__"):
        return number(plain(parts) if isinstance(parts, bytes | str) else parts)
    values = [number(part) for part in parts[:3]]
    size = sum(abs(value) / 60.0**i for i, value in enumerate(values)) if values else math.nan
    return -size if any(value < 0.0 for value in values) else size


def first(value: Any) -> Any:
    """The first of several values, which some programs write where the standard has one."""
    return value[0] if isinstance(value, tuple | list) and value else value


def plain(value: Any) -> str:
    """A text of EXIF without its padding."""
    text = value.decode("ascii", errors="replace") if isinstance(value, bytes) else str("" if value is None else value)
    return text.strip("\0 ")


def words(value: Any) -> str:
    """A text of EXIF for messages: without control characters, and not longer than a line."""
    text = str(value)[:_LONGEST_WORDS]
    return "".join(letter for letter in text if letter.isprintable()).strip()


def focal_px(size: tuple[int, int], details: Mapping[int, Any], xmp: str) -> float | None:
    """The focal length [px] by DJI's calibration where it belongs to this size, else by the 35 mm equivalent.

    A photograph that was made smaller may keep the calibration of its full size: the optical centre beside it tells, or
    a 35 mm equivalent that contradicts it.
    """
    calibrated = xmp_number(xmp, "CalibratedFocalLength")
    film = number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
    by_film = film / _FILM_WIDTH_MM * max(size) if film > 0.0 else None
    # Whether the calibrated optical centre, where there is one, lies about the middle of the image.
    centre = [xmp_number(xmp, f"CalibratedOpticalCenter{axis}") for axis in "XY"]
    known = [(at, side) for at, side in zip(centre, size, strict=True) if at is not None and at > 0.0]
    is_centred = all(abs(at / side - 0.5) < _OFF_CENTRE for at, side in known)
    is_of_size = details.get(ExifTags.Base.ExifImageWidth, size[0]) == size[0] and is_centred
    if calibrated and is_of_size and (by_film is None or abs(math.log(calibrated / by_film)) < _SAME_SIZE):
        return calibrated
    return by_film


def focal_warning(size: tuple[int, int], details: Mapping[int, Any], xmp: str) -> str:
    """Reason why the focal length may not apply to the stored image size; empty where there is none."""
    reasons, zoom = [], number(details.get(ExifTags.Base.DigitalZoomRatio))
    if zoom > 1.0:
        # Cameras differ in whether the 35 mm equivalent has it.
        reasons.append(f"a digital zoom of {zoom:g} by EXIF, which its focal length may leave out")
    calibrated, used = xmp_number(xmp, "CalibratedFocalLength") or 0.0, focal_px(size, details, xmp)
    if calibrated > 0.0 and used != calibrated:
        other = "nothing else tells" if used is None else f"the 35 mm equivalent gives {used:.0f} px, which is used"
        reasons.append(f"a calibrated focal length of {calibrated:.0f} px in XMP that belongs to another size; {other}")
    elif calibrated > 0.0:
        film = number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
        if not film > 0.0 and xmp_number(xmp, "CalibratedOpticalCenterX") is None:
            reasons.append(f"a calibrated focal length of {calibrated:.0f} px, of the size that the camera made")
    return " and ".join(reasons)
