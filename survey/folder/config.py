"""survey.toml: the settings of a survey, checked key by key, and written back as they took effect."""

from __future__ import annotations

import dataclasses
import difflib
import json
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

from survey.errors import ConfigError
from survey.folder import keys


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
    size_px: tuple[int, int] | None = None
    focal_px: float | tuple[float, float] | None = None
    principal_point_px: tuple[float, float] | None = None
    distortion: tuple[float, ...] | None = None
    gps_height: str = "crs"


@dataclass(frozen=True)
class WaterConfig:
    """[water]: a plane through ``level_m`` at ``level_at``, with its rise per metre along the grid axes."""

    level_m: float | None = None  # None only until the file that is named instead is read
    level_at: tuple[float, float] | None = None
    slope_east: float = 0.0
    slope_north: float = 0.0
    refractive_index: float | None = None
    temperature_c: float | None = None
    salinity_psu: float | None = None
    absorption_per_m: tuple[float, float, float] | None = None  # of red, green, blue, on the way down and up
    veiling_light: tuple[float, float, float] | None = None  # linear, of endless water; 1 is a photograph's white
    shoreline: str | None = None  # CSV of points, easting, northing, height, where water meets land
    gnss_points: str | None = None  # the same, of points anywhere on the surface
    gauge: str | None = None  # CSV of time, level


@dataclass(frozen=True)
class AreaConfig:
    """[area]: inside which the bed is wanted."""

    bounds: tuple[float, float, float, float] | None = None  # easting and northing, low then high
    heights: tuple[float, float] | None = None  # in m in crs, low then high: no bed is looked for beyond


@dataclass(frozen=True)
class LocalConfig:
    """[local]: the topocentric frame that COLMAP poses are in; its origin in crs."""

    frame: str = "topocentric east-north-up"
    origin: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class SurveyConfig:
    """All of survey.toml."""

    name: str | None = None
    crs: str | None = None
    images: ImagesConfig = field(default_factory=ImagesConfig)
    cameras: CamerasConfig = field(default_factory=CamerasConfig)
    water: WaterConfig | None = None
    area: AreaConfig = field(default_factory=AreaConfig)
    local: LocalConfig = field(default_factory=LocalConfig)


_SECTIONS = {
    "images": ImagesConfig,
    "cameras": CamerasConfig,
    "water": WaterConfig,
    "area": AreaConfig,
    "local": LocalConfig,
}


