"""What the stages of a run compute: the survey's side of `fields`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from scipy.ndimage import distance_transform_edt

from fields.slab.refine import refine
from fields.slab.tensor_field import FieldSettings, TensorField
from fields.slab.train import Schedule, Sources, slab_of, train
from fields.sweep.bed import BedPoints, has_company, points_of, trusted, unique_pixels
from fields.sweep.block import Block
from fields.sweep.ranging import find_range
from fields.sweep.sweep import DepthMap, sweep
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.photos.images import load_image
from survey.plan.block import AREA_MARGIN_M, TIMES_SEEN, backend, camera_of, grown, limits, local_area, within
from survey.plan.plan import Plan

# Rays that the field learns from, per cell of one GSD (docs/field.md has the figures behind it).
RAYS_PER_CELL = 15.0
# Gates of the command line: exit code 3 below, or above.
MIN_WET_SHARE = 0.5
MAX_STD_GSD = 5.0


def sweep_block(block: Block, survey: Survey, plan: Plan, stage) -> tuple[tuple[float, float], list[DepthMap]]:
    """The bound of the bed and a height map of each view that is needed to cover it.

    Raises
    ------
    SurveyError
        If the images do not match.
    """
    try:
        bound = find_range(block, limits(survey))
    except ValueError as error:
        raise SurveyError(str(error)) from error
    block.look_at(0.5 * (bound[0] + bound[1]))
    chosen = block.cover(*TIMES_SEEN[plan.quality], local_area(survey))
    maps = sweep(block, chosen, bound, shares(stage))
    if not maps:
        raise SurveyError("no two views overlap; check that the poses belong to the images")
    return bound, maps


def sources_of(survey: Survey, plan: Plan, maps: list[DepthMap]) -> Sources:
    """The photographs that have a height map, with their water."""
    given = survey.config.water
    return Sources(
        [camera_of(survey.views[m.view], plan) for m in maps],
        maps,
        [load_image(survey.views[m.view], scale=plan.image_scale) for m in maps],
        survey.water,
        None if given is None else given.absorption_per_m,
        None if given is None else given.veiling_light,
    )


def train_field(survey: Survey, plan: Plan, maps: list[DepthMap], stage) -> tuple[TensorField, dict]:
    """The field inside the bound of the sweep, and the figures of its training."""
    sources = sources_of(survey, plan, maps)
    area = local_area(survey)
    if area is not None:
        area = grown(area, AREA_MARGIN_M)
    slab = slab_of(sources, plan.gsd_m, area)
    schedule = Schedule(RAYS_PER_CELL)
    return train(sources, slab, FieldSettings(), schedule, backend(plan), shares(stage))


def shares(stage) -> Callable[[float], None]:
    """A progress function that takes the share done and advances a stage whose total is 1."""
    done = 0.0

    def report(share: float) -> None:
        nonlocal done
        stage.advance(share - done)
        done = share

    return report


def bed_points(
    block: Block,
    survey: Survey,
    plan: Plan,
    maps: list[DepthMap],
    field: TensorField | None,
    advance: Callable[[float], None],
) -> tuple[BedPoints, int]:
    """Every piece of the bed once, coloured from the photograph that shows it steepest.

    Returns the points and how many of them took their height from the field.
    """
    parts, moved = [], 0
    for depth_map, keep in zip(maps, unique_pixels(block, maps), strict=True):
        view = survey.views[depth_map.view]
        camera = camera_of(view, plan)
        rgb = load_image(view, scale=plan.image_scale)
        keep = keep[: camera.height, : camera.width]
        if field is not None:
            height, taken = refine(field, camera, depth_map, rgb, survey.water, keep)
            depth_map, moved = replace(depth_map, height=height), moved + taken
        parts.append(points_of(camera, survey.water, depth_map, keep, rgb))
        advance(1.0)
    bed = BedPoints.concatenate(parts)
    area = local_area(survey)
    if area is not None:
        bed = bed[within(bed.xyz, grown(area, AREA_MARGIN_M))]
    return bed[has_company(bed.xyz, plan.gsd_m)], moved


def share_of_wet_pixels(maps: list[DepthMap], survey: Survey) -> float | None:
    """Share of the pixels that look into water that have a trusted height; None where none does.

    A pixel without a trusted height looks into water where the nearest pixel that has one does. Every fourth pixel of
    every fourth row is asked.
    """
    if survey.water is None:
        return None
    count = found = 0
    for depth_map in maps:
        has = trusted(depth_map)[::4, ::4]
        if not has.any():
            continue
        nearest = distance_transform_edt(~has, return_distances=False, return_indices=True)
        wet = depth_map.height[::4, ::4][tuple(nearest)] < 0.0
        count += int(wet.sum())
        found += int((wet & has).sum())
    return found / count if count else None
