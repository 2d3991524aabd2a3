"""Reasons for cells without a point, from masks, white pixels and height maps that are made to hold each of them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from small_bed import plane_bed
from small_report import PLAN
from small_survey import SIZE

from fields.sweep.maps import HeightMap
from survey.report import seen_cells
from survey.report.gap_reasons import with_reasons
from survey.report.seen_cells import CONTRADICTED, GLINT, HIDDEN, MASKED, ONE_VIEW, PLAIN, UNLIKE, cells_of, coverage_of


def grey_images(survey, folder, levels: np.ndarray):
    """The survey with photographs of these grey levels."""
    views = [replace(view, path=folder / view.name) for view in survey.views]
    for view in views:
        cv2.imwrite(str(view.path.with_suffix(".png")), levels)
        view.path.with_suffix(".png").rename(view.path)
    return replace(survey, views=tuple(views))


@pytest.fixture
def hole(shallow_survey):
    """The cells of a bed with a hole of 3 m, which all views look at, and their survey."""
    bed = plane_bed(shallow_survey)
    return cells_of(shallow_survey, bed[np.linalg.norm(bed.xyz[:, :2], axis=1) > 1.5].xyz, PLAN.gsd_m)


def inner(cells) -> np.ndarray:
    return (np.linalg.norm(cells.middles[..., :2], axis=-1) < 1.2) & ~cells.has_point & (cells.num_views >= 2)


@pytest.mark.parametrize(
    ("score", "agreeing", "grey", "reason"),
    [
        (0.9, 0, "texture", CONTRADICTED),
        (0.9, 3, "texture", HIDDEN),
        (0.3, 0, "texture", UNLIKE),
        (0.3, 0, "plain", PLAIN),
        (-1.0, 0, "white", GLINT),
    ],
)
def test_a_height_map_tells_the_reason(shallow_survey, hole, tmp_path, score, agreeing, grey, reason):
    levels = {"plain": np.full(SIZE[::-1], 120), "white": np.full(SIZE[::-1], 255)}
    noise = np.random.default_rng(0).integers(0, 200, SIZE[::-1])
    survey = grey_images(shallow_survey, tmp_path, levels.get(grey, noise).astype(np.uint8))
    shape = SIZE[::-1]
    maps = [
        HeightMap(view, np.zeros(shape, np.float32), np.full(shape, score, np.float16),
                  np.full(shape, agreeing, np.uint8), np.zeros(shape, np.float16))
        for view in range(len(survey.views))
    ]  # fmt: skip
    looked_at: list[int] = []
    told = with_reasons(hole, survey, PLAN, maps, lambda: looked_at.append(1)).gaps
    assert len(looked_at) == len(survey.views)
    assert inner(hole).sum() > 10
    assert (told[inner(hole)] == reason).all()
    assert (told[hole.has_point] == 0).all()
    assert (told == ONE_VIEW).sum() == (hole.gaps == ONE_VIEW).sum()


def test_masks_that_leave_less_than_two_views_are_the_reason(shallow_survey, hole, tmp_path):
    cv2.imwrite(str(tmp_path / "mask.png"), np.zeros(SIZE[::-1], np.uint8))
    masked = [replace(view, mask_path=tmp_path / "mask.png") for view in shallow_survey.views[1:]]
    told = with_reasons(hole, replace(shallow_survey, views=(shallow_survey.views[0], *masked)), PLAN, [])
    assert (told.gaps[inner(hole)] == MASKED).all()
    areas = coverage_of(told, None, None)
    assert areas["reasons_m2"][seen_cells.REASONS[MASKED]] == pytest.approx(
        hole.grid.side_m**2 * (told.gaps == MASKED).sum()
    )
    assert sum(areas["reasons_m2"].values()) + areas["found_m2"] == pytest.approx(areas["ground_m2"])


@pytest.mark.parametrize(("missing_below", "deep"), [(True, True), (False, False)])
def test_what_matches_nothing_is_too_deep_only_where_it_lies_below_what_is_found(
    shallow_survey, tmp_path, missing_below, deep
):
    """The bed falls to the west; cells are missing in the deepest metre, or in one amid shallower and deeper bed."""
    survey = grey_images(shallow_survey, tmp_path, np.full(SIZE[::-1], 120, np.uint8))
    bed = plane_bed(survey)
    low, high = (-9.0, -4.0) if missing_below else (-2.5, -0.5)
    cells = cells_of(survey, bed[(bed.xyz[:, 0] < low) | (bed.xyz[:, 0] > high)].xyz, PLAN.gsd_m)
    shape = SIZE[::-1]
    maps = [
        HeightMap(view, *(np.zeros(shape, kind) for kind in (np.float32, np.float16, np.uint8, np.float16)))
        for view in range(len(survey.views))
    ]
    told = with_reasons(cells, survey, PLAN, maps).gaps
    x = cells.middles[..., 0]
    strip = (x > low + 0.1) & (x < high - 0.1) & ~cells.has_point & (cells.num_views >= 2)
    assert strip.sum() > 5
    assert ((told[strip] == seen_cells.DEEP).mean() > 0.5) == deep
