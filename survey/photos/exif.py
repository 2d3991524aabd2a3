"""Metadata of a photograph: size, position, focal length, time; from EXIF and XMP, by Pillow."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags
from pyproj import CRS

from geo.crs import utm_code
from survey.photos.exif_focal import FocalCandidate, focal_candidates, focal_doubt, focal_px
from survey.photos.opening import HEIC_SUFFIXES, damage_named, open_image, without_complaints
from survey.photos.pixels import channel_bits, stored_size
from survey.photos.png import exif_of_png
from survey.photos.xmp import (
    SEA_LEVEL,
    Motion,
    Rtk,
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

_LONGEST_XMP, _LONGEST_WORDS = 1_000_000, 60
# Longer ones stand in files whose camera writes a filler.
_LONGEST_EXPOSURE_S = 60.0
# Clocks on Earth differ from UTC by up to 14 hours.
_MOST_OFFSET_H = 14
# Frames within 2 m of WGS 84, as a receiver's corrections have them, by the beginning of their bare names.
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
_VOID = "a valid measurement (GPSStatus is V)"
# A position in XMP that differs from that in EXIF by less (a tenth of a second and half) is the same with more digits.
_SAME_PLACE_DEG = 1.5 * 0.1 / 3600.0


@dataclass(frozen=True)
class TablePlace:
    """Where a table beside the photographs says that one was taken.

    Attributes
    ----------
    source : str
        Name of the table.
    crs : pyproj.CRS
        With or without heights.
    place : (easting or longitude, northing or latitude, height)
        In units of the crs; the height is NaN where there is none.
    std_m : (east, north, up) [m] or None
        None where the table does not say it.
    """

    source: str
    crs: CRS
    place: tuple[float, float, float]
    std_m: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Exif:
    """Head of an image file.

    Attributes
    ----------
    size_px : (width, height)
        As stored, without the rotation in `orientation`.
    lat_lon_height : (latitude [deg], longitude [deg], height [m]) or None
        GPS position, WGS 84; the height is NaN where the file has none. Its vertical datum is not known. To some metres
        where there is a `table_place`.
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
        Accuracy of the position where XMP states it in the namespace of Pix4D, as senseFly and Parrot do, or EXIF in
        GPSHPositioningError.
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
    gps_fault : str
        What EXIF lacks for a GPS position, of which it has a part.
    focal_doubt : str
        Why the focal length may be that of another image: `survey.photos.exif_focal.focal_doubt`.
    gps_datum : str
        What the file says that its position is on, where that is not WGS 84 or alike; empty otherwise.
    is_void : bool
        Whether the receiver says that it measured no position, and gives an earlier one (GPSStatus V).
    serial : str
        Serial number of the camera; empty where nothing tells it.
    table_place : TablePlace or None
        Where a table gives the position, which then counts instead of that of the file itself.
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
    gps_fault: str = ""
    gps_datum: str = ""
    is_void: bool = False
    focal_doubt: str = ""
    serial: str = ""
    table_place: TablePlace | None = None


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
        changed = exif.get(ExifTags.Base.DateTime)
    xmp = _text_of_xmp(xmp)
    camera = " ".join(_words(exif.get(tag, "")) for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    position, fault = _position(gps, xmp)
    return Exif(
        size_px=size,
        lat_lon_height=position,
        focal_px=focal_px(size, details, xmp),
        orientation=orientation if orientation in range(1, 9) else 1,
        camera=camera.strip(),
        above_start_m=xmp_number(xmp, "RelativeAltitude"),
        taken=_taken(gps, details, changed),
        focal_candidates=focal_candidates(size, details, xmp),
        rtk=rtk_of(xmp),
        motion=motion_of(xmp),
        std_m=stated_std(xmp) or _std_of_gps(gps),
        height_datum=height_datum(xmp) or (SEA_LEVEL if _altitude_reference(gps) in (2, 3) else None),
        bits=bits,
        has_pages=has_pages,
        clock=_clock(details),
        exposure_s=_exposure(details),
        gps_fault=fault,
        gps_datum=_other_datum(gps, xmp) if position is not None else "",
        is_void=position is not None and _plain(gps.get(ExifTags.GPS.GPSStatus))[:1].upper() == "V",
        focal_doubt=focal_doubt(size, details, xmp),
        serial=_words(details.get(ExifTags.Base.BodySerialNumber, "")) or _words(serial_of(xmp)),
    )


def without_void(heads: Mapping[str, Exif]) -> dict[str, Exif]:
    """Heads of photographs by name, without the positions that receivers call void, where their camera has others.

    A camera most of whose positions are void says so of all: they are kept.
    """
    void = Counter(head.serial for head in heads.values() if head.is_void)
    known = Counter(head.serial for head in heads.values() if head.lat_lon_height is not None)
    return {
        name: replace(head, lat_lon_height=None, gps_fault=_VOID)
        if head.is_void and 2 * void[head.serial] <= known[head.serial]
        else head
        for name, head in heads.items()
    }


def _text_of_xmp(value: Any) -> str:
    if isinstance(value, bytes):
        value = value[:_LONGEST_XMP].decode("utf-8", errors="replace")
    return with_known_prefixes(value[:_LONGEST_XMP]) if isinstance(value, str) else ""


def _words(value: Any) -> str:
    """A text of EXIF for messages: without what a terminal obeys, and not longer than a line."""
    text = str(value)[:_LONGEST_WORDS]
    return "".join(letter for letter in text if letter.isprintable()).strip()


def _position(gps: dict, xmp: str) -> tuple[tuple[float, float, float] | None, str]:
    """The position, by EXIF, or by XMP where that has more digits or EXIF none; and what EXIF lacks for one."""
    by_exif, fault = _position_of_gps(gps)
    by_xmp = xmp_place(xmp)
    if by_xmp is None:
        return by_exif, fault
    if by_exif is None:
        height = math.nan if by_xmp.height is None else by_xmp.height
        return (by_xmp.latitude, by_xmp.longitude, height), ""
    apart = max(abs(by_exif[0] - by_xmp.latitude), abs(by_exif[1] - by_xmp.longitude))
    if by_xmp.step_deg < _step_deg(gps) and apart < _SAME_PLACE_DEG:
        return (by_xmp.latitude, by_xmp.longitude, by_exif[2]), ""
    return by_exif, fault


def _position_of_gps(gps: dict) -> tuple[tuple[float, float, float] | None, str]:
    places = []
    for name, value, reference, letters in (
        ("latitude", ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef, "NS"),
        ("longitude", ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef, "EW"),
    ):
        degrees = _degrees(gps.get(value))
        # The letter, or the word that begins with it.
        letter = _plain(gps.get(reference))[:1].upper()
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
    height = number(_first(gps.get(ExifTags.GPS.GPSAltitude)))
    height = height if abs(height) < _HIGHEST_M else math.nan
    return (latitude, longitude, -abs(height) if _altitude_reference(gps) in _BELOW else height), ""


def _std_of_gps(gps: dict) -> tuple[float, float, float] | None:
    """One standard deviation of the position, (east, north, up) [m], by the horizontal positioning error (Exif 2.31).

    This is a distance, so that each axis has its part; heights of GNSS are about half as good as places.
    """
    error = number(_first(gps.get(ExifTags.GPS.GPSHPositioningError)))
    if not 0.0 < error < _HIGHEST_M:
        return None
    axis = error / math.sqrt(2.0)
    return axis, axis, 2.0 * axis


def _other_datum(gps: dict, xmp: str) -> str:
    """The datum of a position by its name in EXIF or XMP; empty where there is none, or it is WGS 84 or alike."""
    for said in (_words(_plain(gps.get(ExifTags.GPS.GPSMapDatum))), horizontal_datum(xmp)):
        bare = "".join(letter for letter in said.upper() if letter.isalnum())
        if bare and not bare.startswith(_LIKE_WGS84) and bare not in ("NONE", "UNKNOWN", "UNDEFINED"):
            return said
    return ""


def _altitude_reference(gps: dict) -> int | None:
    """0 and 1: above and below the ellipsoid, or the sea before Exif 3.0; 2 and 3: above and below the sea."""
    value = _first(gps.get(ExifTags.GPS.GPSAltitudeRef))
    if isinstance(value, str):
        value = value.encode("ascii", errors="replace")
    if isinstance(value, bytes):
        bare = value.strip(b"\0 ")
        if not bare:
            return 0 if value else None
        # The number itself, its digit, or words that begin like it.
        words = {b"above": 0, b"below": 1}
        value = bare[0] if len(bare) == 1 and bare[0] < 0x20 else words.get(bare[:5].lower(), _plain(bare))
    found = number(value)
    return int(found) if found in (0.0, 1.0, 2.0, 3.0) else None


def _first(value: Any) -> Any:
    """The first of several values, which some programs write where the standard has one."""
    return value[0] if isinstance(value, tuple | list) and value else value


def _plain(value: Any) -> str:
    """A text of EXIF without its padding."""
    text = value.decode("ascii", errors="replace") if isinstance(value, bytes) else str("" if value is None else value)
    return text.strip("\0 ")


def _step_deg(gps: dict) -> float:
    """The step [deg] of the coarser coordinate, as the denominators of degrees, minutes and seconds tell."""
    steps = [1.0 / 3600.0]
    for tag in (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLongitude):
        try:
            parts = list(gps[tag])[:3]
            steps.append(min(60.0**-i / max(getattr(part, "denominator", 1), 1) for i, part in enumerate(parts)))
        except (KeyError, TypeError, ValueError):
            continue
    return max(steps[1:], default=steps[0])


def _taken(gps: dict, details: dict, changed: Any) -> datetime | None:
    """When a photograph was taken, in UTC: by the GPS clock, else by the camera's with its offset.

    ``changed`` is EXIF's DateTime.
    """
    day = _plain(gps.get(ExifTags.GPS.GPSDateStamp))
    clock = gps.get(ExifTags.GPS.GPSTimeStamp)
    with suppress(TypeError, ValueError, OverflowError):
        hours, minutes, seconds = (number(part) for part in clock or ())
        passed = timedelta(hours=hours, minutes=minutes, seconds=seconds)
        return datetime.strptime(day, "%Y:%m:%d").replace(tzinfo=UTC) + passed
    # A receiver that has no date yet hides no camera that has one.
    local = _plain(details.get(ExifTags.Base.DateTimeOriginal))
    for offset in _offsets(details, local, changed):
        with suppress(ValueError, OverflowError):
            return datetime.strptime(local + offset, "%Y:%m:%d %H:%M:%S%z").astimezone(UTC)
    return None


def _offsets(details: dict, local: str, changed: Any) -> list[str]:
    """What EXIF says of the offset of the camera's clock from UTC, as "+02:00"; the standard's own tag comes first.

    The offsets of DateTimeDigitized and DateTime are that of the exposure where these are the time of the exposure:
    a program that changed the file writes its own.
    """
    digitized = _plain(details.get(ExifTags.Base.DateTimeDigitized))
    found = [_plain(details.get(ExifTags.Base.OffsetTimeOriginal))]
    found += [_plain(details.get(ExifTags.Base.OffsetTimeDigitized))] if digitized in ("", local) else []
    found += [_plain(details.get(ExifTags.Base.OffsetTime))] if _plain(changed) in ("", local) else []
    # Of TIFF/EP, before EXIF had a tag: whole hours, those of the exposure first.
    hours = details.get(ExifTags.Base.TimeZoneOffset)
    hours = hours[0] if isinstance(hours, tuple | list) and hours else hours
    if isinstance(hours, int) and abs(hours) <= _MOST_OFFSET_H:
        found.append(f"{hours:+03d}:00")
    return [offset.replace(" ", "") for offset in found]


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


def _degrees(parts) -> float:
    if isinstance(parts, bytes | str):
        return number(_plain(parts))
    try:
        values = [number(part) for part in parts[:3]]
    except TypeError:
        return number(parts)
    size = sum(abs(value) / 60.0**i for i, value in enumerate(values)) if values else math.nan
    return -size if any(value < 0.0 for value in values) else size


def position_sources(heads: Mapping[str, Exif]) -> str:
    """Where GPS positions of photographs are written, in words: EXIF, a table, or both."""
    places = [head for head in heads.values() if head.lat_lon_height is not None]
    sources = {"EXIF" if head.table_place is None else head.table_place.source for head in places}
    return " and ".join(sorted(sources)) or "EXIF"


def utm_code_of(heads: Mapping[str, Exif]) -> int | None:
    """EPSG code of the UTM zone (WGS 84) in which the GPS positions of photographs lie; None without positions."""
    places = [head.lat_lon_height[:2] for head in heads.values() if head.lat_lon_height is not None]
    return utm_code(*np.median(np.array(places), axis=0)) if places else None
