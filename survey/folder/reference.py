"""[control] reference: the dry ground of an earlier survey, read, cut to the block and taken into local."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from pyproj import CRS
from pyproj.crs import CompoundCRS

from geo.compatibility import same_crs
from geo.crs import has_height, height_unit_m, vertical_crs
from geo.frames import LocalFrame
from geo.lines import points_inside, read_polygons
from geo.reading import read_reference
from geo.reproject import Reprojection
from geo.shapes import Cloud, Mesh, in_height_unit, left_out, part_of, vertices_of
from geo.transformation import Transformation
from survey.control.points import StableGround
from survey.errors import ControlError, Findings
from survey.settings.config import SurveyConfig

# Of a reference that does not say it: airborne lidar, or photogrammetry on control.
DEFAULT_STD_M = 0.1
# Ground that is less above the water [m], or less standard deviations of the level, may be wet.
_LEAST_ABOVE_M, _LEAST_SIGMAS = 0.1, 3.0
# Around the middle of the cameras and tie points, in sizes of what these span.
_REACH = 1.5
_MOST_POINTS = 1_000_000
# Fewer points are no ground.
_FEWEST = 50


def read_ground(
    folder: Path,
    config: SurveyConfig,
    frame: LocalFrame,
    places: np.ndarray,
    above_water: Callable[[np.ndarray], np.ndarray] | None,
    *,
    is_level_known: bool,
) -> tuple[StableGround | None, Findings]:
    """The stable dry ground of the reference; None without a reference.

    Parameters
    ----------
    places : (N, 3) [m], local
        Cameras and tie points.
    above_water : callable, or None
        Heights (K,) [m] of places (K, 3), local, above the water; None where there is none.

    Raises
    ------
    ControlError, GeoError
        If a file cannot be read or taken to crs, or holds no dry ground of the place.
    """
    given = config.control
    if given.reference is None:
        return None, Findings()
    if above_water is not None and not is_level_known and given.stable is None:
        raise ControlError(
            "[control] reference: the level of the water is not given, so that nothing tells which ground of "
            f"{given.reference} is dry; give level_m, or polygons of stable ground in [control] stable"
        )
    path = folder / given.reference
    cloud, way_std, of_file = _in_crs(path, frame.crs)
    num_all = len(cloud.points)
    if given.stable is not None:
        inside = points_inside(read_polygons(folder / given.stable, frame.crs), cloud.points[:, :2])
        if not inside.any():
            raise ControlError(f"no point of {path} lies in the polygons of {given.stable}; correct them or their CRS")
        cloud = part_of(cloud, inside)
    # Two corners give the box in metres of the map, whatever its units.
    around = frame.crs_from_local(_box(places))
    low, high = around.min(axis=0)[:2], around.max(axis=0)[:2]
    cloud = part_of(cloud, ((cloud.points[:, :2] >= low) & (cloud.points[:, :2] <= high)).all(axis=1))
    if len(cloud.points) > _MOST_POINTS:
        chosen = np.random.default_rng(0).choice(len(cloud.points), _MOST_POINTS, replace=False)
        keep = np.zeros(len(cloud.points), dtype=bool)
        keep[chosen] = True
        cloud = part_of(cloud, keep)
    local = frame.local_from_crs(cloud.points)
    dry = np.ones(len(local), dtype=bool)
    if above_water is not None and is_level_known:
        level_std = config.water.level_std_m if config.water is not None else None
        dry = above_water(local) > max(_LEAST_ABOVE_M, _LEAST_SIGMAS * (level_std or 0.0))
    if dry.sum() < _FEWEST:
        raise ControlError(
            f"{path} has {int(dry.sum())} points of dry ground near the photographs, expected at least {_FEWEST} "
            f"(of {num_all} points, {len(local)} are near the photographs); give a reference of the bank or of rocks "
            "over the water, in the vertical datum of crs"
        )
    std, said = _shared_std(given.reference_std_m, part_of(cloud, dry), given.reference)
    return StableGround(local[dry], (math.hypot(std[0], way_std[0]), math.hypot(std[1], way_std[1]))), of_file + said


def _box(places: np.ndarray) -> np.ndarray:
    """Corners (4, 3) of a box in plan about places, larger than what these span."""
    middle = np.median(places, axis=0)
    x, y = _REACH * np.maximum(np.abs(places - middle).max(axis=0)[:2], 1.0)
    return middle + np.array([[-x, -y, 0.0], [-x, y, 0.0], [x, -y, 0.0], [x, y, 0.0]])


def _in_crs(path: Path, crs: CRS) -> tuple[Cloud, tuple[float, float], Findings]:
    """The ground of a file in the crs of the survey, the accuracy of the operation [m], and what was assumed."""
    shape = read_reference(path)
    cloud = Cloud(points=vertices_of(shape), crs=shape.crs) if isinstance(shape, Mesh) else shape
    if isinstance(shape, Mesh):
        cloud = replace(cloud, height_unit_m=shape.height_unit_m)
    out, said = left_out(cloud)
    notes = [f"{path.name}: {said} are left out"] if said else []
    cloud = part_of(cloud, ~out)
    own = cloud.crs
    if own is None or not has_height(own):
        of = "its CRS" if own is None else "what its heights count from"
        notes.append(f"{path.name} does not say {of}: taken to be that of the survey")
    if own is not None and not has_height(own):
        vertical = vertical_crs(crs)
        own = own.to_3d() if vertical is None else CompoundCRS(f"{own.name} + {vertical.name}", [own, vertical])
    if own is not None and not same_crs(own, crs):
        if cloud.height_unit_m is not None:
            cloud = replace(cloud, points=cloud.points * [1.0, 1.0, cloud.height_unit_m / height_unit_m(own)])
        way = Reprojection.between(own, crs, where=f"the CRS of {path}", places=cloud.points)
        found = Findings(tuple(notes), () if way.doubt is None else (way.doubt,))
        accuracy_m = Transformation.between(own, way.crs, cloud.points).accuracy_m or 0.0
        return replace(cloud, points=way(cloud.points), crs=crs), (accuracy_m, way.height_std_m), found
    unit_m = height_unit_m(crs)
    if own is not None and has_height(own):
        cloud = replace(cloud, points=cloud.points * [1.0, 1.0, height_unit_m(own) / unit_m])
    scaled = in_height_unit(cloud, unit_m)
    return scaled if isinstance(scaled, Cloud) else cloud, (0.0, 0.0), Findings(tuple(notes))


def _shared_std(
    given: float | tuple[float, float] | None, cloud: Cloud, name: str
) -> tuple[tuple[float, float], Findings]:
    """Standard deviation of a shift of the reference: as given, as the cloud carries it, or assumed."""
    if isinstance(given, tuple):
        return given, Findings()
    if given is not None:
        return (given, given), Findings()
    carried = cloud.extra.get("std_common")
    if carried is not None and np.isfinite(carried).any():
        std = float(np.nanmedian(carried))
        return (std, std), Findings((f"[control] reference_std_m = {std:.2g}, the std_common of {name}",))
    return (DEFAULT_STD_M, DEFAULT_STD_M), Findings(
        (f"[control] reference_std_m = {DEFAULT_STD_M:g}, what all points of {name} may be off by together",),
        (
            f"no accuracy is stated for {name}: {DEFAULT_STD_M:g} m in common is assumed; give [control] "
            "reference_std_m, e.g. 0.05, or [0.1, 0.05] horizontally and vertically",
        ),
    )
