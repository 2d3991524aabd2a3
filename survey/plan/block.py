"""The photographs of a survey as a block of `fields`, at the plan's scale, with the limits of the search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from fields.device import Device, choose_device
from fields.sweep.block import Block
from refract import PinholeCamera
from survey.errors import SurveyError
from survey.photos.images import load_image, load_mask
from survey.plan.ground import ground_height
from survey.plan.heights import height_range

if TYPE_CHECKING:
    from survey.folder.survey import Survey, View
    from survey.photos.store import ImageStore
    from survey.plan.plan import Plan

# The cloud extends this far beyond the bounds in survey.toml.
AREA_MARGIN_M = 0.5


def load_block(survey: Survey, plan: Plan, advance: Callable[[float], None], store: ImageStore | None = None) -> Block:
    """Grey images and cameras at the plan's scale, as a block for `fields`.

    Images come through the store, where there is one, so that later stages need not decode them again.
    Images of several sizes are padded to the largest; padding and masked pixels are NaN, which matches nothing.
    """
    cameras = [camera_of(view, plan) for view in survey.views]
    width, height = max(c.width for c in cameras), max(c.height for c in cameras)
    images = []
    load = load_image if store is None else store.load
    for view in survey.views:
        rgb = load(view, scale=plan.image_scale)
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) - 128.0
        mask = load_mask(view, scale=plan.image_scale)
        if mask is not None:
            grey[~mask] = np.nan
        rows, columns = height - grey.shape[0], width - grey.shape[1]
        images.append(np.pad(grey, ((0, rows), (0, columns)), constant_values=np.nan))
        advance(1.0)
    cameras = [replace(c, width=width, height=height) for c in cameras]
    bed = 0.0 if survey.water is not None else ground_height([view.camera for view in survey.views])
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
    """The reference of heights, in words."""
    return "water" if survey.water is not None else "local origin"


def limits(survey: Survey) -> tuple[float, float]:
    """Heights [m] over the water plane (dry: over local z = 0) between which the bed is searched."""
    if survey.water is None:
        cameras = [view.camera for view in survey.views]
        flying = float(np.median([camera.centre[2] for camera in cameras])) - ground_height(cameras)
    else:
        flying = float(np.median([-survey.water.depth(v.camera.centre) for v in survey.views]))
    found = height_range(survey, flying)
    return found.low, found.high


def local_area(survey: Survey) -> tuple[float, float, float, float] | None:
    """The bounds of the survey as (x0, y0, x1, y1) [m], local, that hold them; None where it has none."""
    if survey.bounds is None:
        return None
    e0, n0, e1, n1 = survey.bounds
    level = survey.frame.origin[2]
    corners = survey.frame.local_from_crs([[e0, n0, level], [e1, n0, level], [e1, n1, level], [e0, n1, level]])
    return (*corners[:, :2].min(axis=0), *corners[:, :2].max(axis=0))


def grown(area: tuple[float, float, float, float], margin: float) -> tuple[float, float, float, float]:
    """An area (x0, y0, x1, y1) [m] with a margin [m] on every side."""
    return (area[0] - margin, area[1] - margin, area[2] + margin, area[3] + margin)


def within(xyz: np.ndarray, area: tuple[float, float, float, float]) -> np.ndarray:
    """Which points (N, 3) lie within an area (x0, y0, x1, y1), (N,) bool."""
    return (xyz[:, 0] >= area[0]) & (xyz[:, 1] >= area[1]) & (xyz[:, 0] <= area[2]) & (xyz[:, 1] <= area[3])
