"""Consistency of the positions and heights of cameras, water and bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Geod
from scipy.spatial import KDTree

from geo.compatibility import bounds_in_other_order
from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.transformation import lon_lat
from refract import PinholeCamera
from survey.display.quantities import distance_text, named
from survey.errors import FILE_NAME, ConfigError, PosesError
from survey.folder.faults import above_start_of, explanation, place_of
from survey.photos.cameras import View
from survey.photos.exif import Exif
from survey.settings.config import SurveyConfig, WaterConfig

# Fewer pairs of axes do not determine a height.
_FEWEST_PAIRS = 10
# Usual overlap along the flight line; used only where nothing else determines the height of dry ground.
USUAL_OVERLAP = 0.75
# Pairs of more cameras than this would fill the memory; every second or third camera gives the same result.
_MOST_PAIRED = 1500
# Drones take bathymetric photographs from below the first height, aircraft from below the second. Higher than the first
# suggests, higher than the second proves another vertical datum.
DRONE_HEIGHT_M, AIRCRAFT_HEIGHT_M = 300.0, 3000.0
# Photographs of one survey overlap, so cameras are not this many times higher than the usual overlap suggests.
MOST_OF_OVERLAP = 8.0
# Further apart than this, positions are not of one survey.
ONE_SURVEY_M = 20e3
# A GPS position without corrections is within 10 m: beyond the first it is doubted, beyond the second it is of another
# zone or datum.
_EXIF_DOUBT_M, SAME_PLACE_M = 50.0, 100.0


@dataclass(frozen=True)
class GroundHeight:
    """Approximate height of dry ground."""

    height: float  # [m], local
    source: str  # What it is known from, for the plan
    is_guess: bool = False  # Whether it is known from the usual overlap of photographs alone


def ground_below(cameras: Sequence[PinholeCamera]) -> GroundHeight:
    """Approximate height of the ground below cameras, from their poses alone.

    Where the axes of oblique views converge, the median height at which pairs of them pass each other; else
    the height at which neighbours overlap as usual, a guess.
    """
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.cam_from_local[2] for camera in cameras])
    every = -(-len(cameras) // _MOST_PAIRED)
    i, j = (every * side for side in np.triu_indices(-(-len(cameras) // every), 1))
    cos = np.sum(axes[i] * axes[j], axis=1)
    convergent = cos < math.cos(math.radians(15.0))
    if convergent.sum() >= _FEWEST_PAIRS:
        i, j, cos = i[convergent], j[convergent], cos[convergent]
        between = centres[j] - centres[i]
        along_i, along_j = np.sum(between * axes[i], axis=1), np.sum(between * axes[j], axis=1)
        t = (along_i - cos * along_j) / (1.0 - cos**2)
        heights = (centres[i] + t[:, None] * axes[i])[t > 0.0, 2]
        if heights.size >= _FEWEST_PAIRS:
            return GroundHeight(float(np.median(heights)), "where the axes of oblique views converge")
    base = float(np.median(KDTree(centres[:, :2]).query(centres[:, :2], k=2)[0][:, 1]))
    camera = cameras[0]
    seen = min(camera.width / camera.fx, camera.height / camera.fy)
    height = float(np.median(centres[:, 2]) - base / ((1.0 - USUAL_OVERLAP) * seen))
    return GroundHeight(height, f"a guess: neighbours overlap by {100 * USUAL_OVERLAP:.0f} %", is_guess=True)


def require_plausible(
    frame: LocalFrame,
    views: list[View],
    over_water: np.ndarray | None,
    config: SurveyConfig,
    headers: Mapping[str, Exif],
    *,
    see_points: bool = False,
) -> None:
    """Raise where cameras lie under the water, far above it, look at the sky, or far from the bounds.

    ``over_water`` are the heights (V,) [m] of the cameras over the water, None in a dry survey.

    Cameras of a dry survey may look up where they see tie points of their poses file (`see_points`), at a cliff or a
    house.
    """
    rises = np.array([view.camera.cam_from_local[2, 2] for view in views])
    if (rises > 0.0).mean() > 0.5 and not (see_points and over_water is None):
        raise PosesError(
            f"{int((rises > 0.0).sum())} of {len(views)} cameras look up at the sky, expected down at the bed; check "
            "the convention of the angles (omega, phi, kappa about the grid axes; camera x right, y up, z back)"
        )
    centres = np.array([view.camera.centre for view in views])
    distance = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    worst = int(np.argmax(distance))
    if distance[worst] > ONE_SURVEY_M:
        place = ", ".join(f"{v:.10g}" for v in frame.crs_from_local(centres[worst]))
        raise PosesError(
            f"the camera of {views[worst].name} at {place} lies {distance_text(distance[worst])} from the others, "
            f"expected at most {distance_text(ONE_SURVEY_M)}; correct its pose or leave the image out"
        )
    if over_water is not None and config.water is not None:
        _require_above_water(frame, views, over_water, config.water, headers)
    if config.area.bounds is not None:
        _require_bounds_near(frame, centres, config.area.bounds)


def _require_above_water(
    frame: LocalFrame, views: list[View], over_water: np.ndarray, water: WaterConfig, headers: Mapping[str, Exif]
) -> None:
    centres = frame.crs_from_local(np.array([view.camera.centre for view in views]))
    heights, at = centres[:, 2] * height_unit_m(frame.crs), place_of(frame.crs, np.median(centres, axis=0))
    why = explanation(float(np.median(over_water)), water.known_level_m, at, frame.crs, above_start_of(headers))
    most_m = DRONE_HEIGHT_M if why else most_over_water([view.camera for view in views])
    like = f"the poses ({frame.crs.name}){why}"
    require_level_fits(water, "the cameras are", heights, over_water, like, most_m=most_m)
    lowest = int(np.argmin(over_water))
    if over_water[lowest] <= 0.0:
        raise PosesError(
            f"the camera of {views[lowest].name} at {heights[lowest]:.2f} m lies {-over_water[lowest]:.2f} m under "
            f"the water ([water] level_m = {water.level_m:g}); correct its pose or leave the image out, or "
            "correct level_m"
        )


def most_over_water(cameras: Sequence[PinholeCamera]) -> float:
    """Largest plausible height of cameras over the water [m], by their spacing, since photographs overlap."""
    by_overlap = float(np.median([camera.centre[2] for camera in cameras])) - ground_below(cameras).height
    return float(np.clip(MOST_OF_OVERLAP * by_overlap, DRONE_HEIGHT_M, AIRCRAFT_HEIGHT_M))


def require_level_fits(
    water: WaterConfig,
    who: str,
    heights: np.ndarray,
    over_water: np.ndarray,
    like: str,
    *,
    most_m: float = AIRCRAFT_HEIGHT_M,
) -> None:
    """Raise where cameras of heights (N,) [m] in crs, and over the water, lie all under it or more than most_m over it.

    In the message, ``who`` is the source of the heights, and ``like`` has the datum that the level should have.
    """
    message = f"[water] level_m is {water.level_m:g} m and {who} at {heights.min():.1f} to {heights.max():.1f} m"
    remedy = f"give level_m in {FILE_NAME} in the same vertical datum as {like}"
    if (over_water <= 0.0).all():
        # With the other sign the water is twice the level lower.
        over_other = over_water + 2.0 * (water.level_m or 0.0)
        is_sign = bool(((over_other > 0.0) & (over_other < DRONE_HEIGHT_M)).all())
        sign = f"give level_m = {-(water.level_m or 0.0):g} if its sign is wrong, else " if is_sign else ""
        raise ConfigError(f"{message}, all of them under the water; {sign}{remedy}")
    if (over_water > most_m).all():
        raise ConfigError(f"{message}, all of them more than {most_m:.0f} m over the water; {remedy}")


def _require_bounds_near(frame: LocalFrame, centres: np.ndarray, bounds: tuple[float, ...]) -> None:
    e0, n0, e1, n1 = bounds
    cameras = frame.crs_from_local(centres)
    if (meant := bounds_in_other_order(bounds, cameras)) is not None:
        raise ConfigError(
            f"[area] bounds {list(bounds)} are not in the order [easting_low, northing_low, easting_high, "
            f"northing_high]: give bounds = {list(meant)}"
        )
    nearest = cameras.copy()
    nearest[:, 0], nearest[:, 1] = cameras[:, 0].clip(e0, e1), cameras[:, 1].clip(n0, n1)
    distances = np.linalg.norm(frame.local_from_crs(nearest) - centres, axis=1)
    # Oblique views reach a few flying heights sideways.
    if not distances.min() < 1000.0:
        east, north, _ = cameras[int(np.argmin(distances))]
        raise ConfigError(
            f"[area] bounds {list(bounds)} lie {distance_text(distances.min())} from the nearest camera, which is "
            f"at {east:.10g}, {north:.10g}; give them in crs ({frame.crs.name}), or correct the CRS of the positions "
            "or control points that place the cameras"
        )


def place_warnings(
    frame: LocalFrame, views: list[View], over_water: np.ndarray | None, headers: dict[str, Exif]
) -> list[str]:
    """Warnings about positions and heights that are possible but more likely a mistake.

    ``over_water`` (N,) [m] are the heights of the cameras over the water; None for a dry survey.
    """
    up = [view.name for view in views if view.camera.cam_from_local[2, 2] > 0.0]
    found = named(up, "camera", "that looks up at the sky by its pose, and shows nothing of the bed")
    centres = np.array([view.camera.centre for view in views])
    if over_water is not None:
        too_high = over_water > DRONE_HEIGHT_M
        names = [view.name for view, is_high in zip(views, too_high, strict=True) if is_high]
        found += named(
            names, "camera", f"more than {DRONE_HEIGHT_M:.0f} m over the water: check that both count from one datum"
        )
    crs_centres = dict(zip((view.name for view in views), frame.crs_from_local(centres), strict=True))
    distances = distances_to_exif(frame.crs, crs_centres, headers)
    away_m = float(np.median(distances)) if distances.size else 0.0
    if away_m > _EXIF_DOUBT_M:
        found.append(f"poses lie {distance_text(away_m)} (median) from GPS positions; check crs and [local] origin")
    return found


def distances_to_exif(crs: CRS, centres: Mapping[str, np.ndarray], headers: Mapping[str, Exif]) -> np.ndarray:
    """Horizontal distances (N,) [m] between camera centres in crs and the GPS positions of their images."""
    positions = {name: headers[name].lat_lon_height for name in centres if name in headers}
    known = {name: position for name, position in positions.items() if position is not None}
    if not known:
        return np.zeros(0)
    lat, lon = np.array([position[:2] for position in known.values()]).T
    own_lon, own_lat = lon_lat(crs, np.array([centres[name][:2] for name in known])).T
    _, _, metres = Geod(ellps="WGS84").inv(lon, lat, own_lon, own_lat)
    return np.where(np.isfinite(metres), metres, np.inf)
