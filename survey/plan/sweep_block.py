"""The photographs of a survey as a block of `fields`, at the scale of its plan."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fields.device import Device, choose_device
from fields.image_store import GreyImages
from fields.sweep.block import Block
from refract import PinholeCamera
from survey import machine
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.photos.images import ImageStore, load_mask
from survey.photos.texture import saturated_pixels
from survey.plan.area import AREA_MARGIN_M, grown, local_area
from survey.plan.heights import dry_ground
from survey.plan.plan import Plan

# Memory [bytes] for photographs that are decoded side by side, and what a pixel of each takes meanwhile.
_DECODING_BYTES, _BYTES_OF_PIXEL = 1.0e9, 16


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
        largest = max(view.camera.width * view.camera.height for view in survey.views)
        read = partial(grey_image, scale=plan.image_scale, size=(width, height), store=kept)
        for grey, white in _read_ahead(read, survey.views, int(_DECODING_BYTES / (_BYTES_OF_PIXEL * largest))):
            whites.append(white)
            yield grey
            advance(1.0)

    bed = 0.0 if survey.water is not None else dry_ground(survey).height
    try:
        area = local_area(survey)
        ground = None if area is None else grown(area, AREA_MARGIN_M)
        greys = GreyImages(images(), store_array)
        return Block(backend(plan), cameras, greys, survey.water, bed, tuple(whites), ground)
    except ValueError as error:
        raise SurveyError(str(error)) from error


def _read_ahead(
    read: Callable[[View], tuple[np.ndarray, float]], views: Iterable[View], most: int
) -> Iterator[tuple[np.ndarray, float]]:
    """Results of a function in the order of the views; at most ``most`` of them, and one a core, are under way."""
    at_once = max(min(most, machine.num_cores()), 1)
    with ThreadPoolExecutor(at_once) as pool:
        under_way = deque[Any]()
        for view in views:
            if len(under_way) == at_once:
                yield under_way.popleft().result()
            under_way.append(pool.submit(read, view))
        while under_way:
            yield under_way.popleft().result()


def grey_image(view: View, scale: float, size: tuple[int, int], store: ImageStore) -> tuple[np.ndarray, float]:
    """Grey levels (height, width) float32 about zero of a photograph, padded to a size, and the share that is white.

    Padding, masked and saturated pixels are NaN.
    """
    grey = store.grey(view, scale=scale)
    white = saturated_pixels(grey)
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
    return choose_device(device_word(plan))


def device_word(plan: Plan) -> str:
    """The word of `fields.device.choose_device` for it."""
    return {"llvm": "cpu"}.get(plan.device, plan.device)


def camera_of(view: View, plan: Plan) -> PinholeCamera:
    """The camera of a view at the plan's scale."""
    return view.camera if plan.image_scale == 1.0 else view.camera.scaled(plan.image_scale)
