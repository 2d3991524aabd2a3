"""The CRS that a table names in a comment, as Metashape writes it."""

from __future__ import annotations

import re
from pathlib import Path

from pyproj import CRS
from pyproj.exceptions import CRSError

from geo.crs import crs_of
from survey.errors import SurveyError
from survey.files.csv_table import shortened, text_lines

_COMMENT = re.compile(r"#\s*CoordinateSystem:\s*(.+)", re.IGNORECASE)


def crs_of_comment(path: Path, error: type[SurveyError]) -> CRS | None:
    """The CRS in the line ``# CoordinateSystem: WKT or code``; None where there is none, or one of the site.

    Raises
    ------
    error
        If it is not known.
    """
    lines = (line.strip() for _, line in text_lines(path, error))
    found = next((match[1] for line in lines if (match := _COMMENT.match(line))), None)
    if found is None or "LOCAL_CS" in found:
        return None
    try:
        return crs_of(found.strip())
    except CRSError as wrong:
        raise error(
            f"{path}: the CoordinateSystem {shortened(found)} is not a known CRS; correct the comment, or remove it "
            "where coordinates are in the crs of survey.toml"
        ) from wrong
