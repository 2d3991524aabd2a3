"""The stage of the bed: height maps become points, every piece of the bed once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fields.median import median
from fields.solver.solver import SolvedMap
from fields.sweep.bed import BedPoints, has_company, points_of, unique_pixels
from fields.sweep.block import AGREEMENT_PX
from fields.sweep.maps import DepthMap
from fields.sweep.sweep import PEERS
from survey.adjust.adjustment import read_adjustment
from survey.adjust.std_common import BASIS_ADJUSTED, BASIS_STATED, std_common
from survey.adjust.std_of_block import std_of_block
from survey.display.quantities import length
from survey.errors import SurveyError
from survey.plan.area import AREA_MARGIN_M, grown, local_area, within
from survey.plan.block import backend, camera_of
from survey.run.stage_solver import SOLVED
from survey.run.stage_sweep import MAPS, look_at_bed
from survey.run.stored import BED_FILE, SURVEY_FILE, StoredBed, save_bed
from survey.run.stored_maps import Stored
from survey.run.water_colour import colour_of

if TYPE_CHECKING:
    from fields.slab.tensor_field import TensorField
    from fields.sweep.block import Block
    from survey.run.job import Job

FILES = (BED_FILE, SURVEY_FILE)
LEAST_STD_PX = 0.01
# Points whose coordinates are worked out at a time, of 200 bytes each.
_PORTION = 200_000


def make_bed(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Points of the bed, with the heights of the solver, or of the field where one was trained.

    Raises
    ------
    SurveyError
        If no two views confirm a point.
    """
    survey = job.survey
    maps = Stored(needs["sweep"] / MAPS, DepthMap)
    field = _field_of(job, needs["field"]) if "field" in needs else None
    solved = Stored(needs["solver"] / SOLVED, SolvedMap) if "solver" in needs else None
    look_at_bed(job, needs["sweep"])
    with job.progress.stage("Bed", len(maps)) as stage:
        kept = job.once(needs["sweep"], lambda: unique_pixels(job.block, maps, job.plan.gsd_m))
        bed, tide, moved = bed_points(job, maps, field, stage.advance, solved, kept)
    if field is not None:
        job.progress.detail(f"{moved:,} of {len(bed):,} points have the field's height")
    if len(bed) == 0:
        raise SurveyError(
            "no point of the bed was confirmed by two views; check that poses, water level and images belong "
            "together (bathynerf check) and that the views overlap"
        )
    if job.chosen.true_colour:
        # Imported where it is needed: it takes torch, whose import takes seconds.
        from fields.colour.true_colour import true_colours
        from fields.water_column import WaterColumn

        water, _ = survey.require_water()
        rgb, too_bright = true_colours(bed, water, WaterColumn(*colour_of(survey)), tide)
        bed = replace(bed, rgb=rgb)
        job.progress.detail(f"{100 * too_bright:.1f} % of the points are brighter than white without the water")
    found = read_adjustment(needs["adjust"]) if "adjust" in needs else None
    common = std_common(bed.xyz, bed.wet, survey, found, job.plan.gsd_m)
    std_placed = None
    if found is not None:
        of_block = std_of_block(bed.xyz, survey, found, job.plan.gsd_m)
        bed = replace(bed, std=np.hypot(bed.std, of_block))
        job.progress.note(f"std: {length(float(np.median(of_block)))} (median) of it by what tilts or shifts the block")
        std_placed = of_block if survey.config.cameras.poses is None else None
    basis = BASIS_STATED if found is None else BASIS_ADJUSTED
    job.progress.note(f"std_common: {length(float(np.nanmedian(common)))} (median), by {basis}")
    points_crs = np.empty_like(bed.xyz)
    for first in range(0, len(bed), _PORTION):
        points_crs[first : first + _PORTION] = survey.frame.crs_from_local(bed.xyz[first : first + _PORTION])
    save_bed(folder, StoredBed(bed, points_crs, survey.frame.crs, survey.name, job.plan.gsd_m, common, std_placed))


def _field_of(job: Job, folder: Path) -> TensorField:
    from survey.run.stored_field import load_field

    return load_field(folder, backend(job.plan))


def bed_points(
    job: Job,
    maps: Sequence[DepthMap],
    field: TensorField | None,
    advance: Callable[[float], None],
    solved: Sequence[SolvedMap] | None = None,
    kept: Sequence[np.ndarray] | None = None,
) -> tuple[BedPoints, np.ndarray, int]:
    """Every piece of the bed once, coloured from the photograph that shows it steepest.

    ``kept`` is what `fields.sweep.bed.unique_pixels` finds, where it is known.

    Returns the points, the tides (N,) [m] of their photographs, and how many took their height from the field.
    """
    survey, plan, block = job.survey, job.plan, job.block
    parts, sources, tides, moved, area = [], [], [], 0, local_area(survey)
    if kept is None:
        kept = unique_pixels(block, maps, plan.gsd_m)
    for number, (depth_map, keep) in enumerate(zip(maps, kept, strict=True)):
        view = survey.views[depth_map.view]
        camera = camera_of(view, plan)
        rgb = job.photographs.load(view, scale=plan.image_scale)
        keep = keep[: camera.height, : camera.width]
        parallax = _parallax(block, depth_map)
        tolerance = AGREEMENT_PX / parallax
        if field is not None:
            from fields.slab.refine import refine

            height, taken = refine(field, camera, depth_map, rgb, survey.water, keep)
            depth_map, moved = replace(depth_map, height=height), moved + taken
        final, std = (depth_map, None) if solved is None else solved[number].over(depth_map)
        points = points_of(camera, survey.water, final, keep, rgb, tolerance, std)
        # Heights that agree by chance to the last bit lie anywhere in a hundredth of a pixel of parallax.
        points = replace(points, std=np.maximum(points.std, np.float32(LEAST_STD_PX / parallax)))
        if area is not None:
            points = points[within(points.xyz, grown(area, AREA_MARGIN_M))]
        parts.append(points)
        sources.append(np.full(len(points), number, dtype=np.int32))
        tides.append(camera.tide)
        advance(1.0)
    bed, accompanied = BedPoints.gathered(parts, lambda xyz: has_company(xyz, plan.gsd_m))
    return bed, np.array(tides)[np.concatenate(sources)[accompanied]], moved


def _parallax(block: Block, depth_map: DepthMap) -> float:
    """Of the bed of a map in the views that confirm its heights [px/m]."""
    return block.parallax(depth_map.view, block.neighbours(depth_map.view, PEERS), median(depth_map.height))
