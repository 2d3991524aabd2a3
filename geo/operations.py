"""PROJ's operations between two CRSs at a place, cached, and geoid grids in a folder of the user."""

from __future__ import annotations

import os
import warnings
from functools import lru_cache
from pathlib import Path
from threading import get_ident

from pyproj import CRS, datadir
from pyproj.transformer import AreaOfInterest, TransformerGroup

# Around the middle of a survey, for PROJ to choose among regional operations [deg].
_AREA_DEG = 0.01
_SUFFIXES = (".tif", ".gtx")


def operations(source: CRS | str, target: CRS | str, area: AreaOfInterest | None) -> TransformerGroup:
    """All operations that PROJ knows between two CRSs, with or without heights, at a place; the best first."""
    # Cached, since a search takes PROJ some 10 ms: anew where a folder of grids was added, and for each thread, since
    # threads must not share transformers.
    return _operations(_text(source), _text(target), area, datadir.get_data_dir(), get_ident())


def _text(crs: CRS | str) -> str:
    return crs if isinstance(crs, str) else crs.srs


@lru_cache(maxsize=64)
def _operations(source: str, target: str, area: AreaOfInterest | None, _folders: str, _thread: int) -> TransformerGroup:
    with warnings.catch_warnings():
        # pyproj warns of missing grids, which callers name in their own words.
        warnings.simplefilter("ignore", UserWarning)
        return TransformerGroup(source, target, always_xy=True, allow_ballpark=False, area_of_interest=area)


def area_about(lon_deg: float, lat_deg: float, margin_deg: float = _AREA_DEG) -> AreaOfInterest:
    """Area of interest about a survey, for PROJ to choose among regional operations."""
    south, north = max(lat_deg - margin_deg, -90.0), min(lat_deg + margin_deg, 90.0)
    return AreaOfInterest(lon_deg - margin_deg, south, lon_deg + margin_deg, north)


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