def read_config(path: Path) -> SurveyConfig:
    """Read and check survey.toml.

    Raises
    ------
    ConfigError
        Where the file is no TOML, or a key is unknown, of the wrong kind, not supported yet or at odds with
        another.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8") from error
    try:
        return parse_config(text)
    except ConfigError as error:
        raise type(error)(f"{path}: {error}") from error


def parse_config(text: str) -> SurveyConfig:
    """The settings in a text in TOML; see `read_config`."""
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"not valid TOML: {error}; correct that line") from error
    _refuse_unknown(tables)
    top = {key: keys.TOP[key](key, tables[key]) for key in keys.TOP if key in tables}
    for section, kind in _SECTIONS.items():
        if section not in tables:
            continue
        values = {key: keys.SECTIONS[section][key](f"{section}.{key}", v) for key, v in tables[section].items()}
        if section == "water":
            _check_water(values)
        top[section] = kind(**values)
    config = SurveyConfig(**top)
    _check_cameras(config.cameras)
    return config


def dump_config(config: SurveyConfig) -> str:
    """The settings as TOML that `parse_config` reads back to the same settings."""
    lines, tables = [], []
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            tables.append((item.name, value))
        elif value is not None:
            lines.append(f"{item.name} = {_toml(value)}")
    for name, table in tables:
        pairs = {f.name: getattr(table, f.name) for f in dataclasses.fields(table)}
        lines += [
            "",
            f"[{name}]",
            *(f"{key} = {_toml(value)}" for key, value in pairs.items() if value is not None),
        ]
    return "\n".join(lines) + "\n"


def _toml(value) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(value)


def _refuse_unknown(tables: dict) -> None:
    """Raise ConfigError at the first key that is not known, or known but not supported yet."""
    for key, value in tables.items():
        if key in keys.TOP:
            continue
        if key not in keys.SECTIONS:
            raise ConfigError(_unknown(key, None))
        if not isinstance(value, dict):
            raise ConfigError(f"{key} = {value!r} was found where the table [{key}] was expected")
        for name in value:
            if f"{key}.{name}" in keys.NOT_YET:
                raise ConfigError(f"[{key}] {name} is not supported yet; {keys.NOT_YET[f'{key}.{name}']}")
            if name not in keys.SECTIONS[key]:
                raise ConfigError(_unknown(name, key))


def _unknown(key: str, section: str | None) -> str:
    """Says that a key is unknown and names the nearest known one, in its own table first."""
    here = keys.SECTIONS[section] if section else {**keys.TOP, **{name: None for name in keys.SECTIONS}}
    full_names = {name: f"[{section}] {name}" if section else name for name in here}
    near = difflib.get_close_matches(key, here, 1, 0.6)
    if not near:
        for other, known in keys.SECTIONS.items():
            full_names |= {name: f"[{other}] {name}" for name in known if name not in full_names}
        full_names |= {name: f"{name}, above the first table" for name in keys.TOP if name not in full_names}
        near = difflib.get_close_matches(key, full_names, 1, 0.0)
    where = f"unknown key {key} in [{section}]" if section else f"unknown key {key}"
    nearest = full_names[near[0]]
    if section is None and near[0] in keys.SECTIONS:
        nearest = f"[{near[0]}]"
    return f"{where}; the nearest known one is {nearest}. Correct or remove it"


def _check_water(values: dict) -> None:
    levels = [key for key in ("level_m", "shoreline", "gnss_points", "gauge") if key in values]
    if not levels:
        raise ConfigError(
            "level_m is missing from [water]. Give the height of the water surface in the survey's vertical datum, "
            "e.g. level_m = 12.34, or a file of points or readings as shoreline, gnss_points or gauge, or remove "
            "[water] for a dry survey"
        )
    if len(levels) > 1:
        raise ConfigError(f"[water] has {' and '.join(levels)}, each of which says how high the water is; keep one")
    by_water = [key for key in ("temperature_c", "salinity_psu") if key in values]
    if "refractive_index" in values and by_water:
        raise ConfigError(
            f"[water] has both refractive_index and {' and '.join(by_water)}, which contradict each other; keep one"
        )
    if by_water == ["salinity_psu"]:
        raise ConfigError("[water] has salinity_psu without temperature_c; give temperature_c too, or refractive_index")
    index = values.get("refractive_index", 1.333)
    if not 1.0 <= index <= 1.6:
        raise ConfigError(
            f"[water] refractive_index is {index:g}, expected 1.0 to 1.6 relative to air; fresh water has 1.333, sea "
            "water 1.340"
        )
    of_light = [key for key in ("absorption_per_m", "veiling_light") if key in values]
    if len(of_light) == 1:
        raise ConfigError(
            f"[water] has {of_light[0]} alone, expected absorption_per_m and veiling_light together; give both "
            "(veiling_light = [0, 0, 0] for water that scatters nothing) or neither"
        )
    for key in ("slope_east", "slope_north"):
        if abs(values.get(key, 0.0)) > 0.2:
            raise ConfigError(
                f"[water] {key} is {values[key]:g}, expected a rise in metres per metre of at most 0.2; a river has "
                "about 0.001 to 0.01"
            )


def _check_cameras(cameras: CamerasConfig) -> None:
    if cameras.distortion is not None and cameras.model is None:
        raise ConfigError('[cameras] distortion is given without model; give e.g. model = "OPENCV" with k1, k2, p1, p2')
    if cameras.gps_height not in ("crs", "ellipsoidal"):
        raise ConfigError(
            f'[cameras] gps_height is "{cameras.gps_height}", expected "crs" (EXIF heights are heights in '
            "crs) "
            'or "ellipsoidal"'
        )
    if cameras.principal_point_px is not None and cameras.size_px is not None:
        inside = all(0.0 < p < s for p, s in zip(cameras.principal_point_px, cameras.size_px, strict=True))
        if not inside:
            raise ConfigError(
                f"[cameras] principal_point_px {list(cameras.principal_point_px)} lies outside the image of size_px "
                f"{list(cameras.size_px)}; expected pixels from the upper left corner"
            )
