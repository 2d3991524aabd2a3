"""GPS positions of photographs, from EXIF into the local frame."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from geo.crs import height_unit_m, is_geographic, parse_crs, vertical_crs
from geo.frames import LocalFrame
from geo.transformation import WGS84, Transformation
from survey.errors import FILE_NAME, ConfigError, PosesError
from survey.photos.exif import Exif, utm_code_of
from survey.sfm.geoid import area_at, height_transformer

# Mean sea level by EGM96: the heights of consumer receivers and drones.
_EGM96_HEIGHT = 5773
MIN_POSITIONS = 3
_GIVE_POSES = f"name a file of poses in [cameras] poses in {FILE_NAME}"


@dataclass(frozen=True)
class GpsPositions:
    """GPS positions of the cameras.

    Attributes
    ----------
    frame : LocalFrame
        Its origin is the median position, rounded; so it lies at the height of the cameras.
    local : dict of name to (3,) float64 [m], local
        Only of photographs with a position and a height.
    notes : sentences
        What was assumed.
    """

    frame: LocalFrame
    local: dict[str, np.ndarray]
    notes: tuple[str, ...]


def gps_positions(heads: Mapping[str, Exif], crs: CRS | None, gps_height: str) -> GpsPositions:
    """Positions from EXIF, in a local frame of their own.

    Parameters
    ----------
    heads : mapping of name to Exif
    crs : pyproj.CRS or None
        With a vertical part. None: the UTM zone of the positions with heights above EGM96.
    gps_height : "crs" or "ellipsoidal"
        What the heights in EXIF are: heights in crs, taken as they are, or heights above the WGS 84 ellipsoid,
        for which the grid of the geoid under crs has to be installed.

    Raises
    ------
    PosesError
        If fewer than three photographs have a position with a height.
    ConfigError
        If `gps_height` is neither, the grid is missing, or the positions are not on the map of crs.
    MissingVerticalDatum, UnsupportedCRS
        As `geo.crs.parse_crs`.
    """
    num = sum(head.lat_lon_height is not None for head in heads.values())
    num_with_height = sum(is_whole(head.lat_lon_height) for head in heads.values())
    if num_with_height < MIN_POSITIONS:
        raise PosesError(
            f"{num} of {len(heads)} images have a GPS position in EXIF, {num_with_height} of them with a "
            f"height{what_is_missing(heads)}, expected at least {MIN_POSITIONS} to place the survey on Earth; "
            f"{_GIVE_POSES}"
        )
    notes = []
    if crs is None:
        code = f"EPSG:{utm_code_of(heads)}+{_EGM96_HEIGHT}"
        crs = parse_crs(code)
        notes.append(f'crs = "{code}", the UTM zone of the GPS positions with heights above mean sea level (EGM96)')
    crs = parse_crs(crs)
    positions = positions_in_crs(heads, crs, gps_height, notes)
    points = np.array(list(positions.values()))
    frame = LocalFrame(crs, _origin(crs, points))
    missing = len(heads) - num_with_height
    if missing:
        notes.append(f"{missing} of {len(heads)} images have no GPS position with a height; the others place the block")
    return GpsPositions(frame, dict(zip(positions, frame.local_from_crs(points), strict=True)), tuple(notes))


def what_is_missing(heads: Mapping[str, Exif]) -> str:
    """What EXIF lacks for whole positions, as a part of a sentence; empty where it holds nothing of them."""
    faults = Counter(head.gps_fault for head in heads.values() if head.gps_fault)
    flat = sum(head.lat_lon_height is not None and not is_whole(head.lat_lon_height) for head in heads.values())
    if flat:
        faults["the altitude"] = flat
    said = [f"{fault} is missing in {num} of the images" for fault, num in faults.items()]
    return f", as {' and '.join(said)}" if said else ""


def positions_in_crs(heads: Mapping[str, Exif], crs: CRS, gps_height: str, notes: list[str]) -> dict[str, np.ndarray]:
    """The positions (3,) in crs of the photographs that have one with a height, by name; there may be none.

    Parameters
    ----------
    heads, crs, gps_height
        As for `gps_positions`.
    notes : list of sentences
        Added to: what the heights are taken for.

    Raises
    ------
    ConfigError
        As `gps_positions`.
    """
    wgs84 = {name: head.lat_lon_height for name, head in heads.items() if is_whole(head.lat_lon_height)}
    if not wgs84:
        return {}
    lat, lon, height = np.array(list(wgs84.values())).T
    points = _crs_from_wgs84(crs, lon, lat, height, gps_height, notes)
    if not np.isfinite(points).all():
        name = list(wgs84)[int(np.argmin(np.isfinite(points).all(axis=1)))]
        raise ConfigError(
            f"the GPS position {wgs84[name]} of {name} is not on the map of {crs.name}; correct crs in {FILE_NAME}"
        )
    return dict(zip(wgs84, points, strict=True))


def datum_doubt(heads: Mapping[str, Exif], crs: CRS) -> str | None:
    """A warning where GPS positions in crs are less well known than in WGS 84; None where they are not."""
    known = [head.lat_lon_height for head in heads.values() if head.lat_lon_height is not None]
    places = np.array(known, dtype=np.float64).reshape(-1, 3)[:, [1, 0]]
    return Transformation.between(WGS84, crs, places).doubt("GPS positions") if len(places) else None


def is_whole(position: tuple[float, float, float] | None) -> bool:
    """Whether a photograph has a position with a height."""
    return position is not None and math.isfinite(position[2])


def _crs_from_wgs84(crs: CRS, lon, lat, height, gps_height: str, notes: list[str]) -> np.ndarray:
    """WGS 84 longitudes, latitudes [deg] and heights [m] (N,) as points (N, 3) in crs."""
    # Two dimensions only: the height is not touched by any change of datum.
    way = Transformation.between(WGS84, crs, np.column_stack([lon, lat]))
    east, north = way(lon, lat)
    if gps_height == "crs":
        vertical = vertical_crs(crs)
        above = f"above {vertical.name}" if vertical is not None else "above the ellipsoid"
        notes.append(f'gps_height = "crs": the GPS heights in EXIF are taken as heights in crs, {above}')
        return np.stack([east, north, height / height_unit_m(crs)], axis=-1)
    if gps_height != "ellipsoidal":
        raise ConfigError(f'[cameras] gps_height is "{gps_height}", expected "crs" or "ellipsoidal"')
    to_height = height_transformer(crs, area_at(lon, lat))
    steps = [step for step in to_height.description.split(" + ") if not step.startswith("axis order change")]
    notes.append(
        'gps_height = "ellipsoidal": the GPS heights in EXIF are taken as heights above the WGS 84 ellipsoid '
        f"({' + '.join(steps) or 'no change'})"
    )
    return np.stack([east, north, to_height.transform(lon, lat, height)[2]], axis=-1)


def _origin(crs: CRS, points: np.ndarray) -> tuple[float, float, float]:
    # The median, so that one wrong position does not move the frame of the others.
    e, n, h = (float(v) for v in np.median(points, axis=0))
    digits = 5 if is_geographic(crs) else 0
    return (round(e, digits), round(n, digits), float(math.floor(h)))
