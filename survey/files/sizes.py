"""Sizes of memory in words."""

from __future__ import annotations

import math
import re

from survey.errors import SurveyError

_UNITS = {"": 1.0, "B": 1.0, "KB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}


def bytes_of(text: str) -> float:
    """Bytes of a size in words: "8GB", "500 MB", "2GiB".

    Raises
    ------
    SurveyError
        If it is none.
    """
    found = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]*)?)\s*([A-Za-z]*)\s*", text)
    if found is None or found[2].upper() not in _UNITS or float(found[1]) <= 0.0:
        raise SurveyError(f"--memory is {text!r}, expected a size such as 8GB or 500MB")
    return float(found[1]) * _UNITS[found[2].upper()]


def room(num_bytes: float) -> str:
    """Room that there is, rounded down."""
    if num_bytes >= 1e9:
        return f"{math.floor(num_bytes / 1e8) / 10:.1f} GB"
    return f"{math.floor(num_bytes / 1e7) * 10} MB"


def size(num_bytes: float) -> str:
    """Room that is needed."""
    return f"{num_bytes / 1e9:.1f} GB" if num_bytes >= 1e9 else f"{math.ceil(num_bytes / 1e7) * 10} MB"
