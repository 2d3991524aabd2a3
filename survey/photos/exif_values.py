"""Values of EXIF in all legal forms: position, height reference, focal length, words."""

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from PIL import ExifTags

from survey.photos.xmp import horizontal_datum, number, xmp_number, xmp_place

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


def position_of(gps: dict, xmp: str) -> tuple[tuple[float, float, float] | None, str]:
    """The position by EXIF, or by XMP if it has more digits or EXIF has none; and what EXIF lacks for a position."""
    (by_exif, fault), by_xmp = position_of_gps(gps), xmp_place(xmp)
    if by_xmp is None:
        return by_exif, fault
    place, step_deg = by_xmp
    if by_exif is None:
        return place, ""
    latitude, longitude, _ = place
    is_near = max(abs(by_exif[0] - latitude), abs(by_exif[1] - longitude)) < _SAME_PLACE_DEG
    return ((latitude, longitude, by_exif[2]) if is_near and step_deg < _step_deg(gps) else by_exif), ""


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
