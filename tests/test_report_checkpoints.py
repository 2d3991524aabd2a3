"""The cloud of a run at check points, and what it states of its heights: figures that are known, and as shown."""

import math
from dataclasses import replace

import numpy as np
import pytest
from small_bed import plane_bed
from small_report import facts_of
from small_survey import small_survey

from survey.control.points import Checkpoint, Control, ControlPoint, Mark
from survey.folder.survey import load_survey
from survey.report.checkpoints import (
    CE95,
    LE95,
    WITHIN_GSD,
    checkpoint_differences,
    checkpoint_warnings,
    checkpoints_of,
    stated_of,
    table,
)
from survey.report.figures import figures_of
from survey.report.page import cards
from survey.report.tables import checkpoints as checkpoint_blocks
from survey.water.surface import still_water
from tests.changed_survey import changed

GSD_M = 0.05
# The plane is fitted in float64 to points in float32, some metres from the origin.
ROUNDING_M = 1e-5


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    return load_survey(small_survey(tmp_path_factory.mktemp("survey") / "s"))


def check(survey, name: str, place) -> Checkpoint:
    e, n, h = survey.frame.crs_from_local(np.array(place)).tolist()
    return Checkpoint(name, (e, n, h), np.array(place, dtype=np.float64))


def test_a_sloped_plane_is_as_high_between_its_points_as_at_them(rng):
    points = rng.uniform(-2.0, 2.0, (4000, 3))
    points[:, 2] = 1.0 + 0.3 * points[:, 0] - 0.1 * points[:, 1]
    places = np.array([[0.013, 0.2, 1.0], [1.0, -1.0, 1.4], [5.0, 0.0, 1.0]])
    found = checkpoint_differences(points, places, GSD_M)
    assert found[:2] == pytest.approx([0.3 * 0.013 - 0.02, 0.0], abs=1e-9)
    assert math.isnan(found[2])
    assert math.isnan(checkpoint_differences(points[:3], places[:1], GSD_M)[0])
    assert math.isnan(checkpoint_differences(np.zeros((0, 3)), places[:1], GSD_M)[0])


def test_points_further_than_some_sampling_distances_do_not_count():
    ring = np.array([[math.cos(a), math.sin(a), 2.0] for a in np.linspace(0.0, 6.0, 12)]) * [0.24, 0.24, 1.0]
    place = np.zeros((1, 3))
    assert checkpoint_differences(ring, place, 0.05)[0] == pytest.approx(2.0)
    assert math.isnan(checkpoint_differences(ring, place, 0.24 / WITHIN_GSD * 0.99)[0])


def test_all_check_points_are_in_the_figures_those_under_water_and_above_apart(survey):
    bed = plane_bed(survey)
    inner = bed.xyz[np.abs(bed.xyz[:, :2]).max(axis=1) < 6.5].astype(np.float64)
    below, above = inner[np.argmin(inner[:, 2])], inner[np.argmax(inner[:, 2])]
    marked = ControlPoint(
        "target", (0.0, 0.0, 0.0), above + np.array([0.0, 0.0, 0.01]), np.full(3, 0.01), is_check=True
    )
    control = Control(
        (marked, replace(marked, name="used", is_check=False)), (Mark("target", "0000.jpg", (1, 1)),), 0.5
    )
    rods = (check(survey, "rod", below + np.array([0.0, 0.0, 0.02])), check(survey, "far", [90.0, 0.0, 0.0]))
    found = checkpoints_of(changed(survey, checkpoints=rods, control=control), bed.xyz, GSD_M)
    rod, far, target = found.rows
    assert [row.name for row in found.rows] == ["rod", "far", "target"]
    assert rod.difference_m == pytest.approx(-0.02, abs=ROUNDING_M)
    assert rod.depth_m == pytest.approx(float(survey.water.depth(below)) - 0.02, abs=1e-6)
    assert (far.difference_m, target.depth_m > 0.0) == (None, False)
    everything, wet, dry = found.groups
    assert (everything.name, everything.num, wet.num, dry.num) == ("all", 2, 1, 1)
    assert everything.mean_m == pytest.approx(-0.015, abs=ROUNDING_M)
    assert everything.rms_m == pytest.approx(math.sqrt(0.5 * (0.02**2 + 0.01**2)), abs=ROUNDING_M)
    # 90 % of a normal distribution lie within 1.96 standard deviations.
    assert everything.le95_m == pytest.approx(1.9599640 * everything.rms_m)
    assert everything.largest_m == pytest.approx(-0.02, abs=ROUNDING_M)
    text, groups, each = checkpoint_blocks(found)
    assert "1 of 3 have no value" in text.text
    assert groups.rows[0][:2] == ("all", "2")
    assert each.rows[0][3] == "−20.0"
    assert each.rows[1][3] == "unknown"


