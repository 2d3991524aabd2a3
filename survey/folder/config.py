"""survey.toml: the settings of a survey, checked key by key, and written back with defaults filled in."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w

from survey.errors import ConfigError
from survey.files.toml_table import key, parse_toml, read_toml, require_one_of, require_positive

_ANY_LEVEL = ("level_m", "shoreline", "gnss_points", "gauge")
_TOPOCENTRIC = "topocentric east-north-up"

# Synonyms used by other programs.
_SYNONYMS = {
    "gcp": "control.gcps", "gcps": "control.gcps", "ground_control": "control.gcps", "control_points": "control.gcps",
    "check_points": "control.checkpoints", "epsg": "crs", "srs": "crs", "projection": "crs",
    "photos": "images.dir", "mask_dir": "images.masks", "lens": "cameras.model", "fx": "cameras.focal_px",
    "cx": "cameras.principal_point_px", "resolution": "cameras.size_px", "k1": "cameras.distortion",
    "gps": "cameras.gps_height", "ior": "water.refractive_index", "index": "water.refractive_index",
    "tide": "water.gauge", "roi": "area.bounds", "extent": "area.bounds", "bbox": "area.bounds",
}  # fmt: skip

# Keys that a later version will read, and what to do until then.
_NOT_YET = {
    "water.mask": "the sweep detects wet areas itself; remove it",
    "water.level_std_m": "remove it; process --calibrate-water estimates the level and its uncertainty",
    "water.index_std": "remove it; process --calibrate-water estimates the index and its uncertainty",
    "water.slope_std": "remove it; process --calibrate-water estimates the slopes and their uncertainty",
    "cameras.position_std_m": "remove it; structure from motion estimates the accuracy of the GPS positions",
    "cameras.rotation_std_deg": "remove it; poses from a file are not adjusted",
    "control.gcps": "give camera poses that are already adjusted to the control points",
    "control.checkpoints": "remove it and give the file to bathynerf compare --checkpoints",
    "control.std_m": "give camera poses that are already adjusted to the control points",
}


@dataclass(frozen=True)
class ImagesConfig:
    """[images]: where the photographs are, relative to the survey folder."""

    dir: str = "images"
    masks: str | None = None  # folder of masks named like the images; black is left out


@dataclass(frozen=True)
class CamerasConfig:
    """[cameras]: poses, and the lens where the poses file has none; the first pixel's centre is 0.5, 0.5."""

    poses: str | None = None
    model: str | None = None
    size_px: tuple[int, int] | None = key(None, "[width, height] in whole pixels")
    focal_px: float | tuple[float, float] | None = key(None, "one focal length or [fx, fy] in pixels")
    principal_point_px: tuple[float, float] | None = key(None, "[x, y] in pixels")
    distortion: tuple[float, ...] | None = key(None, "a list of coefficients, e.g. [k1, k2, p1, p2]")
    gps_height: str = "crs"

    def __post_init__(self):
        if self.size_px is not None and min(self.size_px) < 1:
            raise ConfigError(f"cameras.size_px is {list(self.size_px)}, expected [width, height] in whole pixels")
        focal = self.focal_px if isinstance(self.focal_px, tuple) else (self.focal_px,)
        for value in focal:
            require_positive("cameras", focal_px=value)
        if self.distortion is not None and self.model is None:
            raise ConfigError(
                '[cameras] distortion is given without model; give e.g. model = "OPENCV" with k1, k2, p1, p2'
            )
        if self.gps_height not in ("crs", "ellipsoidal"):
            raise ConfigError(
                f'[cameras] gps_height is "{self.gps_height}", expected "crs" (EXIF heights are heights in crs) or '
                '"ellipsoidal"'
            )
        if self.principal_point_px is not None and self.size_px is not None:
            inside = all(0.0 < p < s for p, s in zip(self.principal_point_px, self.size_px, strict=True))
            if not inside:
                raise ConfigError(
                    f"[cameras] principal_point_px {list(self.principal_point_px)} lies outside the image of size_px "
                    f"{list(self.size_px)}; expected pixels from the upper left corner"
                )


