"""The quality gate: ground that two views see and points that are known well enough, against counts by hand."""

from dataclasses import replace

import numpy as np
import pytest
from small_survey import small_survey

from fields.sweep.bed import BedPoints
from refract import FlatWater, PinholeCamera
from refract.distortion import BROWN, Distortion
from survey.folder.survey import Survey, load_survey
from survey.plan.choices import MAX_STD_GSD, STRICTEST_ORDER_M
from survey.report.seen_cells import CELL_GSD, cells_of
from survey.run.gate import verdict_of
from survey.run.stored import StoredBed
from survey.water.surface import Departure
from tests.changed_survey import changed

DOWN = np.diag([1.0, -1.0, -1.0])
GSD = 0.05
DEPTH_M, FLYING_M = 2.0, 10.0
# A camera that sees 10 m x 6 m of a level at its flying height, 200 px a side of 10 m.
SIZE, FOCAL = (200, 120), 200.0


@pytest.fixture
def survey(tmp_path):
    """Two nadir views 4 m apart along x over a bed 2 m under water of index 1; without bounds."""
    loaded = load_survey(small_survey(tmp_path / "s", num=3))
    cameras = [
        PinholeCamera(np.array([x, 0.0, FLYING_M - DEPTH_M]), DOWN, FOCAL, FOCAL, 100.0, 60.0, *SIZE)
        for x in (0.0, 4.0)
    ]
    views = tuple(replace(view, camera=camera) for view, camera in zip(loaded.views, cameras, strict=False))
    return changed(loaded, views=views, water=FlatWater((0.0, 0.0, 0.0), n_water=1.0), bounds=None)