def test_the_uncertainty_of_a_check_point_itself_explains_its_difference(survey):
    bed = plane_bed(survey)
    at = bed.xyz[len(bed.xyz) // 2 + 70] + np.array([0.0, 0.0, 0.3])
    known = replace(check(survey, "photon 1", at), std=np.array([7.0, 7.0, 0.15]))
    for point, num in ((check(survey, "rod", at), 1), (known, 0)):
        found = checkpoints_of(changed(survey, checkpoints=(point,)), bed.xyz, GSD_M, bed.std)
        assert found.rows[0].difference_m == pytest.approx(-0.3, abs=ROUNDING_M)
        assert len(checkpoint_warnings(found)) == num
    # Of a hundred one lies beyond three standard deviations by chance, and none beyond four.
    row = found.rows[0]
    for sigmas, num in ((3.5, 0), (4.5, 1)):
        one = replace(row, difference_m=sigmas * float(np.hypot(row.stated_m, row.std_m)))
        many = replace(found, rows=(one, *99 * [replace(row, difference_m=0.0)]))
        assert len(checkpoint_warnings(many)) == num
    *_, each = checkpoint_blocks(found)
    assert (each.rows[0][5], found.groups[0].own_m) == ("150", pytest.approx(0.15))
    both = checkpoints_of(changed(survey, checkpoints=(check(survey, "rod", at), known)), bed.xyz, GSD_M).groups[0]
    assert (both.num, both.num_own, both.own_m) == (2, 1, pytest.approx(0.15))


def test_without_check_points_there_are_no_figures_and_without_a_cloud_no_groups(survey):
    assert checkpoints_of(survey, plane_bed(survey).xyz, GSD_M) is None
    assert checkpoint_blocks(None) == []
    alone = checkpoints_of(changed(survey, checkpoints=(check(survey, "rod", [0, 0, 0]),)), np.zeros((0, 3)), GSD_M)
    assert (alone.groups, alone.rows[0].difference_m) == ((), None)
    assert len(checkpoint_blocks(alone)) == 2


def test_depths_kilometres_away_count_from_water_that_follows_the_earth(survey):
    reached = np.array([[0.0, 0.0, 80.0], [5000.0, 0.0, 80.0]])
    departure = still_water(survey.frame, survey.water, reached)
    far = replace(survey, observations=replace(survey.observations, departure=departure))
    e, n, _ = survey.frame.crs_from_local(np.array([5000.0, 0.0, -2.0])).tolist()
    # The water of the small survey stands at 2105 m.
    place = survey.frame.local_from_crs(np.array([e, n, 2104.0]))
    point = Checkpoint("far", (e, n, 2104.0), place)
    far = replace(far, observations=replace(far.observations, checkpoints=(point,)))
    (row,) = checkpoints_of(far, plane_bed(survey).xyz, GSD_M).rows
    assert row.depth_m == pytest.approx(1.0, abs=1e-3)


def test_le95_and_ce95_hold_95_percent_of_normal_errors(rng):
    errors = rng.standard_normal((200_000, 2))
    # One share of 200 000 has a standard deviation of 0.0007.
    assert (np.abs(errors[:, 0]) < LE95).mean() == pytest.approx(0.95, abs=0.003)
    assert (np.hypot(*errors.T) < CE95).mean() == pytest.approx(0.95, abs=0.003)


def test_orders_are_those_of_the_stated_uncertainty_at_95_percent():
    depth = np.full(100, 2.0)
    # At 2 m the orders allow 0.1508, 0.2504, 0.5007 and 1.0011 m, which is 1.96 standard deviations.
    std = np.r_[np.full(90, 0.15 / 1.96), np.full(6, 0.25 / 1.96), np.full(4, 3.0)]
    found = stated_of(std, depth)
    assert [(order.name, order.share_within) for order in found.orders] == [
        ("Exclusive", pytest.approx(0.90)),
        ("Special", pytest.approx(0.96)),
        ("1a and 1b", pytest.approx(0.96)),
        ("2", pytest.approx(0.96)),
    ]
    assert found.strictest.name == "Special"
    assert found.le95_m == pytest.approx(LE95 * 0.15 / 1.96)
    assert stated_of(np.full(10, 3.0), depth[:10]).strictest is None
    assert table(found)[0].rows[2][0] == "IHO S-44, vertical, Special"


def test_dry_points_and_unknown_ones_count_for_no_order():
    found = stated_of(np.array([0.05, 0.07, np.nan]), np.array([np.nan, 1.0, 1.0]))
    assert (found.points_wet, found.orders[0].share_within) == (1, 1.0)
    assert stated_of(np.array([0.05]), np.array([np.nan])).orders == ()
    assert stated_of(np.array([np.nan]), np.array([1.0])) is None
    assert table(None) == []


def test_without_a_reference_the_stated_order_is_among_the_main_figures(shallow_survey):
    figures = figures_of(facts_of(shallow_survey, plane_bed(shallow_survey, num=20)))
    (card,) = [card for card in cards(figures) if "S-44" in card.label]
    assert (card.label, card.value) == ("IHO S-44, vertical, stated", figures["stated"].strictest.name)
