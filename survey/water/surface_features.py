"""Points of the water surface in vector files: the vertices of points, lines and polygons, with heights."""

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import shapely
from pyproj import CRS

from geo.compatibility import has_same_heights, require_in_area
from geo.crs import crs_name, has_height, height_unit_m, horizontal_crs, horizontal_unit, is_geographic
from geo.errors import PlaceMismatch, UnreadableFile
from geo.features import GEOJSON, Feature, layers_of, read_features
from geo.reading import is_no_data_value
from geo.transformation import WGS84, middle_of, transformed
from survey.display.quantities import listed
from survey.errors import ConfigError
from survey.files.csv_table import meaning, number_of, words_of

_LARGEST_BYTES = 100_000_000
# Of the international foot and that of US surveys, which drawings do not tell apart.
_SAME_UNIT = 1e-5
# The templates of AutoCAD and GDAL say inches.
_TEMPLATE_UNIT_M = 0.0254
# Properties in which programs store the height of 2D geometries, e.g. of contour lines.
HEIGHT_NAMES = ("level", "height", "elevation", "elev", "ele", "z", "altitude")
_WORDS = words_of({HEIGHT_NAMES[0]: HEIGHT_NAMES[1:]})
# Parts of names of properties that may be heights, of an unknown kind.
_LIKE_HEIGHTS = ("level", "height", "elev", "alt", "depth", "stage", "wse", "hoehe", "höhe", "tiefe", "cote", "quota",
                 "z_", "_z")  # fmt: skip
# Heights of the layers of one water differ by no more [m]: the waterline of a lake, in waves.
_ONE_HEIGHT_M = 0.1


def points_of_features(path: Path, crs: CRS, layer: str | None = None) -> tuple[np.ndarray, tuple[str, ...]]:
    """Easting, northing, height (N, 3) in crs of all vertices of a vector file, each once, and what was assumed.

    A third coordinate is the height, in the heights of crs; else, or where all third coordinates are 0, a property such
    as level or ELEV is (programs write 0 where a layer has a third coordinate and no heights). Of a file with several
    layers those of one, or of several with commas between their names. Without a CRS of its own a file is in crs;
    GeoJSON is in longitude and latitude (RFC 7946), unless its numbers are too large for degrees.
    """
    features, own_crs, drawn_m = _content(path, layer)
    if own_crs is not None and has_height(own_crs) and not has_same_heights(own_crs, crs):
        raise ConfigError(
            f"{path} has heights in {crs_name(own_crs)}, expected those of {crs_name(crs)}; transform it, or state "
            "a horizontal CRS alone if its heights are in crs"
        )
    vertices, notes = _vertices(path, features, height_unit_m(crs))
    if layer is None:
        heights: dict[str, list[float]] = {}
        for (_, _, height), of_layer in vertices:
            heights.setdefault(of_layer, []).append(height)
        require_one_water(path, heights, height_unit_m(crs))
    points = np.array(list(dict.fromkeys(place for place, _ in vertices))).reshape(-1, 3)
    if (wrong := next((height for height in points[:, 2].tolist() if is_no_data_value(height)), None)) is not None:
        raise ConfigError(f"{path} has the height {wrong:g}, a no-data value; remove those points")
    points, of_unit = _in_unit_of(points, drawn_m, crs, path)
    if own_crs is not None:
        source = horizontal_crs(own_crs)
    else:
        is_geojson = path.suffix.lower() in GEOJSON
        is_in_degrees = bool((np.abs(points[:, :2]) <= (180.0, 90.0)).all())
        if not (is_geojson and is_in_degrees) or is_geographic(crs):
            reason = ", and its coordinates are too large for degrees" if is_geojson and not is_in_degrees else ""
            return points, (*notes, *of_unit, f"{path.name} names no CRS{reason}: taken as crs")
        source = WGS84
        notes = (*notes, f"{path.name} names no CRS: taken as longitude and latitude of WGS 84 (RFC 7946)")
    target = horizontal_crs(crs)
    if len(points) and not source.equals(target, ignore_axis_order=True):
        points = transformed(source, target, points, str(path), "or give the points in crs.")
        if not np.isfinite(points).all():
            raise ConfigError(f"{path} has coordinates that are not on the map of {source.name} and {target.name}")
    return points, notes


