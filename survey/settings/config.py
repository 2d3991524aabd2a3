"""survey.toml: the settings of a survey, checked key by key, and written back with defaults filled in."""

import dataclasses
import math
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomli_w

from survey.errors import FILE_NAME, ConfigError, SurveyError
from survey.files.paths import require_plain, require_plain_entries
from survey.files.remote import is_url, local_name
from survey.files.toml_table import key, parse_toml, read_toml, require_with, std_key, table_of
from survey.settings.tables import ControlConfig, FieldConfig, ProcessConfig

# The slowest sensors of drones read a whole frame in a tenth of a second.
_LONGEST_READOUT_S = 0.25
_FASTEST_M_S = 50.0
_TOPOCENTRIC = "topocentric east-north-up"

# Synonyms used by other programs.
_SYNONYMS = {
    "gcp": "control.gcps", "gcps": "control.gcps", "ground_control": "control.gcps", "control_points": "control.gcps",
    "check_points": "control.checkpoints", "epsg": "crs", "srs": "crs", "projection": "crs",
    "photos": "images.dir", "mask_dir": "images.masks", "lens": "cameras.model", "fx": "cameras.focal_px",
    "cx": "cameras.principal_point_px", "resolution": "cameras.size_px", "k1": "cameras.distortion",
    "gps": "cameras.gps_height", "ior": "water.refractive_index", "index": "water.refractive_index",
    "tide": "water.gauge", "water_level": "water.level_m", "level": "water.level_m", "level_ft": "water.level_m",
    "n_water": "water.refractive_index", "surface_level": "water.level_m", "water_level_m": "water.level_m",
    "roi": "area.bounds",
    "extent": "area.bounds", "bbox": "area.bounds", "no_water": "dry", "is_dry": "dry",
}  # fmt: skip

MOST_LEVEL_STD_M = 10.0
# Slope of a water surface at most: steeper than 0.065 a stream is a cascade, white water that shows no bed
# (D. R. Montgomery and J. M. Buffington, Channel-reach morphology in mountain drainage basins, 1997).
MOST_SLOPE = 0.065
# Filling locks and the largest tidal bores rise faster, and nobody flies there for the bed.
MOST_RATE_M_PER_H = 10.0


# Keys of the files that give the level, at most one; of the light or water that the index belongs to, none of which a
# loaded survey has.
LEVEL_FILES = ("shoreline", "gnss_points", "surface", "gauge", "image_levels", "clicks")
NO_LEVEL_FILES: dict[str, Any] = dict.fromkeys(LEVEL_FILES)
NO_MEDIUM: dict[str, Any] = dict.fromkeys(("index_wavelength_nm", "temperature_c", "salinity_psu"))
METRES, FEET = "metres", "feet"
# What editors and file managers make of the name of the settings.
_NEAR_NAMES = (FILE_NAME, *(f"{FILE_NAME}{ending}" for ending in (".txt", ".toml", ".bak")), "survey.tml")


@dataclass(frozen=True)
class ImagesConfig:
    """[images]: where the photographs are, relative to the survey folder, or a URL."""

    dir: str = "images"
    masks: str | None = None  # folder of masks named like the images; black is left out

    def __post_init__(self):
        if is_url(self.masks):
            raise ConfigError(
                f'[images] masks is "{self.masks}", expected a folder; put masks beside the images, named like them '
                "with _mask behind, or in a folder of the survey"
            )

    @property
    def local_dir(self) -> str:
        """Folder of these on this machine: for a URL a hidden folder of the survey that they are fetched into."""
        return local_name(self.dir, "photographs") if is_url(self.dir) else self.dir


