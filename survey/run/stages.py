"""What the stages of a run compute: the survey's side of `fields`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from fields.device import Device, choose_device
from fields.slab.refine import refine
from fields.slab.tensor_field import FieldSettings, TensorField
from fields.slab.train import Schedule, Sources, slab_of, train
from fields.sweep.bed import BedPoints, has_company, points_of, trusted, unique_pixels
from fields.sweep.block import Block
from fields.sweep.ranging import find_range
from fields.sweep.sweep import DepthMap, sweep
from refract import PinholeCamera
from survey.errors import SurveyError
from survey.folder.survey import Survey, View
from survey.photos.images import load_image, load_mask
from survey.plan.plan import Plan, ground_height

# How often every place is to be seen by views with a height map of their own: by steep ones, and by oblique ones from
# each quarter. Three confirm each other; docs/sweep.md has what more bring.
TIMES_SEEN = {"draft": (4, 1), "standard": (6, 2), "fine": (1000, 1000)}
# Rays that the field learns from, per cell of one GSD (docs/field.md has the figures behind it).
RAYS_PER_CELL = 15.0
# The cloud ends this far beyond the bounds that the survey asks for.
AREA_MARGIN_M = 0.5
# Gates of the command line: exit code 3 below, or above.
MIN_WET_SHARE = 0.5
MAX_STD_GSD = 5.0
# No bed is looked for higher over the water than this share of the flying height, nor deeper than that one: drones fly
# 8 m over 10 m of clear water, and beside banks that nearly reach them.
HIGHEST, DEEPEST = 0.8, 1.5


def load_block(survey: Survey, plan: Plan, advance: Callable[[float], None]) -> Block:
    """Grey images and cameras at the plan's scale, as a block for `fields`.

    Images of several sizes are padded to the largest; padding and masked pixels are NaN, which matches nothing.
    """
    cameras = [camera_of(view, plan) for view in survey.views]
    width, height = max(c.width for c in cameras), max(c.height for c in cameras)
    images = []
    for view in survey.views:
        rgb = load_image(view, scale=plan.image_scale)
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) - 128.0
        mask = load_mask(view, scale=plan.image_scale)
        if mask is not None:
            grey[~mask] = np.nan
        rows, columns = height - grey.shape[0], width - grey.shape[1]
        images.append(np.pad(grey, ((0, rows), (0, columns)), constant_values=np.nan))
        advance(1.0)
    cameras = [replace(c, width=width, height=height) for c in cameras]
    bed = 0.0 if survey.water is not None else ground_height(survey)
    try:
        return Block(backend(plan), cameras, images, survey.water, bed)
    except ValueError as error:
        raise SurveyError(str(error)) from error


def backend(plan: Plan) -> Device:
    """The device that the plan chose."""
    return choose_device({"llvm": "cpu"}.get(plan.device, plan.device))


def camera_of(view: View, plan: Plan) -> PinholeCamera:
    """The camera of a view at the plan's scale."""
    return view.camera if plan.image_scale == 1.0 else view.camera.scaled(plan.image_scale)


def plane_name(survey: Survey) -> str:
    """What heights count from, in words."""
    return "water" if survey.water is not None else "local origin"


def limits(survey: Survey) -> tuple[float, float]:
    """Heights [m] over the water plane (over local z = 0) beyond which no bed is looked for."""
    if survey.water is None:
        top = float(np.median([v.camera.centre[2] for v in survey.views]))
        # The flying height over dry ground is only guessed from the overlap; look from a third of it to three times.
        flying = top - ground_height(survey)
        return top - 3.0 * flying, top - flying / 3.0
    flying = float(np.median([-survey.water.depth(v.camera.centre) for v in survey.views]))
    return -DEEPEST * flying, HIGHEST * flying


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


def local_area(survey: Survey) -> tuple[float, float, float, float] | None:
    """The bounds of the survey as (x0, y0, x1, y1) [m], local, that hold them; None where it has none."""
    if survey.bounds is None:
        return None
    e0, n0, e1, n1 = survey.bounds
    level = survey.frame.origin[2]
    corners = survey.frame.local_from_crs([[e0, n0, level], [e1, n0, level], [e1, n1, level], [e0, n1, level]])
    return (*corners[:, :2].min(axis=0), *corners[:, :2].max(axis=0))


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


def grown(area: tuple[float, float, float, float], margin: float) -> tuple[float, float, float, float]:
    """An area (x0, y0, x1, y1) [m] with a margin [m] on every side."""
    return (area[0] - margin, area[1] - margin, area[2] + margin, area[3] + margin)


def within(xyz: np.ndarray, area: tuple[float, float, float, float]) -> np.ndarray:
    """Which points (N, 3) stand over an area (x0, y0, x1, y1), (N,) bool."""
    return (xyz[:, 0] >= area[0]) & (xyz[:, 1] >= area[1]) & (xyz[:, 0] <= area[2]) & (xyz[:, 1] <= area[3])


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