@dataclass(frozen=True)
class WaterConfig:
    """[water]: a plane through ``level_m`` at ``level_at``, with its rise per metre along the grid axes."""

    level_m: float | None = None  # None only until the file that is named instead is read
    level_at: tuple[float, float] | None = key(None, "[easting, northing]")
    slope_east: float = 0.0
    slope_north: float = 0.0
    refractive_index: float | None = None
    temperature_c: float | None = None
    salinity_psu: float | None = None
    absorption_per_m: tuple[float, float, float] | None = key(
        None, "[red, green, blue], the share of light that a metre of water takes, e.g. [0.3, 0.07, 0.05]"
    )
    veiling_light: tuple[float, float, float] | None = key(
        None, "[red, green, blue], linear light of endless water, 1 for white, e.g. [0.03, 0.17, 0.2]"
    )
    shoreline: str | None = None  # CSV of points, easting, northing, height, where water meets land
    gnss_points: str | None = None  # the same, of points anywhere on the surface
    gauge: str | None = None  # CSV of time, level

    def __post_init__(self):
        self._require_one_level()
        self._require_one_index()
        self._require_colour()

    @property
    def known_level_m(self) -> float:
        """``level_m`` of settings for which the file that may be named instead was read.

        Raises
        ------
        ValueError
            While the level is still to be read from a file.
        """
        if self.level_m is None:
            raise ValueError("level_m is not known before the file that [water] names instead is read")
        return self.level_m

    @property
    def known_level_at(self) -> tuple[float, float]:
        """``level_at`` of the settings of a loaded survey, which have its default filled in.

        Raises
        ------
        ValueError
            Before it is.
        """
        if self.level_at is None:
            raise ValueError("level_at is not known before its default is filled in from the cameras")
        return self.level_at

    def _require_one_level(self) -> None:
        levels = [name for name in _ANY_LEVEL if getattr(self, name) is not None]
        if not levels:
            raise ConfigError(
                "level_m is missing from [water]. Give the height of the water surface in the survey's vertical "
                "datum, e.g. level_m = 12.34, or a file of points or readings as shoreline, gnss_points or gauge, or "
                "remove [water] for a dry survey"
            )
        if len(levels) > 1:
            raise ConfigError(
                f"[water] has {' and '.join(levels)}, each of which gives the height of the water; keep one"
            )

    def _require_one_index(self) -> None:
        by_water = [name for name in ("temperature_c", "salinity_psu") if getattr(self, name) is not None]
        if self.refractive_index is not None and by_water:
            raise ConfigError(
                f"[water] has both refractive_index and {' and '.join(by_water)}, which contradict each other; keep one"
            )
        if by_water == ["salinity_psu"]:
            raise ConfigError(
                "[water] has salinity_psu without temperature_c; give temperature_c too, or refractive_index"
            )

    def _require_colour(self) -> None:
        values = {name: getattr(self, name) for name in ("absorption_per_m", "veiling_light")}
        known = [name for name, value in values.items() if value is not None]
        for name in known:
            if min(values[name]) < 0.0:
                raise ConfigError(f"water.{name} is {list(values[name])}, expected [red, green, blue], none below zero")
        if len(known) == 1:
            raise ConfigError(
                f"[water] has {known[0]} alone, expected absorption_per_m and veiling_light together; give both "
                "(veiling_light = [0, 0, 0] for water that scatters nothing) or neither"
            )


@dataclass(frozen=True)
class AreaConfig:
    """[area]: the region to reconstruct."""

    bounds: tuple[float, float, float, float] | None = key(
        None, "[easting_low, northing_low, easting_high, northing_high]"
    )
    heights: tuple[float, float] | None = key(None, "[low, high], in the heights of crs")

    def __post_init__(self):
        if self.bounds is not None and not (self.bounds[0] < self.bounds[2] and self.bounds[1] < self.bounds[3]):
            raise ConfigError(
                f"area.bounds is {list(self.bounds)}, expected [easting_low, northing_low, easting_high, "
                "northing_high] with low below high"
            )
        if self.heights is not None and not self.heights[0] < self.heights[1]:
            raise ConfigError(
                f"area.heights is {list(self.heights)}, expected [low, high] in metres with low below high; swap or "
                "correct them"
            )


@dataclass(frozen=True)
class LocalConfig:
    """[local]: the topocentric frame that COLMAP poses are in; its origin in crs."""

    frame: str = _TOPOCENTRIC
    origin: tuple[float, float, float] | None = key(None, "[easting, northing, height]")

    def __post_init__(self):
        require_one_of("local.frame", self.frame, (_TOPOCENTRIC,))


@dataclass(frozen=True)
class SurveyConfig:
    """All of survey.toml."""

    name: str | None = None
    crs: str | None = key(None, 'a text with a vertical part, e.g. crs = "EPSG:25832+5778"')
    images: ImagesConfig = field(default_factory=ImagesConfig)
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    water: WaterConfig | None = None
    area: AreaConfig = field(default_factory=AreaConfig)
    local: LocalConfig = field(default_factory=LocalConfig)


def read_config(path: Path) -> SurveyConfig:
    """Read and check survey.toml.

    Raises
    ------
    ConfigError
        If the file is not TOML, or a key is unknown, of the wrong kind, not supported yet or contradicts
        another.
    """
    return read_toml(path, parse_config)


def parse_config(text: str) -> SurveyConfig:
    """The settings in a text in TOML; see `read_config`."""
    config = parse_toml(text, SurveyConfig, synonyms=_SYNONYMS, not_yet=_NOT_YET)
    if config.water is not None:
        _require_sane(config.water)
    return config


def _require_sane(water: WaterConfig) -> None:
    """Raise ConfigError if a number is out of range; estimated ones may be, and their verdict reports it."""
    if water.refractive_index is not None and not 1.0 <= water.refractive_index <= 1.6:
        raise ConfigError(
            f"[water] refractive_index is {water.refractive_index:g}, expected 1.0 to 1.6 relative to air; fresh water "
            "has 1.333, sea water 1.340"
        )
    for name, slope in (("slope_east", water.slope_east), ("slope_north", water.slope_north)):
        if abs(slope) > 0.2:
            raise ConfigError(
                f"[water] {name} is {slope:g}, expected a rise in metres per metre of at most 0.2; a river has about "
                "0.001 to 0.01"
            )


def dump_config(config: SurveyConfig) -> str:
    """The settings as TOML that `parse_config` reads back to the same settings."""
    return tomli_w.dumps(_without_none(dataclasses.asdict(config)))


def _without_none(table: dict) -> dict:
    return {
        name: _without_none(value) if isinstance(value, dict) else value
        for name, value in table.items()
        if value is not None
    }
