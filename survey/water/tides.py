"""Water level of each photograph: by a gauge, by a table of levels, or by a rate.

    gauge                 a series of time and level: interpolated at the time of each photograph
    image_levels          CSV with image, level (and std)
    level_rate_m_per_h    beside any other level, which is that of the mean time of the photographs, or of level_time

Each photograph has its level relative to `[water] level_m`, which becomes `PinholeCamera.tide`. Depths and heights over
the water count from level_m in all photographs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from refract import FlatWater
from survey.errors import FILE_NAME, ConfigError, Findings
from survey.files.csv_table import Table, words_of
from survey.photos.cameras import View, metres_per_px
from survey.photos.exif import Exif
from survey.photos.poses import ImageNames
from survey.settings.config import WaterConfig
from survey.water.gauge_files import Reading, is_no_data_number, read_series, utc_of
from survey.water.level_observation import LevelObservation, std_of
from survey.water.series import levels_at, require_levels

# A photograph without a time gets the mean level of the others, if these differ by no more than this [m], which moves
# the bed by less than 2 mm.
_MOST_UNKNOWN_M = 0.005
# Levels that move images by less than this are treated as one level: like pose errors (`survey.plan.plan`), they
# are negligible against the noise of matching.
MOST_SHIFT_PX = 0.1
_NO_TIME = datetime(1970, 1, 1, tzinfo=UTC)
# Rays nearer to the horizon are not used for the bed.
GRAZING_DEG = 70.0


@dataclass(frozen=True)
class Tide:
    """Level of the water over the time of the flight."""

    source: str  # The key of [water] that it comes from
    over: Mapping[str, float]  # name to float: level at each photograph [m] over `[water] level_m`
    # name to float: time of each photograph [h] after that of `level_m`; empty where times are not used
    hours: Mapping[str, float]
    # By how much the largest of `over` moves what a view of the survey shows; 0 before views are known
    shift_px: float = 0.0

    @property
    def moves_m(self) -> float:
        """Range from the lowest level to the highest [m]."""
        return float(np.ptp(list(self.over.values()))) if self.over else 0.0

    @property
    def matters(self) -> bool:
        """Whether photographs need levels of their own."""
        return self.shift_px > MOST_SHIFT_PX


@dataclass(frozen=True)
class MovingLevel:
    """Level of the water by a file that has it at several moments."""

    level_m: float  # [m]: mean at the photographs
    # [m]: what the distance of readings adds to the standard deviation of the mean
    gap_std_m: float
    tide: Tide
    observations: tuple[LevelObservation, ...]
    num_images: int  # Photographs with a time, or in the table
    findings: Findings


def tide_of_gauge(path: Path, water: WaterConfig, headers: Mapping[str, Exif], unit_m: float = 1.0) -> MovingLevel:
    """The mean level of the photographs and their tide, by a series whose levels have this unit [m]."""
    series = read_series(path, unit_m, water.gauge_zero_m)
    taken = _times(headers, f"no level can be interpolated from {path}; give level_m in {FILE_NAME}")
    moments = np.array(list(taken.values()))
    at, gap_std_m, readings, findings = levels_at(series, moments)
    mean = float(at.mean())
    over = dict(zip(taken, (at - mean).tolist(), strict=True))
    hours = ((moments - moments.mean()) / 3600.0).tolist()
    tide = Tide("gauge", _completed(over, headers), dict(zip(taken, hours, strict=True)))
    levels = tuple(LevelObservation(each.level_m, each.std_m, None, each.time, "gauge") for each in readings)
    return MovingLevel(mean, gap_std_m, tide, levels, len(taken), series.findings + findings)


def tide_of_levels(path: Path, headers: Mapping[str, Exif], unit_m: float = 1.0) -> MovingLevel:
    """The mean level of the photographs and their tide, by a table of levels in this unit [m]."""
    names, readings = ImageNames(headers), dict[str, Reading]()
    table = Table.read(path, words_of({"image": ("photo", "file", "name"), "level": (), "std": ()}), ConfigError)
    unit_m = table.units.get("level", unit_m)
    for row in table.rows(("image", "level"), ("std",)):
        # Photographs that are not there were left out.
        name = names.find(row.text("image"), row.where)
        if name in readings:
            raise ConfigError(f"{row.where}: {name} has a level already; keep one")
        if name is not None:
            level, time = row.number("level"), headers[name].taken or _NO_TIME
            std, is_marker = std_of(row, "image_levels"), is_no_data_number(level)
            readings[name] = Reading(row.where, time, level * unit_m, std, row.cells["level"], is_marker)
    without = [name for name in headers if name not in readings]
    if without:
        raise ConfigError(
            f"{path} has no level for {len(without)} of {len(headers)} images (first: {without[0]}); expected "
            "image,level with a row for each"
        )
    # In the order of exposure, or of the names.
    require_levels([reading for _, reading in sorted(readings.items(), key=lambda item: (item[1].time, item[0]))])
    mean = float(np.mean([each.level_m for each in readings.values()]))
    over = {name: readings[name].level_m - mean for name in headers}
    levels = tuple(
        LevelObservation(each.level_m, each.std_m, None, headers[name].taken, "image_levels")
        for name, each in readings.items()
    )
    return MovingLevel(mean, 0.0, Tide("image_levels", over, {}), levels, len(readings), Findings())


def tide_of_rate(water: WaterConfig, headers: Mapping[str, Exif]) -> Tide:
    """The tide by ``level_rate_m_per_h``."""
    rate = water.level_rate_m_per_h or 0.0
    taken = _times(headers, f"level_rate_m_per_h gives no levels; give levels of images in {FILE_NAME}")
    start = float(np.mean(list(taken.values())))
    if water.level_time is not None:
        start = utc_of(water.level_time, "[water] level_time").timestamp()
    hours = {name: (moment - start) / 3600.0 for name, moment in taken.items()}
    if water.level_rate_std_m_per_h is not None and len(hours) < len(headers):
        raise ConfigError(
            f"{len(headers) - len(hours)} of {len(headers)} images have no time of exposure in EXIF, and "
            "level_rate_std_m_per_h finds the rate of the level from all of them; leave them out, or remove it"
        )
    return Tide("level_rate_m_per_h", _completed({n: rate * h for n, h in hours.items()}, headers), hours)


def with_tides(views: Sequence[View], tide: Tide | None, water: FlatWater | None) -> tuple[list[View], Tide | None]:
    """Views with the levels of their photographs, where a level shifts the image by more than `MOST_SHIFT_PX`."""
    if tide is None or water is None:
        return list(views), None
    tide = with_shift(replace(tide, over={view.name: tide.over[view.name] for view in views}), views, water)
    if not tide.matters:
        return list(views), tide
    return [replace(view, camera=replace(view.camera, tide=tide.over[view.name])) for view in views], tide


def with_shift(tide: Tide, views: Sequence[View], water: FlatWater) -> Tide:
    """Tide of views, with the largest shift that it causes in their photographs.

    The most oblique ray of a view counts: one that enters the water a metre earlier runs that metre at its slope in
    water instead of that in air, ``tan a - tan b`` with ``sin a = n sin b``.
    """
    shifts = [0.0]
    for view in views:
        rays = view.camera.directions(view.camera.outline())
        cosine = np.nanmin(np.clip(-(rays @ np.array(water.up)), np.cos(np.radians(GRAZING_DEG)), 1.0))
        in_air, in_water = np.sqrt(1.0 - cosine**2), np.sqrt(1.0 - cosine**2) / water.n_water
        per_m = in_air / np.sqrt(1.0 - in_air**2) - in_water / np.sqrt(1.0 - in_water**2)
        shifts.append(abs(tide.over[view.name]) * float(per_m))
    return replace(tide, shift_px=max(shifts) / (metres_per_px(views, water) or np.inf))


def _times(headers: Mapping[str, Exif], lack: str) -> dict[str, float]:
    """Moments [s] of the photographs that have one; ConfigError where none has."""
    taken = {name: header.taken.timestamp() for name, header in headers.items() if header.taken is not None}
    if not taken:
        raise ConfigError(f"no image has its time in UTC (EXIF GPS time, DateTimeOriginal with an offset), so {lack}")
    return taken


def _completed(over: Mapping[str, float], headers: Mapping[str, Exif]) -> dict[str, float]:
    """Levels [m] of all photographs; those without a time have the mean, where that is good enough."""
    without, moves = [name for name in headers if name not in over], float(np.ptp(list(over.values())))
    if without and moves > _MOST_UNKNOWN_M:
        raise ConfigError(
            f"{len(without)} of {len(headers)} images have no time of exposure in EXIF (first: {without[0]}), while "
            f"the level moves by {1000.0 * moves:.0f} mm over the others; leave them out, or give [water] "
            "image_levels, a table of image,level"
        )
    return dict(over) | dict.fromkeys(without, float(np.mean(list(over.values()))))
