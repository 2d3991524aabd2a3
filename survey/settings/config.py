"""survey.toml: the settings of a survey, checked key by key, and written back with defaults filled in."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import tomli_w

from survey.errors import FILE_NAME, ConfigError
from survey.files.foreign import require_plain, require_plain_entries
from survey.files.remote import is_url, local_name
from survey.files.toml_table import key, parse_toml, read_toml, require_with, std_key, table_of
from survey.settings.tables import ControlConfig, FieldConfig, ProcessConfig
from survey.settings.water import WaterConfig, require_slope

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
    def rolls(self) -> bool:
        """Whether the shutter rolls, by a readout or by one that is to be found."""
        return bool(self.rolling_shutter_s) or self.rolling_shutter_std_s is not None


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
        require_plain(folder / text for text in _texts_of(table_of(config)) if "\0" not in text)
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
    return tomli_w.dumps(_without_none(table))


def _without_none(table: dict) -> dict:
    """Without what is not set, tables of which nothing is set included."""
    values = {name: _without_none(value) if isinstance(value, dict) else value for name, value in table.items()}
    return {name: value for name, value in values.items() if value is not None and value != {}}


def _texts_of(value: object) -> Iterator[str]:
    """All texts in a value of dicts and lists."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list | tuple):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _texts_of(item)