def bed_over(x0: float, x1: float, *, std: float = 0.01) -> BedPoints:
    """Points 10 cm apart at 2 m depth, from x0 to x1 and over all of y that the views see."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(x0, x1, 0.1), np.arange(-3.5, 3.5, 0.1)))
    count = len(x)
    return BedPoints(
        xyz=np.stack([x, y, np.full(count, -DEPTH_M)], axis=-1),
        rgb=np.zeros((count, 3), dtype=np.uint8),
        std=np.full(count, std, dtype=np.float32),
        num_views=np.full(count, 2, dtype=np.uint8),
        depth=np.full(count, DEPTH_M, dtype=np.float32),
        incidence=np.zeros(count, dtype=np.float32),
        wet=np.ones(count, dtype=bool),
    )


def stored_bed(survey: Survey, bed: BedPoints, std_placed: np.ndarray | None = None) -> StoredBed:
    """A bed as its stage leaves it."""
    return StoredBed(bed, bed.xyz, survey.frame.crs, survey.name, GSD, std_placed=std_placed)


def test_cells_are_counted_by_the_views_that_see_them(survey):
    num_views = cells_of(survey, bed_over(-5.0, 9.0).xyz, GSD).num_views
    cell_m2 = (CELL_GSD * GSD) ** 2
    # Each sees 10 m x 6 m, and 6 m x 6 m together; a cell on an edge counts or not.
    for times, area in ((1, 2 * 4.0 * 6.0), (2, 6.0 * 6.0)):
        assert (num_views == times).sum() * cell_m2 == pytest.approx(area, rel=0.15)


def test_cells_are_seen_through_the_water_that_is_there(survey):
    bed, corners = bed_over(-5.0, 9.0).xyz, np.array([[-9.0, -9.0], [-9.0, 9.0], [9.0, -9.0], [9.0, 9.0]])
    bent = FlatWater((0.0, 0.0, 0.0), n_water=1.333)
    there = changed(survey, water=bent)
    higher = Departure(np.column_stack([corners, np.full(4, 1.5)]), np.full(4, 0.01))
    lower = changed(survey, water=replace(bent, point=(0.0, 0.0, -1.5)))
    departed = replace(lower, observations=replace(lower.observations, departure=higher))
    found = cells_of(departed, bed, GSD).num_views
    np.testing.assert_array_equal(found, cells_of(there, bed, GSD).num_views)
    assert (found != cells_of(lower, bed, GSD).num_views).any()


@pytest.mark.parametrize("k1", [-0.3, 0.3, -0.9], ids=["barrel", "pincushion", "folding"])
def test_no_cell_that_a_lens_bends_into_view_is_left_out(survey, k1):
    lens = Distortion(BROWN, (k1, 0.0, 0.002, -0.001, 0.0))
    views = tuple(replace(view, camera=replace(view.camera, distortion=lens)) for view in survey.views)
    bent, bed = replace(survey, views=views), bed_over(-5.0, 9.0).xyz
    cells, straight = cells_of(bent, bed, GSD), cells_of(survey, bed, GSD).num_views
    found, places = cells.num_views, cells.middles.reshape(-1, 3)
    seen = [view.camera.sees(view.camera.project(places, survey.water)) for view in views]
    np.testing.assert_array_equal(found.ravel(), np.sum(seen, axis=0))
    # A barrel shows more of the ground than a pinhole, a pincushion less.
    assert ((found >= 1).sum() > (straight >= 1).sum()) == (k1 < 0.0)


@pytest.mark.parametrize(("until", "passed"), [(9.0, True), (2.6, True), (1.4, False)])
def test_only_ground_that_two_views_see_is_asked_for(survey, until, passed):
    """Both see x from -1 to 5 m: half of it ends at 2 m; what one view sees does not count."""
    (ground, *_) = verdict_of(survey, stored_bed(survey, bed_over(-5.0, until)), GSD).gates
    assert ground.value == pytest.approx(100.0 * (min(until, 5.0) + 1.0) / 6.0, abs=9.0)
    assert ground.passed == passed
    assert "of the ground that two or more views see has a point of the bed" in ground.sentence


def test_ground_beyond_the_bounds_is_not_asked_for(survey):
    low, high = survey.frame.crs_from_local(np.array([[0.0, -2.0, 0.0], [2.0, 2.0, 0.0]]))
    bounded = changed(survey, bounds=(low[0], low[1], high[0], high[1]))
    (ground, *_) = verdict_of(bounded, stored_bed(bounded, bed_over(-0.5, 2.5)), GSD).gates
    assert ground.value == 100.0


@pytest.mark.parametrize(("share", "passed"), [(0.99, True), (1.01, False)])
def test_points_have_to_be_known_to_one_and_a_half_pixels(survey, share, passed):
    bed = bed_over(-5.0, 9.0, std=share * MAX_STD_GSD * GSD)
    verdict = verdict_of(survey, stored_bed(survey, bed), GSD)
    # Of points of this size a height may be known to a little more.
    assert [gate.passed for gate in verdict.gates] == [True, passed, True]
    assert verdict.passed == passed
    assert verdict.gates[1].sentence.endswith("at most 75.0\u00a0mm (1.5\u00a0ground sampling distances)")


def test_where_gps_has_put_the_block_is_not_held_against_the_photographs(survey):
    bed = bed_over(-5.0, 9.0, std=5.0 * MAX_STD_GSD * GSD)
    placed = np.sqrt(bed.std**2 - np.float32(0.5 * MAX_STD_GSD * GSD) ** 2)
    (_, precision, whole) = verdict_of(survey, stored_bed(survey, bed, placed), GSD).gates
    assert precision.passed
    assert not whole.passed
    assert precision.value == pytest.approx(500.0 * MAX_STD_GSD * GSD, rel=1e-3)


@pytest.mark.parametrize(("common", "passed"), [(0.02, True), (0.07, True), (0.09, False), (np.nan, True)])
def test_what_heights_share_counts(survey, common, passed):
    """A level read to some centimetres is no failure; one that is known to a decimetre is."""
    bed = bed_over(-5.0, 9.0)
    shared = np.full(len(bed), common, dtype=np.float32)
    verdict = verdict_of(survey, replace(stored_bed(survey, bed), std_common=shared), 0.01)
    gate = verdict.gates[2]
    assert (gate.passed, verdict.passed) == (passed, passed)
    assert gate.value == pytest.approx(1000.0 * np.hypot(0.01, np.nan_to_num(common)), rel=1e-3)
    assert ("the shared part limits it: give [water] level_std_m" in gate.sentence) == (not passed)
    assert gate.limit == pytest.approx(1000.0 * STRICTEST_ORDER_M)
