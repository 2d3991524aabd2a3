"""Points of the bed from height maps, without duplicates, with their random standard deviation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fields.solver.solver import SolvedMap
from fields.sweep.bed import BedPoints, has_neighbours, is_supported, points_of, std_of_kept, with_slope_std
from fields.sweep.block import AGREEMENT_PX
from fields.sweep.fusion import PEERS, num_comparable
from fields.sweep.images import median
from fields.sweep.maps import HeightMap, trusted
from survey.adjust.result.adjustment import Adjustment, read_adjustment
from survey.adjust.result.std_common import std_of_block
from survey.plan.area import within
from survey.plan.sweep_block import camera_of

if TYPE_CHECKING:
    from survey.folder.survey import Survey
    from survey.run.job import Job

LEAST_STD_PX = 0.01


def adjustment_of(needs: Mapping[str, Path]) -> Adjustment | None:
    """Adjustment of the run, if it has one."""
    return read_adjustment(needs["adjust"]) if "adjust" in needs else None


def is_placed(survey: Survey) -> bool:
    """Whether GPS or control alone determines the datum of the block, whose std no processing reduces."""
    return survey.config.cameras.poses is None


def with_std_of_block(
    bed: BedPoints,
    survey: Survey,
    found: Adjustment | None,
    gsd_m: float,
    new_column: Callable[[int], np.ndarray],
) -> tuple[BedPoints, np.ndarray | None]:
    """Points whose std includes tilt and bending of the block, and that part (N,) [m]; None without an adjustment."""
    if found is None:
        return bed, None
    of_block = std_of_block(bed.xyz, survey, found, gsd_m, new_column(len(bed)))
    return replace(bed, std=np.hypot(bed.std, of_block, out=new_column(len(bed)))), of_block


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
