"""Geoid grids that a user keeps beside the data, for PROJ to find."""

from __future__ import annotations

import os
from pathlib import Path

from pyproj import datadir

_SUFFIXES = (".tif", ".gtx")


def use_grids(folder: Path) -> list[Path]:
    """Let PROJ find the grids (.tif, .gtx) in a folder, for the rest of the process; returns them.

    A grid is found by its own name, e.g. us_nga_egm96_15.tif or, of the same model, egm96_15.gtx.
    """
    if not folder.is_dir():
        return []
    grids = sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES)
    known = datadir.get_data_dir().split(os.pathsep)
    if grids and str(folder.resolve()) not in known:
        datadir.append_data_dir(str(folder.resolve()))
    return grids
