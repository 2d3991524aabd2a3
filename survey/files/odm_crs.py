"""The CRS in the first line of OpenDroneMap's text files, gcp_list.txt and geo.txt."""

from __future__ import annotations

import math
import re

from pyproj import CRS
from pyproj.exceptions import CRSError

from geo.crs import crs_of
from survey.errors import SurveyError
from survey.files.csv_table import shortened

_UTM = re.compile(r"WGS\s*84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)
# OpenSfM's word for longitude and latitude.
_WGS84 = re.compile(r"WGS\s*84", re.IGNORECASE)
_EPSG = re.compile(r"EPSG:\s*(\d{1,9}(?:\+\d{1,9})?)", re.IGNORECASE)
_FORM = 'e.g. "EPSG:25832", "WGS84 UTM 32N" or "+proj=utm +zone=32 +datum=WGS84"'


def is_odm_crs(line: str) -> bool:
    """Whether a line has the form of one that names a CRS."""
    return "+proj" in line or any(known.fullmatch(line) for known in (_UTM, _EPSG, _WGS84))


def odm_crs(line: str, where: str, name: str, error: type[SurveyError]) -> CRS:
    """The CRS that a line names.

    Parameters
    ----------
    line : str
        Without blanks around it.
    where, name : str
        Of the line, and of the file, for errors.
    error : type of SurveyError

    Raises
    ------
    error
        If the line names none, or one that is not known.
    """
    if _WGS84.fullmatch(line):
        return CRS.from_epsg(4326)
    utm, epsg = _UTM.fullmatch(line), _EPSG.fullmatch(line)
    said = f'{where}: "{shortened(line)}"'
    if utm is not None:
        zone = int(utm[1])
        if not 1 <= zone <= 60:
            raise error(f"{said} is no UTM zone, expected 1 to 60; correct it")
        return CRS.from_epsg((32600 if utm[2].upper() == "N" else 32700) + zone)
    if not is_odm_crs(line):
        if sum(_is_number(word) for word in line.split()) > 1:
            raise error(f"{said} is a line of a point, expected the CRS before it, {_FORM}; add it")
        raise error(f"{said} is no CRS that {name} may begin with, expected {_FORM}; correct it")
    try:
        crs = crs_of(f"EPSG:{epsg[1]}" if epsg is not None else line.strip("'\""))
    except CRSError as wrong:
        raise error(f"{said} is not a known CRS, expected {_FORM}; correct it") from wrong
    if not (crs.is_projected or crs.is_geographic):
        raise error(f"{said} is {crs.name}, expected a CRS of a map or of longitude and latitude, {_FORM}; correct it")
    return crs


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False
