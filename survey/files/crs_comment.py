"""The CRS that a table names in a comment, as Metashape and other programs write it."""

from __future__ import annotations

import re
from pathlib import Path

from pyproj import CRS
from pyproj.exceptions import CRSError

from geo.crs import crs_of
from survey.errors import SurveyError
from survey.files.csv_table import shortened, text_lines

_COMMENT = re.compile(r"#\s*CoordinateSystem:\s*(.+)", re.IGNORECASE)
# A comment that is nothing but a code, under one of the names that people have for it.
_CODE = re.compile(
    r"(?:#|//)\s*(?:(?:crs|srs|srid|projection|coordinates?(?: reference)?(?: system)?)(?: in| is)?\s*[:=]?\s*)?"
    r"(EPSG\s*[:=]\s*\d+(?:\+\d+)?)",
    re.IGNORECASE,
)
_SRID = re.compile(r"(?:#|//)\s*SRID\s*[:=]\s*(\d+)", re.IGNORECASE)


def crs_of_comment(path: Path, error: type[SurveyError]) -> CRS | None:
    """The CRS in a line ``# CoordinateSystem: WKT or code``, ``# EPSG:code`` or ``# crs = EPSG:code``.

    None where there is none, one of the site, or a datum of heights alone.

    Raises
    ------
    error
        If it is not known.
    """
    lines = (line.strip() for _, line in text_lines(path, error))
    found = next((said for line in lines if (said := _said(line)) is not None), None)
    if found is None or "LOCAL_CS" in found:
        return None
    try:
        crs = crs_of(found.strip())
    except CRSError as wrong:
        raise error(
            f"{path}: the CRS {shortened(found)} of a comment is not a known CRS; correct the comment, or remove it "
            "where coordinates are in the crs of survey.toml"
        ) from wrong
    # A comment on what heights count from does not tell where places are.
    return None if crs.is_vertical and not crs.is_compound else crs


def _said(line: str) -> str | None:
    """What a line of a file says of the CRS."""
    if match := _COMMENT.match(line):
        return match[1]
    if match := _SRID.fullmatch(line):
        return f"EPSG:{match[1]}"
    match = _CODE.fullmatch(line)
    return None if match is None else re.sub(r"\s*[:=]\s*", ":", match[1])