@dataclass(frozen=True)
class CamerasConfig:
    """[cameras]: poses, and the lens where the poses file has none; the first pixel's centre is 0.5, 0.5."""

    poses: str | None = None
    model: str | None = None
    size_px: tuple[int, int] | None = key(None, "[width, height] in whole pixels", least=1)
    focal_px: float | tuple[float, float] | None = key(None, "one focal length or [fx, fy] in pixels, above 0", above=0)
    principal_point_px: tuple[float, float] | None = key(None, "[x, y] in pixels")
    distortion: tuple[float, ...] | None = key(None, "a list of coefficients, e.g. [k1, k2, p1, p2]")
    gps_height: str = key(
        "crs", "crs (heights in EXIF are heights in crs) or ellipsoidal", one_of=("crs", "ellipsoidal")
    )
    position_std_m: float | tuple[float, float, float] | None = std_key(
        100.0, "metres", "GPS has about 3, with corrections 0.03", "one number or [east, north, up]"
    )
    rotation_std_deg: float | tuple[float, float, float] | None = std_key(
        45.0,
        "degrees",
        "poses of an adjusted block have about 0.01, the angles of a gimbal 1",
        "one number or [omega, phi, kappa]",
    )
    rolling_shutter_s: float | None = key(
        None,
        f"seconds from the first to the last row, at most {_LONGEST_READOUT_S:g}; cameras of drones need about 0.01 to "
        "0.08, and a mechanical shutter 0",
        least=0.0,
        most=_LONGEST_READOUT_S,
    )
    rolling_shutter_std_s: float | None = std_key(
        _LONGEST_READOUT_S, "seconds", "0.02 if the readout is nearly unknown"
    )
    speed_m_s: float | None = key(
        None,
        f"metres per second along the flight lines, above 0 and at most {_FASTEST_M_S:g}",
        above=0.0,
        most=_FASTEST_M_S,
    )

    def __post_init__(self):
        require_with("cameras", self, "rolling_shutter_s", ("rolling_shutter_std_s", "speed_m_s"))
        require_with("cameras", self, "model", ("distortion",), 'e.g. model = "OPENCV" with k1, k2, p1, p2')
        point, size = self.principal_point_px, self.size_px
        if point is not None and size is not None and not all(0.0 < p < s for p, s in zip(point, size, strict=True)):
            raise ConfigError(
                f"[cameras] principal_point_px {list(point)} lies outside the image of size_px {list(size)}; expected "
                "pixels from the upper left corner"
            )

    @property
    def square_focal_px(self) -> float | None:
        """The focal length [px] of square pixels, for structure from motion; raises where they are not square."""
        if not isinstance(self.focal_px, tuple | list):
            return self.focal_px
        if self.focal_px[0] != self.focal_px[1]:
            raise SurveyError(
                f"[cameras] focal_px in {FILE_NAME} is {list(self.focal_px)}, and structure from motion solves for "
                "square pixels; give one number, or poses made elsewhere in [cameras] poses"
            )
        return self.focal_px[0]

    @property
    def rolls(self) -> bool:
        """Whether the shutter rolls, by a readout or by one that is to be found."""
        return bool(self.rolling_shutter_s) or self.rolling_shutter_std_s is not None


