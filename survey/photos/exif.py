"""Metadata of a photograph: size, position, focal length, time; from EXIF and XMP, by Pillow."""

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
from survey.photos import exif_values
from survey.photos import xmp as in_xmp
from survey.photos.pixels import HEIC_SUFFIXES, channel_bits, damage_named, open_image, stored_size, without_complaints

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
    rtk: in_xmp.Rtk | None = None  # Accuracy of the position by the receiver, where DJI's XMP has it
    motion: in_xmp.Motion = field(default_factory=in_xmp.Motion)  # Attitudes, speed and shutter at the exposure, by XMP
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
    xmp = in_xmp.with_known_prefixes(xmp[:_LONGEST_XMP]) if isinstance(xmp, str) else ""
    seconds = in_xmp.number(details.get(ExifTags.Base.ExposureTime))
    camera = " ".join(exif_values.words(exif.get(tag, "")) for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    orientation = exif.get(ExifTags.Base.Orientation, 1)
    position, fault = exif_values.position_of(gps, xmp)
    return Exif(
        size_px=size,
        lat_lon_height=position,
        focal_px=exif_values.focal_px(size, details, xmp),
        orientation=orientation if orientation in range(1, 9) else 1,
        camera=camera.strip(),
        above_start_m=in_xmp.xmp_number(xmp, "RelativeAltitude"),
        taken=in_xmp.exposure_time(xmp) or _taken(gps, details, changed),
        rtk=in_xmp.rtk_of(xmp),
        motion=in_xmp.motion_of(xmp),
        std_m=in_xmp.stated_std(xmp) or exif_values.std_of_gps(gps),
        height_datum=in_xmp.height_datum(xmp)
        or (in_xmp.SEA_LEVEL if exif_values.altitude_reference(gps) in (2, 3) else None),
        bits=bits,
        has_pages=has_pages,
        clock=_clock(details),
        exposure_s=seconds if 0.0 < seconds < _LONGEST_EXPOSURE_S else None,
        gps_fault=fault,
        gps_datum=exif_values.other_datum(gps, xmp) if position is not None else "",
        is_void=position is not None and exif_values.plain(gps.get(ExifTags.GPS.GPSStatus))[:1].upper() == "V",
        focal_warning=exif_values.focal_warning(size, details, xmp),
        serial=exif_values.words(details.get(ExifTags.Base.BodySerialNumber, ""))
        or exif_values.words(in_xmp.serial_of(xmp)),
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
    day = exif_values.plain(gps.get(ExifTags.GPS.GPSDateStamp))
    clock = gps.get(ExifTags.GPS.GPSTimeStamp)
    with suppress(TypeError, ValueError, OverflowError):
        hours, minutes, seconds = (in_xmp.number(part) for part in clock or ())
        passed = timedelta(hours=hours, minutes=minutes, seconds=seconds)
        return datetime.strptime(day, "%Y:%m:%d").replace(tzinfo=UTC) + passed
    # A receiver that has no date yet hides no camera that has one.
    local = exif_values.plain(details.get(ExifTags.Base.DateTimeOriginal))
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
        base.OffsetTimeOriginal: "", base.OffsetTimeDigitized: exif_values.plain(details.get(base.DateTimeDigitized)),
        base.OffsetTime: exif_values.plain(changed),
    }  # fmt: skip
    offsets = [exif_values.plain(details.get(tag)) for tag, time in times.items() if time in ("", local)]
    # Of TIFF/EP, before EXIF had a tag: whole hours, those of the exposure first.
    hours = exif_values.first(details.get(base.TimeZoneOffset))
    if isinstance(hours, int) and abs(hours) <= _MOST_OFFSET_H:
        offsets.append(f"{hours:+03d}:00")
    return [offset.replace(" ", "") for offset in offsets]


def _clock(details: dict) -> datetime | None:
    # Digits behind the decimal point, as many as the camera counts.
    digits = exif_values.plain(details.get(ExifTags.Base.SubsecTimeOriginal))
    fraction = float(f"0.{digits}") if digits.isascii() and digits.isdigit() else 0.0
    with suppress(ValueError):
        text = exif_values.plain(details.get(ExifTags.Base.DateTimeOriginal))
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
