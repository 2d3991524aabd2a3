"""Focal lengths that the head of an image file suggests: several readings, which may disagree."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import ExifTags

from survey.photos.xmp import number, pix4d_number, xmp_number

# The film that "focal length in 35 mm film" refers to [mm].
_FILM_WIDTH_MM, _FILM_DIAGONAL_MM = 36.0, math.hypot(36.0, 24.0)
# A calibration further off the 35 mm equivalent than this belongs to another size of the image: the equivalent is
# rounded to a millimetre and may count the diagonal, which is 8 % off for 4:3.
_SAME_SIZE = math.log(1.2)
# Optical centres lie within this share of the side about the middle.
_OFF_CENTRE = 0.1
# EXIF's units of FocalPlaneXResolution in mm: inch, centimetre, millimetre, micrometre.
_PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_INCH = 2


@dataclass(frozen=True)
class FocalCandidate:
    """A reading of the focal length."""

    focal_px: float  # In pixels of the stored size
    # "35 mm film, by width" or ", by diagonal" (the standard leaves open which); "focal plane" (focal length and pixel
    # pitch of the sensor); "XMP Camera" (the same with the maker's calibrated focal length, as senseFly and Parrot
    # write it); "DJI calibration" (a design value)
    source: str


def focal_candidates(size: tuple[int, int], details: Mapping[int, Any], xmp: str) -> tuple[FocalCandidate, ...]:
    """All readings of the focal length of an image of a size (width, height), from the details of EXIF and from XMP."""
    found = []
    film = number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if film > 0.0:
        found.append(FocalCandidate(film / _FILM_WIDTH_MM * max(size), "35 mm film, by width"))
        found.append(FocalCandidate(film / _FILM_DIAGONAL_MM * math.hypot(*size), "35 mm film, by diagonal"))
    by_plane = _by_focal_plane(size, details, number(details.get(ExifTags.Base.FocalLength)))
    if by_plane is not None:
        found.append(FocalCandidate(by_plane, "focal plane"))
    by_maker = _by_focal_plane(size, details, pix4d_number(xmp, "PerspectiveFocalLength") or math.nan)
    if by_maker is not None:
        found.append(FocalCandidate(by_maker, "XMP Camera"))
    calibrated = xmp_number(xmp, "CalibratedFocalLength")
    if calibrated is not None and calibrated > 0.0:
        found.append(FocalCandidate(calibrated / _reduction(size, details), "DJI calibration"))
    return tuple(candidate for candidate in found if math.isfinite(candidate.focal_px))


def focal_px(size: tuple[int, int], details: Mapping[int, Any], xmp: str) -> float | None:
    """The focal length [px] by DJI's calibration where it belongs to this size, else by the 35 mm equivalent.

    A photograph that was made smaller may keep the calibration of its full size: the optical centre beside it tells, or
    a 35 mm equivalent that contradicts it.
    """
    calibrated = xmp_number(xmp, "CalibratedFocalLength")
    film = number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
    by_film = film / _FILM_WIDTH_MM * max(size) if film > 0.0 else None
    is_of_size = details.get(ExifTags.Base.ExifImageWidth, size[0]) == size[0] and _is_centred(size, xmp)
    if calibrated and is_of_size and (by_film is None or abs(math.log(calibrated / by_film)) < _SAME_SIZE):
        return calibrated
    return by_film


def focal_doubt(size: tuple[int, int], details: Mapping[int, Any], xmp: str) -> str:
    """Why the focal length may be that of another image than the stored one; empty where nothing says so."""
    zoom = number(details.get(ExifTags.Base.DigitalZoomRatio))
    # Cameras differ in whether the 35 mm equivalent has it.
    said = f"a digital zoom of {zoom:g} by EXIF, which its focal length may leave out" if zoom > 1.0 else ""
    return " and ".join(filter(None, (said, _resized_doubt(size, details, xmp))))


def _resized_doubt(size: tuple[int, int], details: Mapping[int, Any], xmp: str) -> str:
    """Doubt where calibration and 35 mm equivalent belong to images of different sizes; empty otherwise."""
    calibrated, used = xmp_number(xmp, "CalibratedFocalLength"), focal_px(size, details, xmp)
    if not calibrated or calibrated <= 0.0:
        return ""
    if used == calibrated:
        film = number(details.get(ExifTags.Base.FocalLengthIn35mmFilm))
        is_told = film > 0.0 or xmp_number(xmp, "CalibratedOpticalCenterX") is not None
        return "" if is_told else f"a calibrated focal length of {calibrated:.0f} px, of the size that the camera made"
    other = "nothing else tells" if used is None else f"the 35 mm equivalent gives {used:.0f} px, which is used"
    return f"a calibrated focal length of {calibrated:.0f} px in XMP that belongs to another size; {other}"


def _is_centred(size: tuple[int, int], xmp: str) -> bool:
    """Whether the calibrated optical centre lies about the middle of the image; true where there is none."""
    centre = [xmp_number(xmp, f"CalibratedOpticalCenter{axis}") for axis in "XY"]
    known = [(at, side) for at, side in zip(centre, size, strict=True) if at is not None and at > 0.0]
    return all(abs(at / side - 0.5) < _OFF_CENTRE for at, side in known)


def _by_focal_plane(size: tuple[int, int], details: Mapping[int, Any], focal_mm: float) -> float | None:
    pixels_per_unit = number(details.get(ExifTags.Base.FocalPlaneXResolution))
    unit_mm = _PLANE_UNIT_MM.get(details.get(ExifTags.Base.FocalPlaneResolutionUnit, _INCH))
    if not (focal_mm > 0.0 and pixels_per_unit > 0.0) or unit_mm is None:
        return None
    # The resolution counts the pixels of the camera's own image.
    return focal_mm * pixels_per_unit / unit_mm / _reduction(size, details)


def _reduction(size: tuple[int, int], details: Mapping[int, Any]) -> float:
    """Pixels of the image that the camera made per pixel of the stored image, along its longer side."""
    made = [number(details.get(tag)) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)]
    longer = max((side for side in made if side > 0.0), default=math.nan)
    return longer / max(size) if math.isfinite(longer) else 1.0
