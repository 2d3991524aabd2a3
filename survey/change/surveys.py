"""Two clouds of one place in the cells of one raster: run folders, LAS, LAZ or COPC, in the CRS of the first."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo import Cloud, read_reference, require_same_place
from geo.compatibility import same_crs
from geo.crs import has_height, height_unit_m
from geo.projection import ground_units_m
from geo.reproject import Reprojection
from geo.shapes import in_height_unit, left_out, part_of
from survey.change.volume import Differences
from survey.errors import SurveyError
from survey.export.bed_cells import PlanCells, round_side
from survey.export.cell_fit import CellPoints, correlated_px2, fit_cells
from survey.run.folder import RunDir

# Side of a cell where none is asked for, in spacings of the points.
_SPACINGS_PER_CELL = 4.0


class ChangeError(SurveyError):
    """Two surveys whose difference cannot be computed, or an option whose value makes no sense."""


@dataclass(frozen=True)
class StatedStd:
    """Standard deviations [m] for clouds that do not carry them: of a height, and of what all heights share."""

    own_m: float | None = None
    common_m: float | None = None


@dataclass(frozen=True)
class Sounded:
    """A cloud of the bed with the standard deviations of its heights."""

    path: Path
    points: np.ndarray  # (N, 3), in crs
    # std, common: (N,) [m]
    std: np.ndarray
    common: np.ndarray


def cloud_path(path: Path) -> Path:
    """The cloud of a run folder; a file itself.

    Raises
    ------
    SurveyError
        If a folder is no run.
    """
    if not path.is_dir():
        return path
    run = RunDir(path)
    run.require_run()
    return run.cloud_path


def differences_of(
    first: Path, second: Path, *, stated: StatedStd, shared: float, side_m: float | None
) -> tuple[Differences, PlanCells, list[str]]:
    """The second survey minus the first, the cells, and notes on the surveys.

    Raises
    ------
    GeoError
        If a file cannot be read, or is of another place.
    ChangeError
        If the surveys have no CRS or no cell in common, or standard deviations are missing.
    """
    clouds = [_cloud(path) for path in (first, second)]
    crs, notes = _common_crs(clouds, (first, second))
    sounded = []
    for cloud, path in zip(clouds, (first, second), strict=True):
        each, said = _sounded(cloud, path, crs, stated)
        sounded.append(each)
        notes += said
    require_same_place(sounded[0].points, sounded[1].points, str(first), str(second))
    low = np.max([each.points[:, :2].min(axis=0) for each in sounded], axis=0)
    high = np.min([each.points[:, :2].max(axis=0) for each in sounded], axis=0)
    metres = ground_units_m(crs, 0.5 * (low + high))
    spacing = max(_spacing_m(each.points, metres) for each in sounded)
    side = round_side(_SPACINGS_PER_CELL * spacing) if side_m is None else side_m
    cells = PlanCells.over(np.array([low, high]), crs, side)
    layers = [_gridded(each, cells, crs, spacing) for each in sounded]
    (height_a, std_a, common_a), (height_b, std_b, common_b) = layers
    differences = Differences(height_b - height_a, np.hypot(std_a, std_b), np.stack([common_a, common_b]), shared, side)
    if not differences.is_known.any():
        raise ChangeError(
            f"{first} and {second} have no cell of {side:g} m in common that points of both cover; give a larger "
            "--resolution, or surveys that overlap"
        )
    return differences, cells, notes


def _cloud(path: Path) -> Cloud:
    shape = read_reference(cloud_path(path))
    if not isinstance(shape, Cloud):
        raise ChangeError(f"{path} is a mesh, expected a run folder or a cloud as LAS, LAZ or COPC")
    out, said = left_out(shape)
    if out.all():
        raise ChangeError(f"no point of {path} is of the ground: it holds {said}")
    return part_of(shape, ~out)


def _common_crs(clouds: list[Cloud], paths: tuple[Path, Path]) -> tuple[CRS, list[str]]:
    """The CRS of the first cloud, else of the second, with heights."""
    known = [cloud.crs for cloud in clouds if cloud.crs is not None]
    if not known:
        raise ChangeError(
            f"neither {paths[0]} nor {paths[1]} states its CRS, in which the differences are written; write it into "
            "the files, e.g. by pdal translate --writers.las.a_srs=EPSG:25832+7837"
        )
    notes = []
    for cloud, path in zip(clouds, paths, strict=True):
        if cloud.crs is None:
            notes.append(f"{path} does not say its CRS: taken to be {known[0].name}")
        elif not has_height(cloud.crs):
            notes.append(f"the CRS of {path} does not say what heights count from: taken as those of the other survey")
    crs = next((each for each in known if has_height(each)), known[0])
    return crs if has_height(crs) else crs.to_3d(), notes


def _sounded(cloud: Cloud, path: Path, crs: CRS, stated: StatedStd) -> tuple[Sounded, list[str]]:
    """The points of a survey with their standard deviations, in the common CRS, and notes on them."""
    own, notes = cloud.crs, []
    if own is not None and has_height(own) and not same_crs(own, crs):
        way = Reprojection.between(own, crs, where=f"the CRS of {path}", places=cloud.points)
        cloud = replace(cloud, points=way(cloud.points))
        notes.append(f"{path} is in {own.name}: transformed to {crs.name}")
        notes += [] if way.doubt is None else [way.doubt]
    elif own is not None and not same_crs(own, crs):
        raise ChangeError(
            f"{path} is in {own.name} without heights, and the other survey in {crs.name}; give both in one"
        )
    else:
        unit_m = height_unit_m(crs)
        if own is not None and has_height(own):
            # Equal but for the unit of heights.
            cloud = replace(cloud, points=cloud.points * [1.0, 1.0, height_unit_m(own) / unit_m])
        shape = in_height_unit(cloud, unit_m)
        cloud = shape if isinstance(shape, Cloud) else cloud
    std, of_own = _values(cloud, "std", stated.own_m, path, "--std")
    common, of_common = _values(cloud, "std_common", stated.common_m, path, "--std-common")
    keep = np.isfinite(std) & np.isfinite(common) & np.isfinite(cloud.points).all(axis=1)
    if not keep.any():
        raise ChangeError(f"no point of {path} has a standard deviation; give --std and --std-common")
    return Sounded(path, cloud.points[keep], std[keep], common[keep]), notes + of_own + of_common


def _values(cloud: Cloud, name: str, stated: float | None, path: Path, option: str) -> tuple[np.ndarray, list[str]]:
    """Standard deviations (N,) that a cloud carries, else the one that is stated, with a note."""
    carried = cloud.extra.get(name)
    if carried is not None and np.isfinite(carried).any():
        return np.asarray(carried, dtype=np.float64), []
    if stated is None:
        what = "of its heights" if name == "std" else "that its heights have in common (level, datum, poses)"
        raise ChangeError(f"{path} carries no {name}, the standard deviation {what}; give it in metres, {option} 0.02")
    return np.full(len(cloud.points), stated), [f"{path} carries no {name}: taken as {stated:g} m ({option})"]


def _spacing_m(points: np.ndarray, metres: np.ndarray) -> float:
    """Distance of neighbouring points [m], by their number in the box around the middle half of them."""
    low, high = np.quantile(points[:, :2], [0.25, 0.75], axis=0)
    inside = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
    return float(np.sqrt(np.prod((high - low) * metres) / max(int(inside.sum()), 1)))


def _gridded(sounded: Sounded, cells: PlanCells, crs: CRS, spacing_m: float) -> tuple[np.ndarray, ...]:
    """Heights, their own and their common standard deviations (rows, columns) [m]; NaN where there are none."""
    at = cells.place(sounded.points)
    inside = ((at >= 0.0) & (at < cells.shape[::-1])).all(axis=1)
    at, std, common = at[inside], sounded.std[inside], sounded.common[inside]
    height = sounded.points[inside, 2] * height_unit_m(crs)
    whole = np.floor(at).astype(np.int64)
    number = whole[:, 1] * cells.shape[1] + whole[:, 0]
    layers = np.full((3, cells.shape[0] * cells.shape[1]), np.nan)
    if len(at):
        correlated = correlated_px2(at * cells.side_m, height, std, spacing_m)
        offset = (at - whole - 0.5) * [1.0, -1.0]
        points = CellPoints(number, offset, height, std)
        fits = fit_cells(points, side=cells.side_m, pixel=spacing_m, correlated=correlated)
        size = layers.shape[1]
        mean = np.bincount(number, common**2, size)[fits.cell] / np.bincount(number, minlength=size)[fits.cell]
        layers[:, fits.cell] = fits.height, fits.std, np.sqrt(mean)
    return tuple(layer.reshape(cells.shape) for layer in layers)
