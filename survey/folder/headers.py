"""Headers of the photographs of a survey, and what in them is more likely a mistake.

Positions far from the others, or twice the same; photographs of several cameras at one shot, of several days under one
level; pages, rotations and datums.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from geo.crs import EARTH_RADIUS_M
from survey.display.quantities import named
from survey.errors import Findings
from survey.folder.geo_txt import find_geo_txt, with_positions
from survey.photos.exif import Exif, read_exif, without_void_fixes
from survey.settings.config import SurveyConfig

# A position is far from the others beyond this many times their usual spread, and these lengths [m]. If more than this
# share of positions is far, they are another part of the flight.
_FAR, _FAR_HEIGHT_M, _FAR_PLAN_M, _MOST_FAR = 10.0, 10.0, 50.0, 0.1
_FEWEST = 4
# Gap beyond which positions are of another survey [m].
_ELSEWHERE_M = 5000.0
# Receivers give one position per second, and camera clocks have whole seconds.
_BETWEEN_FIXES_S = 2.0
# Cameras of one payload are released within this.
_ONE_SHOT_S = 1.0
# Longer gaps than that of a night lie between days.
_NEXT_DAY = timedelta(hours=8)


def read_headers(folder: Path, place: Path, images: Mapping[str, Path]) -> tuple[dict[str, Exif], Findings]:
    """EXIF of the photographs in a place of a survey folder, with the positions of a geo.txt where there is one."""
    headers, findings = {name: read_exif(path) for name, path in images.items()}, Findings()
    if (table := find_geo_txt(folder, place)) is not None:
        headers, findings = with_positions(table, headers)
    return without_void_fixes(headers), findings


def header_warnings(config: SurveyConfig, headers: Mapping[str, Exif]) -> list[str]:
    """Warnings about EXIF of the photographs."""
    num = len(headers)
    rotated = sum(header.orientation != 1 for header in headers.values())
    paged = sum(header.has_pages for header in headers.values())
    warnings = []
    for fault in dict.fromkeys(header.gps_fault for header in headers.values() if header.gps_fault):
        without = [name for name, header in headers.items() if header.gps_fault == fault]
        warnings += named(without, "image", f"without {fault} in EXIF, whose GPS position is not used")
    void = [name for name, header in headers.items() if header.is_void and header.lat_lon_height is not None]
    warnings += named(void, "image", "whose receiver had no fix by EXIF (GPSStatus is V), and whose position is used")
    for datum in dict.fromkeys(header.gps_datum for header in headers.values() if header.gps_datum):
        such = [name for name, header in headers.items() if header.gps_datum == datum and header.table_place is None]
        warnings += named(such, "image", f"with a GPS position on {datum} by EXIF or XMP, which is taken as WGS 84")
    for warning in dict.fromkeys(header.focal_warning for header in headers.values() if header.focal_warning):
        such = [name for name, header in headers.items() if header.focal_warning == warning]
        warnings += named(such, "image", f"with {warning}; give [cameras] focal_px if it is known")
    if rotated:
        warnings.append(f"EXIF marks {rotated} of {num} images as rotated; pixels and poses are taken as stored")
    if paged:
        warnings.append(f"{paged} of {num} images have several pages, of which the first is used; split files of bands")
    return [*warnings, *position_warnings(headers), *_several_cameras(headers), *_several_days(config, headers)]


def position_warnings(headers: Mapping[str, Exif]) -> list[str]:
    """Warnings that name the photographs whose GPS position or height lies far from all others, or is that of one."""
    known = {name: header for name, header in headers.items() if header.lat_lon_height is not None}
    if len(known) < _FEWEST:
        return []
    names, places = np.array(list(known)), np.array([header.lat_lon_height for header in known.values()])
    # Longitudes are unwrapped across the antimeridian, relative to the first.
    east_deg = places[:, 1] - places[0, 1]
    plan = EARTH_RADIUS_M * np.radians(np.column_stack([places[:, 0], (east_deg + 180.0) % 360.0 - 180.0]))
    plan[:, 1] *= np.cos(np.radians(np.median(places[:, 0])))
    clocks = [header.clock for header in known.values() if header.clock is not None]
    seconds = None
    if len(clocks) == len(known):
        seconds = np.array([(clock - clocks[0]).total_seconds() for clock in clocks])
    # Poses that also share their rotation are reported where poses are read.
    return [
        *far_from_others(names, plan, places[:, 2], "GPS"),
        *_repeated_positions(names, np.column_stack([plan, places[:, 2]]), seconds),
    ]


def far_from_others(names: np.ndarray, plan: np.ndarray, height: np.ndarray, by: str) -> list[str]:
    """Warnings that name the photographs whose place (N, 2) or height (N,) [m], NaN where unknown, is far from all.

    ``by`` is their source, "GPS" or "pose".
    """
    if len(names) < _FEWEST:
        return []
    main = _largest_group(plan)
    warnings = named(names[~main].tolist(), "image", f"kilometres away from the others by {by}: of another survey?")
    nearest = KDTree(plan).query(plan, k=2)[0][:, 1]
    alone = main & (nearest > max(_FAR * float(np.median(nearest)), _FAR_PLAN_M))
    warnings += named(_few(names, alone), "image", f"far from all others by its {by} position")
    with_height = np.isfinite(height)
    return warnings + _far_in_height(names[with_height], height[with_height], by)


def _far_in_height(names: np.ndarray, heights: np.ndarray, by: str) -> list[str]:
    """Warnings that name the photographs whose height (N,) [m] is far from the others."""
    if len(heights) < _FEWEST:
        return []
    deviation = np.abs(heights - np.median(heights))
    far = deviation > max(_FAR * float(np.median(deviation)), _FAR_HEIGHT_M)
    # Exactly 0 is what receivers write without a height: no other flight, however many have it.
    no_height = far & (heights == 0.0)
    low, high = heights[~far].min(), heights[~far].max()
    labels = np.array([f"{name} ({of_it:.1f} m)" for name, of_it in zip(names, heights, strict=True)])
    return named(
        labels[no_height].tolist() + _few(labels, far & ~no_height),
        "image",
        f"far from the others by its {by} height, which are at {low:.1f} to {high:.1f} m",
    )


def _repeated_positions(names: np.ndarray, places: np.ndarray, seconds: np.ndarray | None) -> list[str]:
    """Warnings about photographs (N,) that share a position (N, 3) to the last digit.

    Except those taken at once, or between two fixes of the receiver: bands, brackets, rigs and bursts.
    """
    alike = defaultdict(list)
    for number, place in enumerate(places):
        alike[place.tobytes()].append(number)
    if len(alike) == 1:
        return [f"all {len(names)} images have the same GPS position to the last digit: it tells nothing of them"]
    repeated = [
        number
        for group in alike.values()
        for number in group[1:]
        if seconds is None or abs(seconds[number] - seconds[group[0]]) > _BETWEEN_FIXES_S
    ]
    return named(names[repeated].tolist(), "image", "with the GPS position of an earlier one to the last digit")


def _largest_group(plan: np.ndarray) -> np.ndarray:
    """Mask (N,) bool of the places (N, 2) [m] of the largest group. Groups are at least `_ELSEWHERE_M` apart."""
    squares, square = np.unique(np.floor(plan / _ELSEWHERE_M), axis=0, return_inverse=True)
    adjacent = np.array(list(KDTree(squares).query_pairs(1.0, p=np.inf))).reshape(-1, 2)
    linked = coo_array((np.ones(len(adjacent)), tuple(adjacent.T)), shape=(len(squares), len(squares)))
    group = connected_components(linked, directed=False)[1][square.ravel()]
    return group == np.bincount(group).argmax()


def _few(names: np.ndarray, far: np.ndarray) -> list[str]:
    """Names of the far photographs, where these are few enough to be wrong."""
    return names[far].tolist() if far.sum() <= max(1, int(_MOST_FAR * len(names))) else []


def _several_cameras(headers: Mapping[str, Exif]) -> list[str]:
    """A warning where most shots have photographs of several sizes: of a thermal or multispectral camera, too."""
    by_shot: dict[tuple, set[tuple[int, int]]] = defaultdict(set)
    for name, header in headers.items():
        clock = None if header.clock is None else round(header.clock.timestamp() / _ONE_SHOT_S)
        by_shot[clock, name.rpartition("/")[0] if clock is None else "", _number(name)].add(header.size_px)
    sizes = Counter(header.size_px for header in headers.values())
    if len(sizes) < 2 or 2 * sum(len(shot) > 1 for shot in by_shot.values()) < len(by_shot):
        return []
    kinds = []
    for (width, height), num in sizes.most_common():
        own = (PurePosixPath(name).stem for name, header in headers.items() if header.size_px == (width, height))
        endings = {stem.rpartition("_")[2] for stem in own}
        named = f" (*_{endings.pop()})" if len(endings) == 1 else ""
        kinds.append(f"{num} of {width} x {height} px{named}")
    return [f"each shot has photographs of several cameras: {' and '.join(kinds)}; keep one, as others do not match"]


def _number(name: str) -> str:
    """The last number in the name of a photograph; those of one shot share it."""
    digits = "".join(letter if letter.isdigit() else " " for letter in PurePosixPath(name).stem).split()
    return digits[-1] if digits else ""


def _several_days(config: SurveyConfig, headers: Mapping[str, Exif]) -> list[str]:
    """A warning where one level is given for photographs of several days."""
    water = config.water
    if water is None or not water.gives_level or water.rate.level_rate_m_per_h is not None:
        return []
    if water.sources.gauge is not None or water.sources.image_levels is not None:
        return []
    times = sorted(clock for header in headers.values() if (clock := header.clock) is not None)
    days: list[list[datetime]] = []
    for time in times:
        if not days or time - days[-1][-1] > _NEXT_DAY:
            days.append([])
        days[-1].append(time)
    if len(days) < 2:
        return []
    said = ", ".join(f"{day[0]:%Y-%m-%d}: {len(day)}" for day in days[:5])
    return [f"photographs of {len(days)} days ({said}) have one level: give image_levels or gauge, or split the survey"]
