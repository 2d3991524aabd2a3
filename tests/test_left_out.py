"""White pixels of photographs: left out, small holes closed for windows, counted and named."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fields.solver.tile import brightness_of
from fields.sweep.block import downsample, fill_small_holes
from fields.sweep.photo_consistency import Consistency
from survey.photos.texture import saturated_pixels
from survey.report.photographs import left_out_shares, photograph_warnings, photographs_of, table


def _image(rng) -> np.ndarray:
    return np.rint(40.0 * gaussian_filter(rng.standard_normal((60, 80)), 2.0) / 0.14).astype(np.float32)


def test_an_image_without_holes_stays_as_it_is(rng):
    image = _image(rng)
    assert fill_small_holes(image) is image


def test_a_small_hole_takes_whole_levels_of_its_surroundings_and_a_large_one_stays(rng):
    image = _image(rng)
    holed = image.copy()
    holed[10:12, 20:22] = np.nan
    holed[30:50, 30:50] = np.nan
    found = fill_small_holes(holed)
    around = image[8:14, 18:24]
    assert np.all((found[10:12, 20:22] >= around.min()) & (found[10:12, 20:22] <= around.max()))
    assert np.array_equal(found[10:12, 20:22], np.rint(found[10:12, 20:22]))
    assert np.isnan(found[32:48, 32:48]).all()
    known = np.isfinite(holed)
    np.testing.assert_array_equal(found[known], image[known])


def test_a_straight_edge_of_what_is_left_out_stays_where_it_is(rng):
    image = _image(rng)
    image[:, 50:] = np.nan
    assert np.array_equal(np.isnan(fill_small_holes(image)), np.isnan(image))


def test_a_smaller_image_is_the_mean_of_what_is_known():
    image = np.full((8, 8), 10.0, dtype=np.float32)
    image[0, 0] = np.nan
    image[4:8, 4:8] = np.nan
    image[4, 4] = 10.0
    small = downsample(image, (2, 2))
    np.testing.assert_allclose(small[0], 10.0)
    assert np.isnan(small[1, 1])


def test_white_and_what_is_beside_it_is_saturated():
    grey = np.full((9, 9), 240.0, dtype=np.float32)
    assert not saturated_pixels(grey).any()
    grey[4, 4] = 255.0
    assert np.argwhere(saturated_pixels(grey)).min(axis=0).tolist() == [3, 3]
    assert saturated_pixels(grey).sum() == 9


def test_photographs_that_give_nothing_to_the_cloud_are_named_with_the_reason():
    consistency = {f"{i}.jpg": Consistency(4000, 0.8, 8.0) for i in range(5)}
    consistency |= {
        "up.jpg": Consistency(0, None, 8.0),
        "turned.jpg": Consistency(3000, 0.02, 8.0),
        "dim.jpg": Consistency(3000, 0.05, 1.0),
        "edge.jpg": Consistency(20, -0.1, 8.0),
    }
    found = {each.name: each.useless for each in photographs_of(dict.fromkeys(consistency, 0.0), {}, consistency)}
    assert [name for name, why in found.items() if why] == ["up.jpg", "turned.jpg", "dim.jpg"]
    (warning,) = photograph_warnings(photographs_of(dict.fromkeys(consistency, 0.0), {}, consistency))
    assert warning.startswith("3 photographs with nothing for the cloud: up.jpg (its frame holds none of the bed")
    assert "turned.jpg (shows something else there: pose wrong)" in warning
    assert "dim.jpg (blurred, or without texture)" in warning
    # Where all correlate badly, as in noise, none stands out.
    noisy = {f"{i}.jpg": Consistency(4000, 0.1, 8.0) for i in range(5)}
    assert not any(each.useless for each in photographs_of(dict.fromkeys(noisy, 0.0), {}, noisy))


def test_each_photograph_has_its_shares_and_those_that_are_mostly_white_are_named():
    found = photographs_of({"a.jpg": 0.0, "b.jpg": 0.61, "c.jpg": 0.03}, {"a.jpg": [200, 20], "c.jpg": [0, 0]}, {})
    assert [each.outlying for each in found] == [0.1, None, None]
    (warning,) = photograph_warnings(found)
    assert warning.startswith("1 photograph more than half white by glint of the sun or exposure")
    assert warning.endswith("b.jpg")
    (white, of_pixels), (unlike, _) = left_out_shares(found)
    assert white.startswith("left out as white")
    assert of_pixels.startswith("21.3")
    assert unlike.startswith("differing from all others")
    _, every = table(found)
    assert [row[0] for row in every.table.rows] == ["a.jpg", "b.jpg"]
    # Nothing is said of nothing.
    nothing = photographs_of({"a.jpg": 0.0}, {"a.jpg": [200, 0]}, {})
    assert left_out_shares(nothing) == []
    assert table(nothing)[-1].text == "All 1 photographs, 0 of them left out; at most 5.0\N{NO-BREAK SPACE}% of each."
    assert table(()) == left_out_shares(()) == photograph_warnings(()) == []


def test_what_one_photograph_alone_shows_is_outlying(rng):
    grey = (100.0 + rng.normal(0.0, 2.0, (8, 4000))).astype(np.float32)
    grey[3, :1000] += 60.0
    outlying = brightness_of(grey).outlying
    assert outlying[3, :1000].mean() > 0.99
    assert outlying[:, 1000:].mean() == pytest.approx(0.0, abs=0.01)