@dataclass(frozen=True)
class WaterConfig:
    """[water]: a plane through ``level_m`` at ``level_at``, with its rise per metre along the grid axes."""

    level_m: float | None = None  # None only until the file that is named instead is read
    level_at: tuple[float, float] | None = key(None, "[easting, northing]")
    slope_east: float = 0.0
    slope_north: float = 0.0
    # Of the light that is matched, unless index_wavelength_nm tells another
    refractive_index: float | None = key(
        None, "1.0 to 1.6 relative to air; fresh water has 1.333, sea water 1.340", least=1.0, most=1.6
    )
    index_wavelength_nm: float | None = key(
        None, "400 to 700, the wavelengths of light; an index from a handbook belongs to 589.3", least=400.0, most=700.0
    )
    temperature_c: float | None = None
    salinity_psu: float | None = None
    absorption_per_m: tuple[float, float, float] | None = key(
        None, "[red, green, blue], the absorption coefficient in 1/m, none below 0, e.g. [0.3, 0.07, 0.05]", least=0.0
    )
    veiling_light: tuple[float, float, float] | None = key(
        None,
        "[red, green, blue], linear light of endless water, 0 for none, 1 for white, e.g. [0.03, 0.17, 0.2]",
        least=0.0,
    )
    shoreline: str | None = None  # CSV of points, easting, northing, height, or a vector file, where water meets land
    gnss_points: str | None = None  # the same, of points anywhere on the surface
    surface: str | None = None  # the same or a GeoTIFF, of water that is not a plane
    gauge: str | None = None  # series of time and level: CSV, or a form of NOAA, PEGELONLINE or USGS
    image_levels: str | None = None  # CSV of image, level
    clicks: str | None = None  # CSV of image, x, y, name: places of the waterline in two photographs or more
    # At which the level rises, which then holds at level_time; with a std, the adjustment finds it
    level_rate_m_per_h: float | None = key(
        None,
        f"metres per hour, at most {MOST_RATE_M_PER_H:g} up or down; tides have up to 3",
        least=-MOST_RATE_M_PER_H,
        most=MOST_RATE_M_PER_H,
    )
    level_rate_std_m_per_h: float | None = std_key(
        MOST_RATE_M_PER_H, "metres per hour", "0.3 if the tide is nearly unknown"
    )
    level_time: str | None = key(None, "a time with its zone, e.g. 2024-06-01T10:30:00Z")
    gauge_zero_m: float | None = None  # height in crs from which the readings of the gauge count
    layer: str | None = None  # of the file of points or lines, the one that is the water
    # Standard deviations, for the adjustment
    level_std_m: float | None = std_key(MOST_LEVEL_STD_M, "metres", "a staff has about 0.02, a gauge 0.01")
    index_std: float | None = std_key(0.1, "", "temperature and salinity give the index to 0.0005")
    slope_std: float | None = std_key(0.2, "metres per metre", "a river slopes by 0.001 to 0.01")

    def __post_init__(self):
        for other, names, remedy in (
            ("level_rate_m_per_h", ("level_time", "level_rate_std_m_per_h"), "0 if unknown"),
            ("temperature_c", ("salinity_psu",), "or refractive_index"),
            ("veiling_light", ("absorption_per_m",), "veiling_light = [0, 0, 0] for water that scatters nothing"),
            ("absorption_per_m", ("veiling_light",), ""),
            ("gauge", ("gauge_zero_m",), "readings count from its zero"),
            ("refractive_index", ("index_wavelength_nm",), "or temperature_c"),
        ):
            require_with("water", self, other, names, remedy)
        levels, medium = [*(["level_m"] * (self.level_m is not None)), *self.level_files], self.medium
        moving = [name for name in ("gauge", "image_levels") if name in levels]
        if self.surface is not None and (self.level_at is not None or self.slope_east or self.slope_north):
            raise ConfigError("[water] surface gives the level everywhere; remove level_at, slope_east and slope_north")
        if self.layer is not None and not {*levels} & {*LEVEL_FILES[:3]}:
            files = ", ".join(LEVEL_FILES[:3])
            raise ConfigError(f"[water] has layer without {files}, one of whose files has it; give both")
        if len(levels) > 1:
            raise ConfigError(f"[water] has {' and '.join(levels)}, each of which gives the level; keep one")
        if self.level_rate_m_per_h is not None and moving:
            raise ConfigError(f"[water] has level_rate_m_per_h and {moving[0]}, both of a moving level; keep one")
        if self.refractive_index is not None and medium:
            raise ConfigError(f"[water] has both refractive_index and {' and '.join(medium)}; keep one")

    @property
    def level_files(self) -> dict[str, str]:
        """The files of the level that are given, by their keys."""
        return {name: path for name in LEVEL_FILES if (path := getattr(self, name)) is not None}

    @property
    def medium(self) -> list[str]:
        """The keys of the water itself that are given."""
        return [name for name in ("temperature_c", "salinity_psu") if getattr(self, name) is not None]

    @property
    def known_level_m(self) -> float:
        """``level_m`` of settings for which the file that may be named instead was read."""
        if self.level_m is None:
            raise ValueError("level_m is not known before the file that [water] names instead is read")
        return self.level_m

    @property
    def known_level_at(self) -> tuple[float, float]:
        """``level_at`` of the settings of a loaded survey, which have its default filled in."""
        if self.level_at is None:
            raise ValueError("level_at is not known before its default is filled in from the cameras")
        return self.level_at

    @property
    def states_index(self) -> bool:
        """Whether the index is given; else it and its standard deviation are assumed."""
        return not (self.refractive_index is None and self.temperature_c is None and self.index_std is None)

    @property
    def gives_level(self) -> bool:
        """Whether a level, or a file of it, is given."""
        return self.level_m is not None or bool(self.level_files)

    def require_level(self) -> None:
        """Raise ConfigError where neither a level nor a file of it is given.

        Structure from motion can do without: the adjustment then finds the level, where the photographs tell it.
        """
        if not self.gives_level:
            raise ConfigError(
                "level_m is missing from [water]. Give the height of the water surface in the survey's vertical "
                "datum, e.g. level_m = 12.34, or name a file in shoreline, gnss_points, surface, gauge, image_levels "
                "or clicks. For a dry survey write dry = true above the first table, in place of [water]. Only a "
                "survey without poses, with GPS positions in its photographs, can leave the level to the adjustment"
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
                "northing_high] with low below high (not easting, easting, northing, northing)"
            )
        if self.heights is not None and not self.heights[0] < self.heights[1]:
            raise ConfigError(
                f"area.heights is {list(self.heights)}, expected [low, high] in the heights of crs with low below "
                "high; swap or correct them"
            )


