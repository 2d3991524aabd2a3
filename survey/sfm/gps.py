"""GPS positions of photographs, from EXIF or a table beside them into the local frame, and transformations of datums.

An error of a transformation of datums, as PROJ states it, is the same at all places of a survey. Where control holds
the block it widens the positions, and counts for nothing; else the whole block is shifted by it. A transformation that
is worse than the positions, for want of a grid, or because PROJ knows none, is refused where nothing else places the
block.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS, CoordinateOperation
from pyproj.exceptions import ProjError
from pyproj.transformer import AreaOfInterest

from geo.crs import has_height, horizontal_crs, is_geographic, middle_lon_lat, parse_crs, vertical_crs
from geo.frames import LocalFrame
from geo.transformation import WGS84, Transformation, area_about, height_scale, lon_lat, operations
from survey.errors import FILE_NAME, ConfigError, PosesError
from survey.photos.exif import Exif
from survey.photos.poses import least_track
from survey.words import GEO_TXT

# Positions that are better than this are those of a receiver with corrections, or of an adjusted block.
WELL_KNOWN_M = 0.1
# So many control points place a block.
_PLACING = 3
_GEOID_STEP = re.compile(r"\+proj=vgridshift\s+\+grids=(\S+)")


@dataclass(frozen=True)
class DatumStd:
    """Standard deviations [m] that a transformation of datums adds, alike at all places: in plan and in height."""

    plan: float = 0.0
    up: float = 0.0

    def onto(self, std: np.ndarray) -> np.ndarray:
        """Standard deviations (3,) [m] of a place after the transformation."""
        return np.hypot(std, [self.plan, self.plan, self.up])


EXACT = DatumStd()


def plan_std(transformation: Transformation) -> float:
    """Standard deviation [m] of places in plan by a transformation; 0 where PROJ does not know it."""
    return transformation.accuracy_m or 0.0


def require_accurate(transformation: Transformation, plan_std_m: float, positions: str, num_control: int) -> None:
    """Raise where a grid is missing, and the best transformation without it is worse than the positions, or not known.

    ``plan_std_m`` is that of the positions before, ``num_control`` counts what places the block all the same.
    """
    if plan_std_m > WELL_KNOWN_M or num_control >= _PLACING:
        return
    transformation.require_known(
        positions, f"or give {_PLACING} control points or more in crs, which then place the block"
    )
    if not transformation.missing_grids:
        return
    if transformation.accuracy_m is not None and transformation.accuracy_m <= plan_std_m:
        return
    known = "an unknown accuracy" if transformation.accuracy_m is None else f"{transformation.accuracy_m:.2g} m"
    as_good = "taken as exact" if plan_std_m == 0.0 else f"good to {plan_std_m:.2g} m"
    transformation.require_best(
        f"{positions} are {as_good}, and the best transformation without a grid has {known}",
        f"or put it into the folder geoid of the survey; or give {_PLACING} control points or more in crs, which then "
        f"place the block, or position_std_m of {transformation.accuracy_m or 10.0:.2g} and more in [cameras] in "
        f"{FILE_NAME}: the survey may then be shifted by as much",
    )


def smallest(stds: Collection[DatumStd]) -> DatumStd:
    """Smallest of several values; nothing of none."""
    return DatumStd(*(min((getattr(each, name) for each in stds), default=0.0) for name in ("plan", "up")))


def area_at(lon: np.ndarray, lat: np.ndarray) -> AreaOfInterest:
    """Area of a survey, by longitudes and latitudes [deg], for PROJ to choose among regional transformations."""
    return area_about(*middle_lon_lat(np.column_stack([lon, lat])).tolist())


def height_transformer(crs: CRS, area: AreaOfInterest) -> Transformer:
    """Transformer from longitude, latitude [deg] and height above the WGS 84 ellipsoid [m] to the height in crs.

    Only heights are transformed: its horizontal part is WGS 84, so that no grid of horizontal datums is needed.
    """
    vertical = vertical_crs(crs)
    target = "EPSG:4979" if vertical is None else CompoundCRS(f"WGS 84 + {vertical.name}", ["EPSG:4326", vertical])
    message = f'gps_height = "ellipsoidal" needs a transformation of heights from the ellipsoid to {crs.name}'
    instead = f'or give heights in crs and gps_height = "crs" in {FILE_NAME}'
    try:
        group = operations("EPSG:4979", target, area)
    except ProjError as error:
        raise ConfigError(f"{message}, which PROJ does not know ({error}); {instead}") from error
    if group.transformers:
        return group.transformers[0]
    geodetic = horizontal_crs(crs).geodetic_crs
    grids = [] if geodetic is None else _geoid_grids(group.unavailable_operations, geodetic.name)
    if not grids:
        raise ConfigError(f"{message}, which PROJ does not have here; correct the vertical part of crs, {instead}")
    missing = f"the grid {grids[0]} is" if len(grids) == 1 else f"the grids {' and '.join(grids)} are"
    get = " and ".join(f"pyproj sync --file {name}" for name in grids)
    raise ConfigError(
        f"{message}, and {missing} not installed; install with {get}, put it into the folder geoid of the "
        f"survey, {instead}"
    )


def _geoid_grids(operations: list[CoordinateOperation], datum: str) -> list[str]:
    """Grids of the geoid that the best operation needs, among those that need no grid of horizontal datums.

    The best one belongs to the horizontal datum of the survey. A shift between horizontal datums by seven parameters
    belongs to older realisations than the one without.
    """
    ranked = []
    for operation in operations:
        steps = operation.to_proj4()
        grids, needed = _GEOID_STEP.findall(steps), list(operation.grids)
        if grids and len(grids) == len(needed):
            rank = (
                not all(grid.direct_download for grid in needed),
                datum not in operation.name,
                "+proj=helmert" in steps,
                operation.accuracy if operation.accuracy >= 0.0 else math.inf,
            )
            ranked.append((rank, grids))
    return min(ranked)[1] if ranked else []


_EXIF, _WGS84_3D = "EXIF", CRS("EPSG:4979")
_GIVE_POSES = f"name a file of poses in [cameras] poses in {FILE_NAME}"


@dataclass(frozen=True)
class GpsPositions:
    """GPS positions of the cameras."""

    frame: LocalFrame  # Its origin is the median position, rounded; so it lies at the height of the cameras
    # dict of name to (3,) float64 [m], local: only of photographs with a position and a height
    local: dict[str, np.ndarray]
    notes: tuple[str, ...]  # sentences: what was assumed


def gps_positions(headers: Mapping[str, Exif], crs: CRS, gps_height: str) -> GpsPositions:
    """Positions of photographs, in a local frame of their own.

    With ``gps_height`` "crs" heights in EXIF are taken as heights in crs, with "ellipsoidal" as heights above the WGS
    84 ellipsoid, for which the grid of the geoid under crs has to be installed.
    """
    num = sum(header.lat_lon_height is not None for header in headers.values())
    num_with_height = sum(is_whole(header.lat_lon_height) for header in headers.values())
    if num_with_height < (least := least_track(len(headers))):
        raise PosesError(
            f"{num} of {len(headers)} images have a GPS position in EXIF or {GEO_TXT}, {num_with_height} of them with "
            f"a height{what_is_missing(headers)}, expected at least {least} to place the survey on Earth; "
            f"{_GIVE_POSES}"
        )
    crs = parse_crs(crs)
    positions, notes = positions_in_crs(headers, crs, gps_height)
    points = np.array(list(positions.values()))
    frame = frame_about(crs, points)
    missing = len(headers) - num_with_height
    if missing:
        notes.append(f"{missing} of {len(headers)} images have no position with a height; the others place the block")
    return GpsPositions(frame, dict(zip(positions, frame.local_from_crs(points), strict=True)), tuple(notes))


def frame_about(crs: CRS, places, height: float | None = None) -> LocalFrame:
    """The frame whose origin is rounded from the median of places (N, 3) in crs, at a height of its own if given."""
    # The median, so that one wrong position does not move the frame of the others.
    e, n, middle = np.median(places, axis=0).tolist()
    digits = 5 if is_geographic(crs) else 0
    return LocalFrame(
        crs, (round(e, digits), round(n, digits), float(math.floor(middle if height is None else height)))
    )


def what_is_missing(headers: Mapping[str, Exif]) -> str:
    """Missing parts of positions in EXIF, as a part of a sentence; empty where it holds nothing of them."""
    faults = Counter(header.gps_fault for header in headers.values() if header.gps_fault)
    flat = sum(header.lat_lon_height is not None and not is_whole(header.lat_lon_height) for header in headers.values())
    if flat:
        faults["the altitude"] = flat
    parts = [f"{fault} is missing in {num} of the images" for fault, num in faults.items()]
    return f", as {' and '.join(parts)}" if parts else ""


def positions_in_crs(headers: Mapping[str, Exif], crs: CRS, gps_height: str) -> tuple[dict[str, np.ndarray], list[str]]:
    """Positions (3,) in crs of photographs that have one with a height, by name, and what heights are taken for."""
    whole = {name: header for name, header in headers.items() if is_whole(header.lat_lon_height)}
    found: dict[str, np.ndarray] = {}
    notes: list[str] = []
    for source, of_source in _by_source(whole).items():
        points, of_source_notes = _in_crs(crs, source, np.array(list(of_source.values())), gps_height)
        notes += of_source_notes
        if not np.isfinite(points).all():
            name = list(of_source)[int(np.argmin(np.isfinite(points).all(axis=1)))]
            raise ConfigError(
                f"the GPS position {headers[name].lat_lon_height} of {name} is not on the map of {crs.name}; correct "
                f"crs in {FILE_NAME}"
            )
        found |= dict(zip(of_source, points, strict=True))
    return {name: found[name] for name in whole}, notes


@dataclass(frozen=True)
class PositionTransform:
    """Transformation of the GPS positions of one source into crs."""

    label: str  # What they are, for messages
    names: tuple[str, ...]  # of their photographs
    plan: Transformation
    up_std_m: float  # [m]: that the geoid adds to heights above the ellipsoid; 0 where they are taken as they are


def transforms_into_crs(headers: Mapping[str, Exif], crs: CRS, gps_height: str) -> list[PositionTransform]:
    """Transformations of GPS positions into crs, one for each of their sources."""
    transforms = []
    for source, own in _by_source(headers).items():
        places = np.array(list(own.values()))
        up = _geoid_std(crs, source, places) if gps_height == "ellipsoidal" else 0.0
        plan = Transformation.between(source.crs, crs, places)
        transforms.append(PositionTransform(f"GPS positions{source.suffix}", tuple(own), plan, up))
    return transforms


def _geoid_std(crs: CRS, source: _Source, places: np.ndarray) -> float:
    """Standard deviation [m] of the geoid between heights above the ellipsoid and those of crs, as PROJ states it."""
    if vertical_crs(source.crs) is not None or vertical_crs(crs) is None:
        return 0.0
    lon, lat = lon_lat(source.crs, places).T
    with suppress(ConfigError):
        return max(float(height_transformer(crs, area_at(lon, lat)).accuracy), 0.0)
    # Whoever takes the heights says what is missing.
    return 0.0


def datum_stds(headers: Mapping[str, Exif], crs: CRS, gps_height: str) -> dict[str, DatumStd]:
    """Std that the transformation into crs adds to GPS positions, by photograph."""
    return {
        name: DatumStd(plan_std(transform.plan), transform.up_std_m)
        for transform in transforms_into_crs(headers, crs, gps_height)
        for name in transform.names
    }


def datum_warnings(transforms: Sequence[PositionTransform]) -> list[str]:
    """Warnings where GPS positions in crs are less well known than as they are given."""
    warnings = [transform.plan.warning(transform.label) for transform in transforms]
    warnings += [
        f"heights of {transform.label} are transformed by a geoid with an accuracy of "
        f"{transform.up_std_m:.2g} m by PROJ: an error common to all of them"
        for transform in transforms
        if transform.up_std_m > WELL_KNOWN_M
    ]
    return [warning for warning in warnings if warning is not None]


@dataclass(frozen=True)
class _Source:
    """Source of GPS positions, and their CRS."""

    name: str
    crs: CRS

    @property
    def suffix(self) -> str:
        return "" if self.name == _EXIF else f" in {self.name}"


def _by_source(headers: Mapping[str, Exif]) -> dict[_Source, dict[str, tuple[float, float, float]]]:
    """Positions of photographs, easting or longitude first, by source and name."""
    found: dict[_Source, dict[str, tuple[float, float, float]]] = {}
    for name, header in headers.items():
        if (given := header.table_place) is not None:
            found.setdefault(_Source(given.source, given.crs), {})[name] = given.place
        elif header.lat_lon_height is not None:
            lat, lon, height = header.lat_lon_height
            found.setdefault(_Source(_EXIF, WGS84), {})[name] = (lon, lat, height)
    return found


def is_whole(position: tuple[float, float, float] | None) -> bool:
    """Whether a photograph has a position with a height."""
    return position is not None and math.isfinite(position[2])


def _in_crs(crs: CRS, source: _Source, places: np.ndarray, gps_height: str) -> tuple[np.ndarray, list[str]]:
    """Places (N, 3) in the CRS of their source as points (N, 3) in crs, and what their heights are taken for."""
    # Two dimensions only: the height is not touched by any change of datum.
    to_crs = Transformation.between(source.crs, crs, places)
    east, north = to_crs(places[:, 0], places[:, 1])
    if gps_height not in ("crs", "ellipsoidal"):
        raise ConfigError(f'[cameras] gps_height is "{gps_height}", expected "crs" or "ellipsoidal"')
    own, vertical = vertical_crs(source.crs), vertical_crs(crs)
    message = f"the GPS heights in {source.name}"
    if gps_height == "crs" and has_height(source.crs) and own is None and vertical is not None:
        raise ConfigError(
            f"{message} are above the ellipsoid ({source.crs.name}), and those of crs above {vertical.name}; write "
            f'gps_height = "ellipsoidal" in [cameras] in {FILE_NAME}'
        )
    if gps_height == "crs" or own is not None:
        scale = height_scale(source.crs, crs, message)
        above = f"above {vertical.name}" if vertical is not None else "above the ellipsoid"
        taken = f'gps_height = "crs": {message} are taken as heights in crs, {above}'
        return np.stack([east, north, places[:, 2] * scale], axis=-1), [] if has_height(source.crs) else [taken]
    lon, lat = lon_lat(source.crs, places).T
    to_height = height_transformer(crs, area_at(lon, lat))
    steps = [step for step in to_height.description.split(" + ") if not step.startswith("axis order change")]
    taken = f'gps_height = "ellipsoidal": {message} are over the ellipsoid ({" + ".join(steps) or "no change"})'
    metres = places[:, 2] * height_scale(source.crs, _WGS84_3D, message)
    return np.stack([east, north, to_height.transform(lon, lat, metres)[2]], axis=-1), [taken]
