"""The photographs of a survey as a block of `fields`, at the scale of its plan."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fields.device import Device, choose_device
from fields.image_store import GreyImages
from fields.sweep.block import Block
from refract import PinholeCamera
from survey.errors import SurveyError
from survey.photos.images import ImageStore, load_mask
from survey.photos.texture import saturated
from survey.plan.area import AREA_MARGIN_M, grown, local_area
from survey.plan.heights import dry_ground

if TYPE_CHECKING:
    from survey.folder.survey import Survey, View
    from survey.plan.plan import Plan


def load_block(
    survey: Survey,
    plan: Plan,
    advance: Callable[[float], None],
    store: ImageStore | None = None,
    store_array: Callable[[np.ndarray], Any] | None = None,
) -> Block:
    """Grey images and cameras at the plan's scale, as a block for `fields`; ``store_array`` is that of `GreyImages`.

    Images come through the store, where there is one, so that later stages need not decode them again. Those of several
    sizes are padded to the largest; padding, masked and saturated pixels are NaN, which matches nothing.
    """
    cameras = cameras_of_block(survey, plan)
    width, height = cameras[0].width, cameras[0].height
    kept, whites = ImageStore(0) if store is None else store, list[float]()

    def images() -> Iterator[np.ndarray]:
        for view in survey.views:
            grey, white = grey_image(view, plan.image_scale, (width, height), kept)
            whites.append(white)
            yield grey
            advance(1.0)

    bed = 0.0 if survey.water is not None else dry_ground(survey).height
    try:
        area = local_area(survey)
        ground = None if area is None else grown(area, AREA_MARGIN_M)
        greys = GreyImages(images(), store_array)
        return Block(backend(plan), cameras, greys, survey.water, bed, tuple(whites), plan.skips, ground)
    except ValueError as error:
        raise SurveyError(str(error)) from error


def grey_image(view: View, scale: float, size: tuple[int, int], store: ImageStore) -> tuple[np.ndarray, float]:
    """Grey levels (height, width) float32 about zero of a photograph, padded to a size, and the share that is white.

    Padding, masked and saturated pixels are NaN.
    """
    grey = store.grey(view, scale=scale)
    white = saturated(grey)
    grey = np.where(white, np.float32(np.nan), grey - np.float32(128.0))
    mask = load_mask(view, scale=scale)
    if mask is not None:
        grey[~mask] = np.nan
    rows, columns = size[1] - grey.shape[0], size[0] - grey.shape[1]
    padded = np.pad(grey, ((0, rows), (0, columns)), constant_values=np.nan) if rows or columns else grey
    return padded, float(white.mean())


def cameras_of_block(survey: Survey, plan: Plan) -> list[PinholeCamera]:
    """Cameras at the plan's scale, with images of the size of the largest."""
    cameras = [camera_of(view, plan) for view in survey.views]
    width, height = max(c.width for c in cameras), max(c.height for c in cameras)
    return [replace(c, width=width, height=height) for c in cameras]


def backend(plan: Plan) -> Device:
    """The device that the plan chose."""
    return choose_device({"llvm": "cpu"}.get(plan.device, plan.device))


def camera_of(view: View, plan: Plan) -> PinholeCamera:
    """The camera of a view at the plan's scale."""
    return view.camera if plan.image_scale == 1.0 else view.camera.scaled(plan.image_scale)
