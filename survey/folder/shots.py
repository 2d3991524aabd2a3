"""Photographs that do not belong together: of several cameras at one shot, of several days under one level."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import PurePosixPath

from survey.photos.exif import Exif
from survey.settings.config import SurveyConfig

# Cameras of one payload are released within this.
_ONE_SHOT_S = 1.0
# Longer gaps than that of a night lie between days.
_NEXT_DAY = timedelta(hours=8)


def shot_warnings(config: SurveyConfig, headers: Mapping[str, Exif]) -> list[str]:
    """Warnings about shots by several cameras, as wide and thermal ones, and about days that share a level."""
    return [*_several_cameras(headers), *_several_days(config, headers)]


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
