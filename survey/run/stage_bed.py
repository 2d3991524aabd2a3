"""The stages of the bed: height maps become points, every piece of the bed once, and points beside edges are added.

Each tile has points; the bed is those of all, with the parts of their std that follow from it as a whole.

Sweep and solver bend rays at a plane. Where the water was measured as a surface, each point is projected into the
photographs that show it, through that plane; the rays of these pixels are bent where they meet the measured surface,
and the point goes to where they come closest to each other. A surface that is higher by d sinks the bed beneath it by
(n - 1) d or more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from fields.occluded.holes import KnownBed
from fields.occluded.occluded import find_occluded
from fields.solver.solver import SolvedMap
from fields.sweep.bed import BedPoints
from fields.sweep.map_points import without_ghosts
from fields.sweep.maps import HeightMap
from fields.sweep.views import Footprint
from geo.shapes import portions
from refract import FlatWater, PinholeCamera, kernels
from refract.curved import BicubicWater
from survey.adjust.result.std_common import BASIS_ADJUSTED, BASIS_STATED, std_common
from survey.display.plan_grid import median
from survey.display.quantities import length
from survey.errors import SurveyError
from survey.files.json_values import read_json_object
from survey.photos.cameras import equations_of_lines
from survey.plan.area import inside
from survey.progress import shares
from survey.run.job import colour_of
from survey.run.points import adjustment_of, bed_points, is_placed, with_std_of_block
from survey.run.stage_solver import SOLVED, WAVES
from survey.run.stage_sweep import KEPT, MAPS
from survey.run.stored import (
    BED_FILE,
    SURVEY_FILE,
    Column,
    StoredBed,
    columns_in,
    mapped_arrays,
    save_bed,
    write_arrays,
)
from survey.run.stored_maps import Stored, load_masks
from survey.water.surface import Departure

if TYPE_CHECKING:
    from survey.folder.survey import Survey
    from survey.run.job import Job

# Steps to where a ray meets the surface: each leaves the square of its slope, a thousandth, of the error.
_STEPS = 2
_AT_ONCE = 100_000
# Rays nearer to parallel than half a degree place nothing.
_LEAST_DETERMINANT = 1.5e-4
# Least cosine of a ray in air to the vertical for which the effect on a height is computed.
_LEAST_COSINE = 0.2
# Std of the height of a raised plane that stands for what the search for the bed would do otherwise under it.
_RAISED_SHARE = 0.07
# Points whose rays are bent anew at it.
_RAISED_SAMPLE = 20_000
FILES = (BED_FILE, SURVEY_FILE)
POINTS = "points.npz"
# In the folder of the stage, while it lasts: the points of all tiles.
GATHERED = "gathered.npz"
# Points whose coordinates are worked out at a time, of 200 bytes each.
_PORTION = 200_000


def through_surface(
    bed: BedPoints, cameras: Sequence[PinholeCamera], plane: FlatWater, departure: Departure
) -> BedPoints:
    """Points under the measured surface, with the std that it adds, from those of a bed found under a plane."""
    if not len(bed):
        return bed
    # Rays enter the water beside their points.
    reach = max(float(np.nanmax(bed.depth)), 0.0) + 1.0
    west, south = (bed.xyz[:, :2].min(axis=0) - reach).tolist()
    east, north = (bed.xyz[:, :2].max(axis=0) + reach).tolist()
    area = (west, south, east, north)
    surface, of_surface = departure.surface(area, plane), departure.interpolated_std(area)
    return _at(bed, _intersected(bed.xyz, cameras, plane, surface), surface, of_surface(bed.xyz[:, :2]))


def through_raised(bed: BedPoints, cameras: Sequence[PinholeCamera], plane: FlatWater, raised: FlatWater) -> BedPoints:
    """Points under a plane that is raised a little, found under a plane, with the std that this adds.

    How far they go depends on the photographs around them, hardly on their depth: each goes as far as the nearest of
    those whose rays are bent anew.
    """
    wet = np.flatnonzero(bed.wet)
    if not len(wet):
        return _at(bed, bed.xyz, raised, np.zeros(len(bed)))
    sample = wet[:: max(len(wet) // _RAISED_SAMPLE, 1)]
    moves = _intersected(bed.xyz[sample], cameras, plane, raised) - bed.xyz[sample]
    xyz, tree = bed.xyz.copy(), cKDTree(bed.xyz[sample])
    for rows in portions(len(wet), _PORTION):
        xyz[wet[rows]] += moves[tree.query(bed.xyz[wet[rows]])[1]]
    std = _RAISED_SHARE * abs(float(raised.point[2] - plane.height(*raised.point[:2])))
    return _at(bed, xyz, raised, np.full(len(bed), std))


def _intersected(
    xyz: np.ndarray, cameras: Sequence[PinholeCamera], plane: FlatWater, surface: BicubicWater | FlatWater
) -> np.ndarray:
    """Places (N, 3) under a surface of points (N, 3) found under a plane."""
    heights = (xyz - np.array(plane.point)) @ np.array(plane.up)
    grounds = [Footprint.of(camera, plane, (float(heights.min()), float(heights.max()))) for camera in cameras]
    parts = []
    for first in range(0, len(xyz), _AT_ONCE):
        points = xyz[first : first + _AT_ONCE]
        footprint = Footprint(points[:, :2].min(axis=0), points[:, :2].max(axis=0))
        near = [camera for camera, ground in zip(cameras, grounds, strict=True) if ground.meets(footprint)]
        parts.append(_placed(points, near, plane, surface))
    return np.concatenate(parts)


def _at(bed: BedPoints, xyz: np.ndarray, surface: BicubicWater | FlatWater, of_surface: np.ndarray) -> BedPoints:
    """Points at other places under a surface whose height has a std (N,) [m] over them."""
    depth = surface.height(xyz[:, 0], xyz[:, 1]) - xyz[:, 2]
    wet = depth > 0.0
    added = np.where(wet, bed_per_level(bed.incidence, float(surface.n_water)) * of_surface, 0.0)
    return replace(
        bed, xyz=xyz, depth=depth.astype(np.float32), wet=wet, std=np.hypot(bed.std, added).astype(np.float32)
    )


def bed_per_level(incidence: np.ndarray, n_water: float) -> np.ndarray:
    """Change of a bed point's height per metre of the water over it [-].

    A ray that enters the water a metre earlier comes out ``tan a - tan b`` aside at the bed, with ``sin a = n sin b``,
    and rays of this incidence meet lower by that over ``tan b``: n - 1 straight down, and more for oblique rays.
    """
    sine = np.minimum(np.sin(incidence), np.sqrt(1.0 - _LEAST_COSINE**2))
    return n_water * np.sqrt((1.0 - (sine / n_water) ** 2) / (1.0 - sine**2)) - 1.0


def _placed(
    points: np.ndarray, cameras: Sequence[PinholeCamera], plane: FlatWater, surface: BicubicWater | FlatWater
) -> np.ndarray:
    """Points (N, 3) where their rays come closest through the surface; as they are where fewer than two are known.

    Rays count by how many pixels their photograph shows them apart: those of oblique views by fewer.
    """
    count = np.zeros(len(points), dtype=int)
    wet_sums, dry_sums = ((np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))) for _ in range(2))
    for camera in cameras:
        pixels = camera.project(points, plane)
        seen = camera.sees(pixels)
        number, path = np.flatnonzero(seen), camera.paths(pixels[seen], plane)
        crossing, bent = _entered(path.crossing, path.air_direction, surface, camera.tide)
        known = path.wet & np.isfinite(bent).all(axis=1)
        # Of distances in air, and of those in water beside them.
        px_per_m = camera.fx / np.linalg.norm(points[seen] - camera.centre, axis=1)[known]
        at_bed = px_per_m * path.air_direction[known, 2] / bent[known, 2]
        _add(wet_sums, number[known], crossing[known], bent[known], at_bed**2)
        _add(dry_sums, number[known], path.origin[known], path.air_direction[known], px_per_m**2)
        count[number[known]] += 1
    # Of two nearly parallel rays the determinant is twice the square of their angle, times the cube of their weight.
    weight = np.trace(wet_sums[0], axis1=1, axis2=2) / (2.0 * np.maximum(count, 1))
    found = (count >= 2) & (np.linalg.det(wet_sums[0]) > _LEAST_DETERMINANT * weight**3)
    placed = points.copy()
    under = np.linalg.solve(wet_sums[0][found], wet_sums[1][found][..., None])[..., 0]
    over = np.linalg.solve(dry_sums[0][found], dry_sums[1][found][..., None])[..., 0]
    is_wet = under[:, 2] < surface.height(under[:, 0], under[:, 1])
    placed[found] = np.where(is_wet[:, None], under, over)
    return placed


def _entered(
    crossing: np.ndarray, ray: np.ndarray, surface: BicubicWater | FlatWater, tide: float
) -> tuple[np.ndarray, np.ndarray]:
    """Crossings of rays in air with the surface, near those with a plane, and their directions in water (N, 3)."""
    for _ in range(_STEPS):
        normal = np.column_stack(_normals(surface, crossing))
        over = surface.height(crossing[:, 0], crossing[:, 1]) + tide - crossing[:, 2]
        crossing = crossing + (over * normal[:, 2] / np.sum(ray * normal, axis=1))[:, None] * ray
    bent = kernels.bend(tuple(ray.T), _normals(surface, crossing), 1.0, surface.n_water)
    return crossing, np.column_stack(bent)


def _normals(surface: BicubicWater | FlatWater, crossing: np.ndarray) -> tuple[np.ndarray, ...]:
    """Components (N,) of the normals at crossings (N, 3); those of a plane are numbers."""
    x, y = crossing[:, :2].T
    return tuple(np.broadcast_to(each, x.shape) for each in surface.normal(x, y))


def _add(
    sums: tuple[np.ndarray, np.ndarray], number: np.ndarray, through: np.ndarray, along: np.ndarray, weight: np.ndarray
) -> None:
    """Add lines to the normal equations of the points nearest to them; a point has one line at most here."""
    normals, rights = equations_of_lines(through, along)
    sums[0][number] += weight[:, None, None] * normals
    sums[1][number] += weight[:, None] * rights


class SolvedHeights(Sequence[HeightMap]):
    """Height maps with the heights of the solver, each made when it is asked for."""

    def __init__(self, maps: Sequence[HeightMap], solved: Sequence[SolvedMap]):
        self._maps, self._solved = maps, solved

    def __len__(self) -> int:
        return len(self._maps)

    def __getitem__(self, number):
        """The map at a place in the order."""
        return self._solved[number].over(self._maps[number])[0]


def with_occluded(
    job: Job, maps: Sequence[HeightMap], solved: Sequence[SolvedMap], bed: BedPoints, tide: np.ndarray
) -> tuple[BedPoints, np.ndarray]:
    """Points of the bed and their tides (N,) [m], and those that only boxes beside depth steps find."""
    views, scale = job.survey.views, job.plan.image_scale
    with job.progress.stage("Boxes beside edges", 1.0) as stage:
        found = find_occluded(
            job.block,
            SolvedHeights(maps, solved),
            lambda view: job.photographs.load(views[view], scale=scale),
            KnownBed(bed.xyz, job.plan.gsd_m, job.own_ground),
            shares(stage),
        )
    if not found.num_boxes:
        job.progress.detail("boxes: none, the cloud has no holes beside depth steps")
        return bed, tide
    if found.is_no_bed:
        job.progress.detail(
            f"boxes: of {found.num_boxes} beside depth steps hardly any show a bed in the holes of the cloud; none used"
        )
        return bed, tide
    left_out = f" ({found.num_left_out} with fewer left out)" if found.num_left_out else ""
    job.progress.detail(
        f"boxes: {found.num_boxes} beside depth steps, where the cloud has holes{left_out}; {len(found.points):,} more "
        "points, on which three photographs or more agree"
    )
    tides = np.array([camera.tide for camera in job.block.cameras])
    return BedPoints.concatenate([bed, found.points]), np.concatenate([tide, tides[found.view]])


def find_points(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Points of the bed, those of a tile by their places, with the heights of the solver, if there are."""
    bed = points_of_bed(job, needs) if len(Stored(needs["sweep"] / MAPS, HeightMap)) else BedPoints.empty()
    if job.cell is not None:
        bed = bed[inside(bed.xyz, job.cell)]
    columns: dict[str, np.ndarray | Column] = {each.name: getattr(bed, each.name) for each in fields(BedPoints)}
    write_arrays(folder / POINTS, (columns | {"points_crs": in_crs(job.survey_job.survey, bed.xyz)}).items())


