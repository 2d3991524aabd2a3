"""The known keys of survey.toml: what kind of value each one takes, and which ones are not supported yet."""

from __future__ import annotations

import math

from survey.errors import ConfigError


def _number(key: str, value) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{key} is {_shown(value)}, expected a finite number")
    return float(value)


def _positive(key: str, value) -> float:
    number = _number(key, value)
    if number <= 0.0:
        raise ConfigError(f"{key} is {number:g}, expected a number above zero")
    return number


def _text(key: str, value) -> str:
    if not isinstance(value, str) or not value.strip():
        raise ConfigError(f'{key} is {_shown(value)}, expected a text in quotes, e.g. {key.split(".")[-1]} = "..."')
    return value


def _crs(key: str, value) -> str:
    if isinstance(value, int) and not isinstance(value, bool):
        raise ConfigError(f'{key} is {value}, expected a text with a vertical part, e.g. crs = "EPSG:{value}+5778"')
    return _text(key, value)


def _numbers(count: int, what: str):
    def check(key: str, value) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != count:
            raise ConfigError(f"{key} is {_shown(value)}, expected {what}")
        return tuple(_number(f"{key}[{i}]", v) for i, v in enumerate(value))

    return check


def _of_channels(what: str):
    """Three numbers, red, green and blue, none below zero."""
    numbers = _numbers(3, f"[red, green, blue], {what}")

    def check(key: str, value) -> tuple[float, ...]:
        found = numbers(key, value)
        if min(found) < 0.0:
            raise ConfigError(f"{key} is {_shown(value)}, expected [red, green, blue], {what}, none below zero")
        return found

    return check


def _size(key: str, value) -> tuple[int, int]:
    whole = isinstance(value, list) and all(isinstance(v, int) and not isinstance(v, bool) and v > 0 for v in value)
    if not whole or len(value) != 2:
        raise ConfigError(f"{key} is {_shown(value)}, expected [width, height] in whole pixels")
    return (value[0], value[1])


def _focal(key: str, value) -> float | tuple[float, float]:
    if isinstance(value, list):
        if len(value) != 2:
            raise ConfigError(f"{key} is {_shown(value)}, expected one focal length or [fx, fy] in pixels")
        return (_positive(f"{key}[0]", value[0]), _positive(f"{key}[1]", value[1]))
    return _positive(key, value)


def _distortion(key: str, value) -> tuple[float, ...]:
    if not isinstance(value, list) or not value:
        raise ConfigError(f"{key} is {_shown(value)}, expected a list of coefficients, e.g. [k1, k2, p1, p2]")
    return tuple(_number(f"{key}[{i}]", v) for i, v in enumerate(value))


def _bounds(key: str, value) -> tuple[float, ...]:
    e0, n0, e1, n1 = _numbers(4, "[easting_low, northing_low, easting_high, northing_high]")(key, value)
    if not (e0 < e1 and n0 < n1):
        raise ConfigError(
            f"{key} is {value}, expected [easting_low, northing_low, easting_high, northing_high] with low below high"
        )
    return (e0, n0, e1, n1)


def _heights(key: str, value) -> tuple[float, ...]:
    low, high = _numbers(2, "[low, high], in the heights of crs")(key, value)
    if not low < high:
        raise ConfigError(f"{key} is {value}, expected [low, high] in metres with low below high; swap or correct them")
    return (low, high)


def _frame(key: str, value) -> str:
    text = _text(key, value)
    if text != "topocentric east-north-up":
        raise ConfigError(f'{key} is "{text}", expected "topocentric east-north-up", the only frame known here')
    return text


def _shown(value) -> str:
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."


TOP = {"name": _text, "crs": _crs}

SECTIONS = {
    "images": {"dir": _text, "masks": _text},
    "cameras": {
        "poses": _text,
        "model": _text,
        "size_px": _size,
        "focal_px": _focal,
        "principal_point_px": _numbers(2, "[x, y] in pixels"),
        "distortion": _distortion,
        "gps_height": _text,
    },
    "water": {
        "level_m": _number,
        "level_at": _numbers(2, "[easting, northing]"),
        "slope_east": _number,
        "slope_north": _number,
        "refractive_index": _number,
        "temperature_c": _number,
        "salinity_psu": _number,
        "absorption_per_m": _of_channels("the share of light that a metre of water takes, e.g. [0.3, 0.07, 0.05]"),
        "veiling_light": _of_channels("linear light of endless water, 1 for white, e.g. [0.03, 0.17, 0.2]"),
        "shoreline": _text,
        "gnss_points": _text,
        "gauge": _text,
    },
    "area": {"bounds": _bounds, "heights": _heights},
    "local": {"frame": _frame, "origin": _numbers(3, "[easting, northing, height]")},
    "control": {},
}

# Keys that a later version will read, and what to give until then.
NOT_YET = {
    "water.mask": "the sweep finds by itself what is wet; remove it",
    "control.gcps": "give camera poses that are already adjusted to the control points",
}
