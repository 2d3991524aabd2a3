"""A survey of kilometres over one plane: heights over the water as they are where it touches the Earth."""

from dataclasses import replace

import numpy as np
import pytest

from geo.frames import LocalFrame
from survey.errors import ConfigError, PosesError
from survey.folder.plausible import require_plausible
from survey.plan.area import flattened


def in_frame(survey, frame: LocalFrame):
    """Cameras and water of a survey in another local frame."""
    moved, water = frame.from_frame(survey.frame), survey.water
    views = []
    for view in survey.views:
        turned = view.camera.cam_from_local @ moved.rotation.T
        views.append(
            replace(view, camera=replace(view.camera, centre=moved(view.camera.centre), cam_from_local=turned))
        )
    if water is not None:
        up = moved.rotation @ np.array(water.up)
        point = tuple(moved(np.array(water.point)).tolist())
        water = replace(water, point=point, slope_x=float(-up[0] / up[2]), slope_y=float(-up[1] / up[2]))
    points = survey.observations.points
    observations = replace(survey.observations, points=None if points is None else moved(points))
    return replace(survey, frame=frame, views=tuple(views), water=water, observations=observations)


def test_a_survey_within_a_kilometre_stays_as_it_is(shallow_survey):
    assert flattened(shallow_survey) is shallow_survey


@pytest.mark.parametrize("is_wet", [True, False])
def test_photographs_far_from_the_origin_are_as_high_over_the_water_as_they_are(shallow_survey, is_wet):
    east, north, height = shallow_survey.frame.origin
    frame = LocalFrame(shallow_survey.frame.crs, (east - 10_000.0, north, height))
    near = shallow_survey if is_wet else replace(shallow_survey, water=None)
    found = flattened(in_frame(near, frame))
    for before, after in zip(near.views, found.views, strict=True):
        assert after.camera.centre[2] == pytest.approx(before.camera.centre[2], abs=1e-3)
        if is_wet:
            assert found.water.depth(after.camera.centre) == pytest.approx(
                near.water.depth(before.camera.centre), abs=1e-3
            )
    if is_wet:
        np.testing.assert_allclose((found.water.slope_x, found.water.slope_y),
                                   (near.water.slope_x, near.water.slope_y), atol=1e-5)  # fmt: skip


def test_low_flights_over_water_that_falls_away_are_not_under_it(shallow_survey):
    survey, plane = shallow_survey, shallow_survey.water
    x, y, z = plane.point
    above = replace(plane, point=(x, y, z + 500.0))
    centres = np.array([view.camera.centre for view in survey.views])
    with pytest.raises((ConfigError, PosesError)):
        require_plausible(survey.frame, list(survey.views), -above.depth(centres), survey.config, {})
    require_plausible(survey.frame, list(survey.views), -plane.depth(centres), survey.config, {})