def points_of_bed(job: Job, needs: Mapping[str, Path]) -> BedPoints:
    """Points of the bed in their colours, with the std of their own; of the boxes, too, where the plan has them."""
    survey = job.survey
    maps = Stored(needs["sweep"] / MAPS, HeightMap)
    solved = Stored(needs["solver"] / SOLVED, SolvedMap) if "solver" in needs else None
    is_of_sweep = job.plan.solves and solved is None
    with job.progress.stage("Points of the sweep alone" if is_of_sweep else "Points", len(maps)) as stage:
        kept = load_masks(needs["sweep"] / KEPT)
        if solved is not None:
            kept = without_ghosts(job.block, SolvedHeights(maps, solved), kept, job.plan.gsd_m)
        bed, tide = bed_points(job, maps, kept, solved, stage.advance)
    if solved is not None and job.plan.boxes and len(bed):
        bed, tide = with_occluded(job, maps, solved, bed, tide)
    if survey.water is not None and survey.observations.departure is not None:
        bed = through_surface(bed, [view.camera for view in survey.views], survey.water, survey.observations.departure)
    if job.chosen.true_colour and len(bed):
        # Imported where it is needed: it takes torch, whose import takes seconds.
        from fields.colour.true_colour import true_colours
        from fields.water_column import WaterColumn

        water, _ = survey.require_water()
        rgb, too_bright = true_colours(bed, water, WaterColumn(*colour_of(job.survey_job.survey)), tide)
        bed = replace(bed, rgb=rgb)
        job.progress.detail(f"{100 * too_bright:.1f} % of the points are saturated after the water is removed")
    return bed