@dataclass(frozen=True)
class LocalConfig:
    """[local]: the topocentric frame that COLMAP poses are in; its origin in crs."""

    frame: str = key(_TOPOCENTRIC, one_of=(_TOPOCENTRIC,))
    origin: tuple[float, float, float] | None = key(None, "[easting, northing, height]")


@dataclass(frozen=True)
class ReportConfig:
    """[report]: words for the head of report.html and report.json."""

    project: str | None = None
    operator: str | None = None  # who surveyed: a person, a company
    units: str | None = key(None, one_of=(METRES, FEET))  # of lengths in the report; default: feet where crs has them


@dataclass(frozen=True)
class SurveyConfig:
    """All of survey.toml."""

    name: str | None = None
    crs: str | None = key(None, 'a text with a vertical part, e.g. crs = "EPSG:25832+5778"')
    dry: bool | None = key(None, "true where no ground is under water; without it a survey without [water] is in doubt")
    images: ImagesConfig = field(default_factory=ImagesConfig)
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    water: WaterConfig | None = None
    control: ControlConfig = field(default_factory=ControlConfig)
    area: AreaConfig = field(default_factory=AreaConfig)
    local: LocalConfig = field(default_factory=LocalConfig)
    process: ProcessConfig = field(default_factory=ProcessConfig)
    report: ReportConfig = field(default_factory=ReportConfig)
    # The last: it hides the function of its name.
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)

    def __post_init__(self):
        if self.dry and self.water is not None:
            raise ConfigError("dry = true says that no ground is under water, and [water] describes one; keep one")


def require_slope(slope: tuple[float, float], source: str, remedy: str) -> None:
    """Raise ConfigError where a slope [-] east and north is steeper than `MOST_SLOPE`; ``source`` begins the error."""
    steepness = math.hypot(*slope)
    if steepness > MOST_SLOPE:
        raise ConfigError(
            f"{source} {slope[0]:.3g} and {slope[1]:.3g}, {math.degrees(math.atan(steepness)):.2g} degrees, expected a "
            f"rise of at most {MOST_SLOPE:g} m in a metre (a river has 0.001 to 0.01, a rapid 0.03); {remedy}"
        )


def read_config(path: Path) -> SurveyConfig:
    """Read and check survey.toml."""
    return read_toml(path, parse_config)


def settings_of(folder: Path) -> SurveyConfig | None:
    """The settings in a folder; None where it has no survey.toml, or is none."""
    if not folder.is_dir():
        return None
    require_plain_entries(folder)
    toml = folder / FILE_NAME
    if toml.is_file():
        config = read_config(toml)
        levels = () if config.water is None else config.water.level_files.values()
        named = (config.images.dir, config.images.masks, config.cameras.poses, config.field.monocular)
        require_plain(folder / name for name in (*named, *config.control.files, *levels) if name is not None)
        return config
    if os.path.lexists(toml):
        what = "a link to a file that is not there" if toml.is_symlink() else "no file"
        raise ConfigError(f"{toml} is {what}, expected the settings of the survey; copy the file itself, or remove it")
    others = sorted(path.name for path in folder.iterdir() if path.name.casefold() in _NEAR_NAMES)
    if others:
        raise ConfigError(f"{folder} has {others[0]} and no {FILE_NAME}; rename it (Windows may hide .txt)")
    return None


def parse_config(text: str) -> SurveyConfig:
    """The settings in a text in TOML; see `read_config`."""
    config = parse_toml(text, SurveyConfig, synonyms=_SYNONYMS)
    if config.water is not None:
        slope = (config.water.slope_east, config.water.slope_north)
        require_slope(slope, "[water] slope_east and slope_north are", "correct them")
    config.process.require_one_kind()
    return config


def dump_config(config: SurveyConfig) -> str:
    """The settings as TOML that `parse_config` reads back to the same settings."""
    return settings_text(table_of(config))


def settings_text(table: dict) -> str:
    """A table as TOML, without what is not set."""
    text = tomli_w.dumps(_without_none(table))
    # Lists of numbers on one line, as people write them.
    return re.sub(r"\[\n([-+.,\w\s]+?),\n\]", lambda found: f"[{' '.join(found[1].split())}]", text)


def _without_none(table: dict) -> dict:
    """Without what is not set, tables of which nothing is set included."""
    values = {name: _without_none(value) if isinstance(value, dict) else value for name, value in table.items()}
    return {name: value for name, value in values.items() if value is not None and value != {}}