def _in_unit_of(points: np.ndarray, unit_m: float | None, crs: CRS, path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Points (N, 3) of a drawing in the unit of crs, and a note where its $INSUNITS is another one.

    Many drawings have that of a template. It counts where the coordinates are in the area of crs by it alone, and does
    not where they are as they stand; where both or neither are, it is refused.
    """
    own_m = None if is_geographic(crs) else horizontal_unit(crs)
    if unit_m is None or not len(points) or (own_m is not None and abs(unit_m / own_m - 1.0) < _SAME_UNIT):
        return points, ()
    factor, stated = unit_m / (own_m or 1.0), f"{path.name} has units of {unit_m:.7g} m by its $INSUNITS"
    fits, fits_scaled = _is_in_area(crs, points), own_m is not None and _is_in_area(crs, points * factor)
    if fits_scaled and not fits:
        return points * factor, (f"{stated}: its coordinates are multiplied by {factor:.7g}",)
    if fits and not fits_scaled:
        return points, (f"{stated}, and coordinates that are in the area of crs without: taken as they are",)
    if unit_m == _TEMPLATE_UNIT_M:
        return points, ()
    expected = "degrees" if own_m is None else f"{own_m:.7g} m"
    raise ConfigError(
        f"{path}: {stated}, expected {expected} as in {crs_name(crs)}; convert the drawing, or set its units to those "
        "that its coordinates have"
    )


def _is_in_area(crs: CRS, points: np.ndarray) -> bool:
    try:
        require_in_area(crs, points, "")
    except PlaceMismatch:
        return False
    return middle_of(horizontal_crs(crs), points) is not None


def require_one_water(path: Path, heights: Mapping[str, Sequence[float]], unit_m: float) -> None:
    """Raise ConfigError where layers of a file have different heights, in a unit [m]: they are not of one water."""
    ranges = {name: (min(values), max(values)) for name, values in heights.items() if len(values)}
    if len(ranges) < 2 or np.ptp(list(ranges.values())) * unit_m <= _ONE_HEIGHT_M:
        return
    each = [
        f"{name or 'without a name'} ({low:.2f}" + (f" to {high:.2f})" if high > low else ")")
        for name, (low, high) in ranges.items()
    ]
    raise ConfigError(
        f"{path} has {len(each)} layers or codes of points, with the heights {listed(each)}; give the one that is "
        f'the water, e.g. [water] layer = "{min(ranges, key=lambda name: np.ptp(ranges[name]))}", or '
        'several as "a, b"'
    )


def layers_named(layer: str, names: Collection[str], path: Path) -> list[str]:
    """The layers, or codes of points, that [water] layer names: one of those of a file, or several with commas."""
    wanted = [layer] if layer in names else [part.strip() for part in layer.split(",")]
    if missing := [name for name in wanted if name not in names]:
        others = ", ".join(name or "one without a name" for name in names)
        raise ConfigError(f'{path} has no layer or code "{missing[0]}", expected one of its own: {others}')
    return wanted


def _content(path: Path, layer: str | None) -> tuple[list[tuple[Feature, str]], CRS | None, float | None]:
    """Features of all layers of a file, each with the name of its layer, their CRS, and the unit [m] of a drawing."""
    if path.is_file() and path.stat().st_size > _LARGEST_BYTES:
        raise ConfigError(f"{path} has more than {_LARGEST_BYTES // 1_000_000} MB, expected a shoreline; thin it")
    try:
        parts = {name: read_features(path, "points, lines or polygons", name) for name in layers_of(path)}
    except UnreadableFile as error:
        raise ConfigError(str(error)) from error
    features = [
        (feature, (name or "") if len(parts) > 1 else feature.layer, part)
        for name, part in parts.items()
        for feature in part.features
        if not feature.geometry.is_empty
    ]
    names = dict.fromkeys(name for _, name, _ in features)
    if layer is not None:
        wanted = layers_named(layer, names, path)
        features = [row for row in features if row[1] in wanted]
    by_crs = {"" if part.crs is None else part.crs.srs: part for _, _, part in features}
    if len(by_crs) > 1:
        raise ConfigError(f"{path} has layers in several CRSs; give one of them in [water] layer: {', '.join(names)}")
    part = next(iter((by_crs or parts).values()))
    return [(feature, name) for feature, name, _ in features], part.crs, part.unit_m


def _vertices(
    path: Path, features: list[tuple[Feature, str]], unit_m: float
) -> tuple[list[tuple[tuple[float, float, float], str]], tuple[str, ...]]:
    """Place and layer of each vertex, and a note where heights are those of a property, though there are third ones."""
    coordinates = [shapely.get_coordinates(f.geometry, include_z=f.geometry.has_z).tolist() for f, _ in features]
    thirds = [place[2] for places in coordinates for place in places if len(place) > 2]
    is_flat = bool(thirds) and not any(thirds)
    names = sorted({name for feature, _ in features for name in _like_heights(feature)}) if is_flat else []
    # KML has heights of 0 where it says that lines lie on the ground.
    uses_third = not names and not (is_flat and path.suffix.lower() == ".kml")
    vertices = []
    for (feature, layer), places in zip(features, coordinates, strict=True):
        for place in places:
            if not math.isfinite(place[-1]):
                raise ConfigError(f"{path} has the position {place}, expected two or three finite numbers")
            has_third = len(place) > 2 and uses_third
            height = place[2] if has_third else _height_of(path, feature, unit_m, is_flat=is_flat)
            vertices.append(((place[0], place[1], height), layer))
    return vertices, tuple(
        f"all third coordinates of {path.name} are 0: heights are those of its property {name}" for name in names[:1]
    )


def _numbers_of(feature: Feature) -> dict[str, float]:
    """Properties that are finite numbers, or texts that are, as columns of text are exported."""
    texts = {str(name): str(v) for name, v in feature.properties.items() if isinstance(v, int | float | str)}
    numbers = {name: number_of(text) for name, text in texts.items() if len(text) < 40}
    return {name: number for name, number in numbers.items() if math.isfinite(number)}


def _like_heights(feature: Feature) -> list[str]:
    """Names of properties that hold a number and may be a height."""
    names = {name: name.casefold() for name in _numbers_of(feature)}
    return [name for name, low in names.items() if meaning(low, _WORDS) or any(part in low for part in _LIKE_HEIGHTS)]


def _height_of(path: Path, feature: Feature, unit_m: float, *, is_flat: bool) -> float:
    """The height among the properties of a feature; ConfigError where there is none, or several that differ."""
    numbers = _numbers_of(feature)
    known = {name.casefold(): (number, meaning(name.casefold(), _WORDS)) for name, number in numbers.items()}
    heights = {name: number * (means[1] or unit_m) / unit_m for name, (number, means) in known.items() if means}
    if len(set(heights.values())) == 1:
        return next(iter(heights.values()))
    flat = "third coordinates that are all 0, and " if is_flat else ""
    if heights:
        texts = [f"{name} = {known[name][0]:g}" for name in heights]
        lack = f"{flat}several properties that may be the height ({', '.join(texts)})"
    elif like := _like_heights(feature):
        texts = [f"{name} = {numbers[name]:g}" for name in like[:4]]
        lack = f"{flat or 'positions without a height, and '}the property {', '.join(texts)}"
    else:
        raise ConfigError(
            f"{path} has {'features' if is_flat else 'positions'} without a height, expected three coordinates, or a "
            f"property {HEIGHT_NAMES[0]}; a line in plan alone does not tell the level: measure heights along it, or "
            "give level_m"
        )
    raise ConfigError(
        f"{path} has {lack}; keep one property {HEIGHT_NAMES[0]} with the height in crs, or give the height as third "
        "coordinate"
    )
