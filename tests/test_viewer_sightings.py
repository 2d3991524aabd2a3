"""Bent rays and windows of one point, and the colours of many."""

from dataclasses import replace

import numpy as np
import pytest

from refract import trace
from survey.viewer.shown import SCALES, UNKNOWN, Scale
from survey.viewer.sightings import ENLARGED, WINDOW_PX, PhotographCache, mosaic, sightings_of, thumbnail, unhidden
from survey.viewer.tree import build_tree

# From the centre of the small survey: 0.3 m under water, within the first frames.
POINT = np.array([1.0, -0.5, -0.8])


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    from small_survey import small_survey

    from survey.folder.survey import load_survey

    return load_survey(small_survey(tmp_path_factory.mktemp("sightings") / "s"))


def test_rays_obey_snell_and_end_at_the_point(survey):
    found = sightings_of(survey.views, POINT, survey.water)
    assert len(found) >= 2
    assert [s.incidence for s in found] == sorted(s.incidence for s in found)
    for sighting in found:
        assert sighting.is_bent
        assert survey.water.height(*sighting.crossing[:2]) == pytest.approx(sighting.crossing[2], abs=1e-9)
        down = (sighting.crossing - sighting.camera) / np.linalg.norm(sighting.crossing - sighting.camera)
        under = (POINT - sighting.crossing) / np.linalg.norm(POINT - sighting.crossing)
        bent = trace(sighting.camera, down, survey.water).water_direction
        # Projection is solved to the last bits, and the pixel is rounded once.
        np.testing.assert_allclose(under, bent, atol=1e-7)


def test_a_dry_point_is_seen_straight(survey):
    dry = np.array([1.0, -0.5, 0.6])
    for sighting in sightings_of(survey.views, dry, survey.water):
        assert not sighting.is_bent
        np.testing.assert_array_equal(sighting.crossing, dry)


def test_a_photograph_that_does_not_show_the_point_is_left_out(survey):
    assert sightings_of(survey.views, np.array([500.0, 0.0, -1.0]), survey.water) == []
    raised = [replace(view, camera=replace(view.camera, tide=0.05)) for view in survey.views]
    higher = sightings_of(raised, POINT, survey.water)
    assert all(s.crossing[2] == pytest.approx(survey.water.height(*s.crossing[:2]) + 0.05) for s in higher)


def test_photographs_from_behind_a_wall_do_not_show_the_point(survey):
    gsd, seen = 0.05, sightings_of(survey.views, POINT, survey.water)
    x, y = np.meshgrid(np.arange(-3.0, 5.0, gsd), np.arange(-4.0, 3.0, gsd))
    slope = np.tan(np.radians(30.0))
    bed = np.column_stack([x.ravel(), y.ravel(), POINT[2] + slope * (x.ravel() - POINT[0])])
    # The bed itself hides nothing, though it rises at 30 degrees.
    assert unhidden(seen, build_tree(bed), gsd) == seen
    # A small roof half way to one camera, beside the rays of the others; or in the water, where they are together.
    blocked = seen[-1]
    at = 0.5 * (blocked.crossing + blocked.camera)
    u, v = np.meshgrid(np.arange(-0.1, 0.1, gsd), np.arange(-0.1, 0.1, gsd))
    roof = np.column_stack([at[0] + u.ravel(), at[1] + v.ravel(), np.full(u.size, at[2])])
    found = unhidden(seen, build_tree(np.concatenate([bed, roof])), gsd)
    assert blocked not in found
    apart = [s for s in seen if np.abs(0.5 * (s.crossing + s.camera) - at)[:2].max() > 0.1 + 2.0 * gsd]
    assert apart
    assert all(s in found for s in apart)
    low = roof + 0.5 * (blocked.point + blocked.crossing) - at
    assert blocked not in unhidden(seen, build_tree(np.concatenate([bed, low])), gsd)
    # A stray in the way is none.
    assert unhidden(seen, build_tree(np.concatenate([bed, at[None]])), gsd) == seen


def test_windows_have_the_point_in_their_middle(survey):
    photographs = PhotographCache(survey.views)
    sighting = sightings_of(survey.views, POINT, survey.water)[0]
    # At the centre of a pixel, whose colour the middle of an odd window then has.
    at = replace(sighting, pixel=np.array([20.5, 30.5]))
    window = photographs.window(at, 5)
    from survey.photos.images import load_image

    np.testing.assert_array_equal(window, load_image(sighting.view)[28:33, 18:23])
    windows = [photographs.window(s) for s in (sighting, sighting)]
    sheet = mosaic(windows, ["a.jpg", "b.jpg"])
    assert sheet.shape[1] == 2 * WINDOW_PX * ENLARGED
    assert thumbnail(survey.views[0], 32).shape == (24, 32, 3)


def test_colours_run_from_the_low_to_the_high_value():
    scale = Scale("height", "m", "viridis")
    values = np.array([0.0, 1.0, -5.0, np.nan])
    colours = scale.colours(values, (0.0, 1.0))
    bar = scale.bar(256, 2)
    np.testing.assert_array_equal(colours[0], bar[0, 0])
    np.testing.assert_array_equal(colours[1], bar[0, -1])
    np.testing.assert_array_equal(colours[2], bar[0, 0])
    assert "#" + bytes(colours[3]).hex() == UNKNOWN


def test_ranges_leave_strays_out_and_errors_are_about_zero():
    values = np.append(np.linspace(1.0, 2.0, 1000), [1e6, np.nan])
    low, high = SCALES["std"].limits(values)
    assert 1.0 <= low < high < 2.1
    assert (
        SCALES["error"].limits(np.linspace(-1.0, 3.0, 1000))[0]
        == -SCALES["error"].limits(np.linspace(-1.0, 3.0, 1000))[1]
    )
    assert SCALES["depth"].limits(np.full(3, np.nan)) == (0.0, 1.0)
    assert SCALES["depth"].limits(np.zeros(3))[1] > 0.0


@pytest.mark.parametrize("scale", SCALES.values(), ids=SCALES)
def test_every_quantity_has_a_colour_map(scale):
    assert len(np.unique(scale.bar(256, 1)[0], axis=0)) > 100
