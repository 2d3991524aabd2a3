"""Warnings about image headers: rotation, several pages, positions far from the others."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from geo.crs import EARTH_RADIUS_M
from survey.display.words import named
from survey.photos.exif import Exif

# A position is far from the others beyond so many times what is usual among them, and these lengths [m]; more than this
# share of positions is another part of the flight.
_FAR, _FAR_HEIGHT_M, _FAR_PLAN_M, _MOST_FAR = 10.0, 10.0, 50.0, 0.1
_FEWEST = 4
# Between parts of one survey [m]: no flight leaves so much out.
_ELSEWHERE_M = 5000.0


def head_doubts(heads: Mapping[str, Exif]) -> list[str]:
    """Warnings about photographs that are not used as another program may show them."""
    num = len(heads)
    rotated = sum(head.orientation != 1 for head in heads.values())
    paged = sum(head.has_pages for head in heads.values())
    warnings = []
    for fault in dict.fromkeys(head.gps_fault for head in heads.values() if head.gps_fault):
        without = [name for name, head in heads.items() if head.gps_fault == fault]
        warnings += named(without, "image", f"without {fault} in EXIF, whose GPS position is not used")
    for datum in dict.fromkeys(head.gps_datum for head in heads.values() if head.gps_datum):
        such = [name for name, head in heads.items() if head.gps_datum == datum and head.table_place is None]
        warnings += named(such, "image", f"with a GPS position on {datum} by EXIF or XMP, which is taken as WGS 84")
    for doubt in dict.fromkeys(head.focal_doubt for head in heads.values() if head.focal_doubt):
        such = [name for name, head in heads.items() if head.focal_doubt == doubt]
        warnings += named(such, "image", f"with {doubt}; give [cameras] focal_px if it is known")
    if rotated:
        warnings.append(
            f"EXIF marks {rotated} of {num} images as rotated; pixels are used as stored and poses are assumed to "
            "refer to them"
        )
    if paged:
        warnings.append(
            f"{paged} of {num} images have several pages, of which the first is used; if they are bands or other "
            "photographs, split them"
        )
    return warnings + position_doubts(heads)


def position_doubts(heads: Mapping[str, Exif]) -> list[str]:
    """Warnings that name the photographs whose GPS position or height lies far from all others."""
    known = {name: head.lat_lon_height for name, head in heads.items() if head.lat_lon_height is not None}
    if len(known) < _FEWEST:
        return []
    names, places = np.array(list(known)), np.array(list(known.values()))
    # Across the meridian of 180 degrees longitudes go on, from the first.
    away = places[:, 1] - places[0, 1]
    plan = EARTH_RADIUS_M * np.radians(np.column_stack([places[:, 0], (away + 180.0) % 360.0 - 180.0]))
    plan[:, 1] *= np.cos(np.radians(np.median(places[:, 0])))
    main = _largest_group(plan)
    warnings = named(names[~main].tolist(), "image", "kilometres away from the others by GPS: of another survey?")
    apart = KDTree(plan).query(plan, k=2)[0][:, 1]
    warnings += named(
        _few(names, main & (apart > max(_FAR * float(np.median(apart)), _FAR_PLAN_M))),
        "image",
        "far from all others by its GPS position",
    )
    with_height = np.isfinite(places[:, 2])
    heights = places[with_height, 2]
    if len(heights) < _FEWEST:
        return warnings
    off = np.abs(heights - np.median(heights))
    far = off > max(_FAR * float(np.median(off)), _FAR_HEIGHT_M)
    low, high = heights[~far].min(), heights[~far].max()
    said = [f"{name} ({height:.1f} m)" for name, height in zip(names[with_height], heights, strict=True)]
    return warnings + named(
        _few(np.array(said), far),
        "image",
        f"far from the others by its GPS height, which are at {low:.1f} to {high:.1f} m",
    )


def _largest_group(plan: np.ndarray) -> np.ndarray:
    """Which places (N, 2) [m] are of the largest group: (N,) bool. Groups are at least `_ELSEWHERE_M` apart."""
    squares, square = np.unique(np.floor(plan / _ELSEWHERE_M), axis=0, return_inverse=True)
    beside = np.array(list(KDTree(squares).query_pairs(1.0, p=np.inf))).reshape(-1, 2)
    linked = coo_array((np.ones(len(beside)), tuple(beside.T)), shape=(len(squares), len(squares)))
    group = connected_components(linked, directed=False)[1][square.ravel()]
    return group == np.bincount(group).argmax()


def _few(names: np.ndarray, far: np.ndarray) -> list[str]:
    """The names that are far, where they are few enough to be wrong."""
    return names[far].tolist() if far.sum() <= max(1, int(_MOST_FAR * len(names))) else []
