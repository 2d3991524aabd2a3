"""Blocks placed by control points alone: exact ones with a fault each, and what is said of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_block import synthetic_block

from geo.crs import parse_crs
from geo.frames import LocalFrame, Similarity
from refract import PinholeCamera
from survey.control.points import ControlPoint, Mark
from survey.errors import ControlError
from survey.sfm import block as sfm_block
from survey.sfm.absolute_orientation import place_by_control, views_of_block
from survey.sfm.control_fit import BlockControl, fit_control, intersect_marks
from survey.sfm.features import CameraBody
from survey.sfm.solve import FreeBlocks

FRAME = LocalFrame(parse_crs("EPSG:25832+5778"), (500000.0, 5200000.0, 100.0))
# Ground about 40 m below the cameras, in no symmetry.
PLACES = np.array(
    [
        [-22.0, -17.0, 0.4],
        [20.0, -19.0, 1.3],
        [24.0, 18.0, -0.8],
        [-19.0, 21.0, 0.1],
        [3.0, 2.0, 1.9],
        [11.0, -6.0, -1.2],
    ]
)


def block_control(posed: dict[str, PinholeCamera], num: int = 6, places: np.ndarray = PLACES) -> BlockControl:
    """Control at true places with exact marks in the first five views that show it, of a block at its true place."""
    points = tuple(
        ControlPoint(f"gcp{k}", (0.0, 0.0, 0.0), place.copy(), np.full(3, 0.01)) for k, place in enumerate(places[:num])
    )
    marks = []
    for point in points:
        shown = []
        for name, view in posed.items():
            pixel = view.project(point.local[None], None)[0]
            if ((pixel > 5.0) & (pixel < (view.width - 5.0, view.height - 5.0))).all():
                shown.append(Mark(point.name, name, tuple(pixel.tolist())))
        # The first and the last ones: rays that open.
        marks += [*shown[:3], *shown[-2:]] if len(shown) > 5 else shown
    return BlockControl(FRAME, points, tuple(marks), np.zeros(len(points)))


def posed_block(rng) -> tuple[dict[str, PinholeCamera], BlockControl]:
    """A block in a frame of its own, and its control."""
    block, _ = synthetic_block(rng)
    control = block_control(views_of_block(block))
    rotation = Rotation.random(rng=rng).as_matrix()
    sfm_block.transform(block, Similarity(0.07, rotation, np.array([3.0, -2.0, 9.0])))
    return views_of_block(block), control


def with_place(control: BlockControl, number: int, shift) -> BlockControl:
    points = list(control.points)
    points[number] = replace(points[number], local=points[number].local + np.asarray(shift))
    return replace(control, points=tuple(points))


def first(control: BlockControl, num: int) -> BlockControl:
    return replace(control, points=control.points[:num], slack=control.slack[:num])


@pytest.mark.parametrize("num", [3, 4, 6])
def test_a_block_without_positions_is_placed_by_its_control(rng, num):
    block, centres = synthetic_block(rng)
    control = block_control(views_of_block(block), num)
    sfm_block.transform(block, Similarity(0.05, Rotation.random(rng=rng).as_matrix(), np.array([7.0, 1.0, -4.0])))
    sensor = CameraBody(tuple(centres), (800, 600), 900.0)
    placed = place_by_control(FreeBlocks((block,), ()), control, [sensor])
    origin = np.array(placed.frame.origin) - FRAME.origin
    for name, (centre, _) in sfm_block.poses_of(placed.blocks[0]).items():
        np.testing.assert_allclose(centre + origin, centres[name], atol=1e-6)
    assert "placed by control points alone (gcp0, gcp1, gcp2" in placed.notes[-1]


def test_a_wrong_mark_is_named_and_the_point_kept(rng):
    posed, control = posed_block(rng)
    wrong = replace(control.marks[2], pixel=(control.marks[2].pixel[0] - 180.0, control.marks[2].pixel[1] + 90.0))
    spoilt = replace(control, marks=(*control.marks[:2], wrong, *control.marks[3:]))
    fit = fit_control(spoilt, posed)
    assert fit.intersections.wrong_marks == (wrong,)
    assert fit.used == tuple(point.name for point in control.points)
    whole = fit_control(control, posed)
    np.testing.assert_allclose(fit.similarity.shift, whole.similarity.shift, atol=1e-6)


def test_of_two_marks_that_do_not_meet_neither_is_used(rng):
    posed, control = posed_block(rng)
    mine = [mark for mark in control.marks if mark.point == "gcp1"]
    moved = replace(mine[0], pixel=(mine[0].pixel[0] + 60.0, mine[0].pixel[1] + 60.0))
    others = tuple(mark for mark in control.marks if mark.point != "gcp1")
    met = intersect_marks(replace(control, marks=(*others, moved, mine[-1])), posed)
    assert met.inconsistent == ("gcp1",)
    assert len(met.points) == 5


@pytest.mark.parametrize("shift", [(5.0, 0.0, 0.0), (0.0, 0.0, -5.0)])
def test_wrong_coordinates_are_named_with_how_far_they_are_off(rng, shift):
    posed, control = posed_block(rng)
    fit = fit_control(with_place(control, 3, shift), posed)
    assert list(fit.wrong) == ["gcp3"]
    assert fit.wrong["gcp3"] == pytest.approx(5.0, abs=1e-6)


def test_wrong_coordinates_that_four_points_cannot_tell_are_refused(rng):
    posed, control = posed_block(rng)
    with pytest.raises(ControlError, match=r"4 control points gcp0, .* contradict each other, and fit .* without gcp"):
        fit_control(with_place(first(control, 4), 1, (0.0, 0.0, 5.0)), posed)


def test_swapped_columns_are_said(rng):
    posed, control = posed_block(rng)
    swapped = replace(control, points=tuple(replace(point, local=point.local[[1, 0, 2]]) for point in control.points))
    with pytest.raises(ControlError, match=r"easting and northing .* swapped"):
        fit_control(swapped, posed)
    # Flat ground fits from below.
    flat = tuple(replace(point, local=point.local * [1.0, 1.0, 0.0]) for point in control.points)
    block, _ = synthetic_block(rng)
    true = views_of_block(block)
    level = block_control(true, places=PLACES * [1.0, 1.0, 0.0])
    assert len(fit_control(replace(level, points=flat), true).used) == 6
    turned = tuple(replace(point, local=point.local[[1, 0, 2]]) for point in flat)
    with pytest.raises(ControlError, match="under the ground; swap easting and northing"):
        fit_control(replace(level, points=turned), true)


def test_marks_with_x_and_y_swapped_are_said(rng):
    posed, control = posed_block(rng)
    turned = tuple(replace(mark, pixel=mark.pixel[::-1]) for mark in control.marks)
    with pytest.raises(ControlError, match="meet with x and y of the marks swapped"):
        fit_control(replace(control, marks=turned), posed)


def test_control_of_another_place_is_refused_with_its_misfit(rng):
    posed, control = posed_block(rng)
    random = tuple(replace(point, local=rng.uniform(-30.0, 30.0, 3)) for point in control.points)
    with pytest.raises(
        ControlError, match=r"6 control points do not fit .* m \(root mean square, .* \[control\] std_m"
    ):
        fit_control(replace(control, points=random), posed)


def test_too_little_control_is_refused_with_what_was_found(rng):
    posed, control = posed_block(rng)
    few = tuple(mark for mark in control.marks if mark.point in ("gcp0", "gcp1"))
    with pytest.raises(
        ControlError, match=r"2 of 6 control points .* expected at least 3 .*usable: gcp0, gcp1; .*gcp2"
    ):
        fit_control(replace(control, marks=few), posed)


def test_points_on_one_line_place_a_block_but_for_its_roll(rng):
    block, _ = synthetic_block(rng)
    posed = views_of_block(block)
    line = np.linspace([-20.0, -15.0, 0.0], [20.0, 15.0, 1.0], 4)
    fit = fit_control(block_control(posed, 4, line), posed)
    assert fit.line is not None
    assert "4 control points lie on one line (spread 18." in fit.line.describe(4)
    off = fit.similarity(fit.intersections.places) - np.array([point.local for point in fit.intersections.points])
    assert np.abs(off).max() < 0.1


def test_points_under_water_seem_higher_and_are_not_wrong(rng):
    posed, control = posed_block(rng)
    wet = with_place(control, 4, (0.0, 0.0, -1.5))
    assert list(fit_control(wet, posed).wrong) == ["gcp4"]
    slack = wet.slack.copy()
    slack[4] = 1.0
    assert not fit_control(replace(wet, slack=slack), posed).wrong