def in_crs(survey: Survey, xyz: np.ndarray) -> Column:
    """Points (N, 3) [m], local, as a column in crs."""
    parts = (survey.frame.crs_from_local(xyz[rows]) for rows in portions(len(xyz), _PORTION))
    return Column(np.dtype(np.float64), xyz.shape, parts)


def make_bed(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Points of all tiles with the parts of their std that follow from the whole bed."""
    survey, found = job.asked or job.survey, adjustment_of(needs)
    with job.progress.stage("Bed"), columns_in(folder) as new_column:
        bed, xyz_in_crs = _gathered([p for each in needs.values() if (p := each / POINTS).is_file()], folder / GATHERED)
        if len(bed) == 0:
            raise SurveyError(
                "no point of the bed was confirmed by two views; check that poses, water level and images belong "
                "together (bathynerf check) and that the views overlap"
            )
        if job.asked is not None:
            bed = through_raised(
                bed, [view.camera for view in survey.views], job.survey.require_water()[0], survey.require_water()[0]
            )
            xyz_in_crs = in_crs(survey, bed.xyz)
        common, in_plan = new_column(len(bed)), new_column(len(bed))
        std_common(bed.xyz, bed.wet, survey, found, job.plan.gsd_m, common, in_plan)
        of_waves = (read_json_object(place / WAVES) for place in needs.values() if (place / WAVES).is_file())
        by_waves = max((each["common_std_m"] for each in of_waves), default=0.0)
        np.hypot(common, by_waves, out=common, where=bed.wet)
        bed, of_block = with_std_of_block(bed, survey, found, job.plan.gsd_m, new_column)
        std_placed = None
        if of_block is not None:
            of_median = length(median(of_block))
            job.progress.detail(f"std: {of_median} (median) of it from tilt and shift of the block")
            std_placed = of_block if is_placed(survey) else None
        basis = BASIS_STATED if found is None else BASIS_ADJUSTED
        job.progress.detail(f"std_common: {length(median(common))} (median), by {basis}")
        of_places = common, std_placed, in_plan
        save_bed(folder, StoredBed(bed, xyz_in_crs, survey.frame.crs, survey.name, job.plan.gsd_m, *of_places))
    (folder / GATHERED).unlink(missing_ok=True)


def use_bed(job: Job, _folder: Path) -> None:
    """Take the level that is asked for, under which the points lie now."""
    if job.asked is not None:
        asked, job.asked = job.asked, None
        job.use_survey(asked)


def _gathered(of_parts: Sequence[Path], path: Path) -> tuple[BedPoints, np.ndarray | Column]:
    """Points of `find_points`, local and (N, 3) in crs; those of several tiles are gathered in a file."""
    if len(of_parts) > 1:
        names = [*(each.name for each in fields(BedPoints)), "points_crs"]

        def column(name: str) -> Column:
            parts = [mapped_arrays(each, (name,))[name] for each in of_parts]
            return Column(parts[0].dtype, (sum(map(len, parts)), *parts[0].shape[1:]), parts)

        write_arrays(path, ((name, column(name)) for name in names))
    columns = mapped_arrays(path if len(of_parts) > 1 else of_parts[0])
    points_crs = columns.pop("points_crs")
    return BedPoints(**columns), points_crs
