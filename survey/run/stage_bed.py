"""The stages of the bed: height maps become points, every piece of the bed once, and points beside edges are added.

Each tile has points; the bed is those of all, with the parts of their std that follow from it as a whole.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from fields.occluded.holes import KnownBed
from fields.occluded.occluded import find_occluded
from fields.solver.solver import SolvedMap
from fields.sweep.bed import BedPoints, has_neighbours, is_supported, points_of, std_of_kept, with_slope_std
from fields.sweep.block import AGREEMENT_PX
from fields.sweep.fusion import PEERS, num_comparable
from fields.sweep.images import median
from fields.sweep.map_points import without_ghosts
from fields.sweep.maps import HeightMap, trusted
from geo.shapes import portions
from survey.adjust.result.adjustment import read_adjustment
from survey.adjust.result.std_common import BASIS_ADJUSTED, BASIS_STATED, std_common, std_of_block
from survey.display.plan_grid import median as median_of
from survey.display.quantities import length
from survey.errors import SurveyError
from survey.files.json_values import read_json_object
from survey.folder.survey import Survey
from survey.plan.area import inside, within
from survey.plan.sweep_block import camera_of
from survey.progress import shares
from survey.run import stored
from survey.run.job import Job, colour_of
from survey.run.points import through_raised, through_surface
from survey.run.stage_solver import SOLVED, WAVES
from survey.run.stage_sweep import KEPT, MAPS
from survey.run.stored_maps import Stored, load_masks

LEAST_STD_PX = 0.01
FILES = (stored.BED_FILE, stored.SURVEY_FILE)
POINTS = "points.npz"
# In the folder of the stage, while it lasts: the points of all tiles.
GATHERED = "gathered.npz"
# Points whose coordinates are worked out at a time, of 200 bytes each.
_PORTION = 200_000


def bed_points(
    job: Job,
    maps: Sequence[HeightMap],
    kept: Sequence[np.ndarray],
    solved: Sequence[SolvedMap] | None,
    advance: Callable[[float], None],
) -> tuple[BedPoints, np.ndarray]:
    """Points of the bed of the kept pixels (height, width) of maps, without duplicates, with the heights of the solver.

    Coloured from the photograph that shows each steepest; returns the points and the tides (N,) [m] of these.
    """
    survey, plan, block = job.survey, job.plan, job.block
    parts, sources, tides, area = [], [], [], job.ground
    comparable_of = num_comparable(block, maps)
    for number, (height_map, keep, comparable) in enumerate(zip(maps, kept, comparable_of, strict=True)):
        view = survey.views[height_map.view]
        camera = camera_of(view, plan)
        rgb = job.photographs.load(view, scale=plan.image_scale)
        # [px/m]: of the bed of the map in the views that confirm its heights
        parallax = block.parallax(height_map.view, block.neighbours(height_map.view, PEERS), median(height_map.height))
        tolerance = AGREEMENT_PX / parallax
        if len(block.neighbours(height_map.view, PEERS)) == 1:
            keep = keep & is_supported(height_map.height, trusted(height_map), tolerance)
        keep = keep[: camera.height, : camera.width]
        final, std = (height_map, None) if solved is None else solved[number].over(height_map)
        std = std_of_kept(final, keep, tolerance, std, comparable)
        points = points_of(camera, survey.water, final, keep, rgb, std)
        points = with_slope_std(points, final.height, keep, plan.gsd_m, survey.water)
        # Floor of std at 0.01 px of parallax: heights that agree exactly do so by chance.
        points = replace(points, std=np.maximum(points.std, np.float32(LEAST_STD_PX / parallax)))
        if area is not None:
            points = points[within(points.xyz, area)]
        parts.append(points)
        sources.append(np.full(len(points), number, dtype=np.int32))
        tides.append(camera.tide)
        advance(1.0)
    bed, is_kept = BedPoints.consume_where(parts, lambda xyz: has_neighbours(xyz, plan.gsd_m))
    return bed, np.array(tides)[np.concatenate(sources)[is_kept]]


class SolvedHeights(Sequence[HeightMap]):
    """Height maps with the heights of the solver, each made when it is asked for."""

    def __init__(self, maps: Sequence[HeightMap], solved: Sequence[SolvedMap]):
        self._maps, self._solved = maps, solved

    def __len__(self) -> int:
        return len(self._maps)

    def __getitem__(self, number):
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
    columns: dict[str, np.ndarray | stored.Column] = {each.name: getattr(bed, each.name) for each in fields(BedPoints)}
    stored.write_arrays(folder / POINTS, (columns | {"points_crs": in_crs(job.survey_job.survey, bed.xyz)}).items())


def points_of_bed(job: Job, needs: Mapping[str, Path]) -> BedPoints:
    """Points of the bed in their colours, with the std of their own; of the boxes, too, where the plan has them."""
    survey = job.survey
    maps = Stored(needs["sweep"] / MAPS, HeightMap)
    solved = Stored(needs["solver"] / SOLVED, SolvedMap) if "solver" in needs else None
    with job.progress.stage("Points", len(maps)) as stage:
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


def in_crs(survey: Survey, xyz: np.ndarray) -> stored.Column:
    """Points (N, 3) [m], local, as a column in crs."""
    parts = (survey.frame.crs_from_local(xyz[rows]) for rows in portions(len(xyz), _PORTION))
    return stored.Column(np.dtype(np.float64), xyz.shape, parts)


def make_bed(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Points of all tiles with the parts of their std that follow from the whole bed."""
    survey, found = job.asked or job.survey, read_adjustment(needs["adjust"]) if "adjust" in needs else None
    with job.progress.stage("Bed"), stored.columns_in(folder) as new_column:
        bed, xyz_in_crs = _gathered([p for each in needs.values() if (p := each / POINTS).is_file()], folder / GATHERED)
        if len(bed) == 0:
            raise SurveyError(
                "no point of the bed was confirmed by two views; check that poses, water level and images belong "
                "together (bathynerf check) and that the views overlap"
            )
        if job.asked is not None:
            bed = through_raised(bed, job.survey, survey)
            xyz_in_crs = in_crs(survey, bed.xyz)
        common, in_plan = new_column(len(bed)), new_column(len(bed))
        std_common(bed.xyz, bed.wet, survey, found, job.plan.gsd_m, (common, in_plan))
        of_waves = (read_json_object(place / WAVES) for place in needs.values() if (place / WAVES).is_file())
        by_waves = max((each["common_std_m"] for each in of_waves), default=0.0)
        np.hypot(common, by_waves, out=common, where=bed.wet)
        std_placed = None
        if found is not None:
            of_block = std_of_block(bed.xyz, survey, found, job.plan.gsd_m, new_column(len(bed)))
            bed = replace(bed, std=np.hypot(bed.std, of_block, out=new_column(len(bed))))
            job.progress.detail(f"std: {length(median_of(of_block))} (median) of it from tilt and shift of the block")
            # GPS or control alone determines the datum of such a block, whose std no processing reduces.
            std_placed = of_block if survey.config.cameras.poses is None else None
        basis = BASIS_STATED if found is None else BASIS_ADJUSTED
        job.progress.detail(f"std_common: {length(median_of(common))} (median), by {basis}")
        of_places = common, std_placed, in_plan
        stored.save_bed(
            folder, stored.StoredBed(bed, xyz_in_crs, survey.frame.crs, survey.name, job.plan.gsd_m, *of_places)
        )
    (folder / GATHERED).unlink(missing_ok=True)


def use_bed(job: Job, _folder: Path) -> None:
    """Take the level that is asked for, under which the points lie now."""
    if job.asked is not None:
        asked, job.asked = job.asked, None
        job.use_survey(asked)


def _gathered(of_parts: Sequence[Path], path: Path) -> tuple[BedPoints, np.ndarray | stored.Column]:
    """Points of `find_points`, local and (N, 3) in crs; those of several tiles are gathered in a file."""
    if len(of_parts) > 1:
        names = [*(each.name for each in fields(BedPoints)), "points_crs"]

        def column(name: str) -> stored.Column:
            parts = [stored.mapped_arrays(each, (name,))[name] for each in of_parts]
            return stored.Column(parts[0].dtype, (sum(map(len, parts)), *parts[0].shape[1:]), parts)

        stored.write_arrays(path, ((name, column(name)) for name in names))
    columns = stored.mapped_arrays(path if len(of_parts) > 1 else of_parts[0])
    points_crs = columns.pop("points_crs")
    return BedPoints(**columns), points_crs
