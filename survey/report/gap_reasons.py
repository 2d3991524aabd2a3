"""Why cells of the ground have no point: what the masks and the height maps of the sweep hold where views show a cell.

A cell is where its nearest bed is in height, so that its pixels are those of its surroundings at worst. A view that
shows it masked does not count. In a height map the square of pixels about its middle, as wide as the cell, was left out
(white, or out of sight of all partners), was unlike the other views, matched, or was confirmed by them; the last is bed
in front of the cell. What most of the views say is the reason.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np

from fields.sweep.maps import HeightMap, trusted, views_of
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.photos.images import grey_levels, load_mask, load_pixels
from survey.photos.texture import PLAIN_STD, saturated_pixels
from survey.plan.plan import Plan
from survey.plan.sweep_block import camera_of
from survey.report.seen_cells import (
    CONTRADICTED,
    DEEP,
    GLINT,
    HIDDEN,
    MASKED,
    NO_PAIR,
    PLAIN,
    UNLIKE,
    SeenCells,
    around,
)
from survey.water.surface import height_above, plane_under

# Windows without anything in common score higher in one pixel of forty (`fields.sweep.matching.DiscontinuitySearch`).
_MATCHED = 0.68
_LEFT_OUT = -0.99
# In the order in which the first of those that most views say counts.
_SAID = (CONTRADICTED, HIDDEN, UNLIKE, PLAIN, GLINT, NO_PAIR)


def with_reasons(
    cells: SeenCells,
    survey: Survey,
    plan: Plan,
    maps: Sequence[HeightMap],
    advance: Callable[[], object] = lambda: None,
) -> SeenCells:
    """Cells with the reasons for which those that two or more views look at have no point; maps are of the sweep.

    ``advance`` is called for each view.
    """
    codes = cells.gaps.copy()
    at = np.nonzero(~cells.has_point & (cells.num_views >= 2))
    places, num_open = cells.middles[at], cells.num_views[at].copy()
    said, numbers = np.zeros((len(_SAID), len(places)), dtype=int), {view: n for n, view in enumerate(views_of(maps))}
    side = 2 * max(round(0.5 * cells.grid.side_m / plan.gsd_m), 1) + 1
    middles, number = cells.middles, np.full(codes.shape, -1)
    number[at] = np.arange(len(places))
    for index, view in enumerate(survey.views):
        advance()
        camera = camera_of(view, plan)
        near = number[around(camera, middles[0, :, 0], middles[:, 0, 1], cells.height)]
        near = near[near >= 0]
        water = plane_under(survey.water, survey.observations.departure, camera.centre)
        pixel = camera.project(places[near], water)
        is_seen = camera.sees(pixel)
        seen, pixel = near[is_seen], pixel[is_seen]
        if not len(seen):
            continue
        column, row = np.floor(pixel).astype(int).T
        if (mask := load_mask(view, scale=plan.image_scale)) is not None:
            is_open = mask[row, column]
            num_open[seen[~is_open]] -= 1
            seen, row, column = seen[is_open], row[is_open], column[is_open]
        if index in numbers and len(seen):
            found = _said_by(maps[numbers[index]], view, plan, side, (row, column))
            said[[_SAID.index(code) for code in found], seen] += 1
    most = np.array(_SAID, dtype=np.uint8)[said.argmax(axis=0)]
    most[said.sum(axis=0) == 0] = NO_PAIR
    most[num_open < 2] = MASKED
    codes[at] = most
    return replace(cells, reasons=_deep_told(replace(cells, reasons=codes), survey))


def _said_by(m: HeightMap, view: View, plan: Plan, side: int, pixels: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """What a height map says of cells at pixels (K,), (K,): codes (K,) of `_SAID`."""

    def mostly(which: np.ndarray) -> np.ndarray:
        return cv2.blur(which.astype(np.float32), (side, side))[pixels] > 0.5

    left_out = mostly(m.score <= _LEFT_OUT)
    said = [NO_PAIR, HIDDEN, CONTRADICTED]
    found = np.select([left_out, mostly(trusted(m)), mostly(m.score > _MATCHED)], said, UNLIKE)
    if np.isin(found, (NO_PAIR, UNLIKE)).any():
        grey = grey_levels(load_pixels(view, scale=plan.image_scale))
        mean, square, white = (
            cv2.blur(each, (side, side))[pixels]
            for each in (grey, grey.astype(np.float64) ** 2, saturated_pixels(grey).astype(np.float32))
        )
        found[left_out & (white > 0.0)] = GLINT
        found[(found == UNLIKE) & (square - mean.astype(np.float64) ** 2 < PLAIN_STD**2)] = PLAIN
    return found


def _deep_told(cells: SeenCells, survey: Survey) -> np.ndarray:
    """Codes in which cells that match nothing are too deep beyond the depth that best parts them from the bed found.

    Less than half of the bed is found below that depth, and more than half above it; else no cell is too deep. Cells
    with other reasons do not count: they say nothing about light.
    """
    codes = cells.gaps.copy()
    unmatched = np.isin(codes, (UNLIKE, PLAIN))
    if survey.water is None:
        return codes
    middles = cells.middles
    depth = -height_above(survey.water, survey.observations.departure, middles.reshape(-1, 3)).reshape(codes.shape)
    counted = (depth > 0.0) & (cells.has_point & (cells.num_views >= 2) | unmatched)
    order = np.argsort(-depth[counted], kind="stable")
    found = np.cumsum(cells.has_point[counted][order])
    if not len(order) or found[-1] == len(order):
        return codes
    number = np.arange(1, len(order) + 1)
    last = int(np.argmax(number - 2 * found))  # missing cells below, and found ones above, less those that are not
    above, below = found[-1] - found[last], found[last]
    if 2 * below < last + 1 and 2 * above > len(order) - last - 1:
        codes[unmatched & (depth >= depth[counted][order][last])] = DEEP
    return codes
