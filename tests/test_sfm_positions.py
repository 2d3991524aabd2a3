"""Wrong GPS positions: named by their neighbours before, and by the block after structure from motion."""

from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np
import pytest

from geo.frames import robust_similarity
from survey.folder.headers import position_warnings
from survey.photos.exif import Exif
from survey.sfm.gps_fit import is_contradicted, line_of


def strips(rng, num: int, noise: float) -> np.ndarray:
    """Positions (num, 3) [m] of two strips, 30 m high."""
    along = 8.0 * (np.arange(num) // 2)
    return np.column_stack([along, 20.0 * (np.arange(num) % 2), np.full(num, 30.0)]) + rng.normal(0, noise, (num, 3))


@pytest.mark.parametrize("num", [8, 10, 32])
@pytest.mark.parametrize("wrong", [1, 2, 3])
@pytest.mark.parametrize("size", [3.0, 30.0, 2000.0, 1e6])
@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_the_block_contradicts_wrong_positions_and_no_other(rng, num, wrong, size, noise):
    residuals = rng.normal((1.0, -2.0, 40.0), noise, (num, 3))
    bad = rng.choice(num, min(wrong, (num - 2) // 3), replace=False)
    directions = rng.normal(size=(len(bad), 3))
    residuals[bad] += size * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    found = is_contradicted(residuals)
    # Of eight, two of them wrong, the others tell their spread to a third.
    assert found[bad].all() or size < (15.0 if num < 10 else 10.0) * noise
    # Six standard deviations of three normal deviates, of hundreds that are drawn with fixed seeds.
    assert found.sum() <= len(bad)


@pytest.mark.parametrize("num", [3, 4, 5, 6, 7, 9, 14])
@pytest.mark.parametrize("noise", [0.02, 0.5, 3.0])
def test_few_positions_that_fit_by_chance_do_not_make_the_others_wrong(rng, num, noise):
    """Three of five fit a similarity well, whatever their noise: that says nothing of the two."""
    for _ in range(3):
        block = strips(rng, num, 0.2)
        positions = block + rng.normal(0.0, noise, block.shape)
        fit, agree = robust_similarity(block, positions)
        assert agree.all()
        assert not is_contradicted(fit(block) - positions).any()


@pytest.mark.parametrize("num", [7, 10, 20])
@pytest.mark.parametrize("noise", [0.02, 0.5])
def test_one_position_far_off_is_found_among_few(rng, num, noise):
    block = strips(rng, num, 0.2)
    positions = block + rng.normal(0.0, noise, block.shape)
    positions[2] += [40.0, -30.0, 20.0]
    fit, agree = robust_similarity(block, positions)
    assert np.flatnonzero(~agree).tolist() == [2]
    assert np.flatnonzero(is_contradicted(fit(block) - positions)).tolist() == [2]


def test_residuals_that_are_not_known_count_for_nothing(rng):
    residuals = rng.normal(0.0, 0.1, (12, 3))
    residuals[3] = np.nan
    residuals[5] += [0.0, 0.0, 80.0]
    assert is_contradicted(residuals).tolist() == [i == 5 for i in range(12)]
    assert not is_contradicted(residuals[:3]).any()


@pytest.mark.parametrize("height", [0.0, -2000.0, 5000.0])
def test_one_wrong_height_makes_no_line_of_an_area(rng, height):
    positions = strips(rng, 10, 0.05)
    positions[3, 2] = height
    assert line_of(positions, 0.02) is None


def test_a_line_stays_one_with_and_without_a_wrong_position(rng):
    positions = strips(rng, 20, 0.05)[::2]
    line = line_of(positions, 0.02)
    assert line is not None
    assert abs(line.direction[0]) > 0.999
    assert "10 GPS positions lie on one line" in line.describe(10)
    positions[4, 2] = 2000.0
    assert line_of(positions, 0.02) is not None


def headers(positions: np.ndarray) -> dict[str, Exif]:
    degrees = positions / [111_200.0, 111_200.0, 1.0]
    return {
        f"{i:04d}.jpg": Exif((64, 48), (52.0 + n, 9.0 + e, h), None, 1, "", None) for i, (e, n, h) in enumerate(degrees)
    }


@pytest.mark.parametrize(
    ("axis", "value", "words"),
    [(2, 0.0, "far from the others by its GPS height"), (1, 2000.0, "far from all others by its GPS position")],
)
def test_check_names_the_photograph_that_is_far_from_the_others(rng, axis, value, words):
    positions = strips(rng, 20, 0.1)
    assert position_warnings(headers(positions)) == []
    positions[7, axis] = value
    (warning,) = position_warnings(headers(positions))
    assert words in warning
    assert "0007.jpg" in warning


def test_a_survey_across_the_meridian_of_180_degrees_is_one(rng):
    given = headers(strips(rng, 20, 0.1))
    east = np.mean([head.lat_lon_height[1] for head in given.values()])
    moved = {}
    for name, head in given.items():
        lat, lon, height = head.lat_lon_height
        moved[name] = replace(head, lat_lon_height=(lat, (lon - east) % 360.0 - 180.0, height))
    longitudes = [head.lat_lon_height[1] for head in moved.values()]
    assert min(longitudes) < -179.0
    assert max(longitudes) > 179.0
    assert position_warnings(moved) == []


def test_photographs_of_another_place_are_named_however_many_they_are(rng):
    positions = strips(rng, 20, 0.1)
    positions[13:] += [0.0, 30_000.0, 0.0]
    (warning,) = position_warnings(headers(positions))
    assert warning.startswith("7 images kilometres away from the others by GPS")
    assert "0013.jpg" in warning
    # Parts of one survey that lie two kilometres apart.
    positions[13:] -= [0.0, 28_000.0, 0.0]
    assert position_warnings(headers(positions)) == []


@pytest.mark.parametrize("num", [1, 2, 9])
def test_heights_of_exactly_0_are_named_however_many_they_are(rng, num):
    positions = serpentine(rng) + np.array([0.0, 0.0, 400.0])
    positions[:num, 2] = 0.0
    (warning,) = position_warnings(headers(positions))
    assert warning.startswith(f"{num} image{'s' * (num > 1)} far from the others by its GPS height, which are at 429.")
    assert all(f"{i:04d}.jpg (0.0 m)" in warning for i in range(min(num, 2)))


def test_two_flying_heights_are_no_doubt(rng):
    positions = strips(rng, 20, 0.1)
    positions[14:, 2] += 40.0
    assert position_warnings(headers(positions)) == []


def serpentine(rng) -> np.ndarray:
    """Places (20, 3) [m] of two strips that are flown one after the other."""
    k = np.arange(20)
    plan = np.stack([np.where(k < 10, k, 19 - k) * 6.0, k // 10 * 18.0], axis=1)
    return np.column_stack([plan, np.full(20, 30.0)]) + rng.normal(0.0, 0.1, (20, 3))


@pytest.mark.parametrize("same", [[3, 9], [3, 4, 5], range(20)])
def test_photographs_with_one_position_are_named(rng, same):
    positions = serpentine(rng)
    # Heights differ: places rounded to whole seconds.
    positions[list(same), :2] = positions[same[0], :2]
    doubts = position_warnings(headers(positions))
    if len(same) == 20:
        assert doubts == ["all 20 images have the same latitude and longitude to the last digit: no positions"]
    else:
        (warning,) = [line for line in doubts if "to the last digit" in line]
        assert warning.endswith(": " + ", ".join(f"{i:04d}.jpg" for i in same[1:]))


def taken(positions: np.ndarray, seconds: np.ndarray) -> dict[str, Exif]:
    """Heads of photographs at some seconds."""
    begin = datetime(2026, 5, 1, 10, 0)
    return {
        name: replace(head, clock=begin + timedelta(seconds=float(s)))
        for (name, head), s in zip(headers(positions).items(), seconds, strict=True)
    }


@pytest.mark.parametrize("of_each", [2, 5])
def test_photographs_of_a_rig_or_of_bands_are_taken_at_one_position_and_no_doubt(rng, of_each):
    positions = np.repeat(serpentine(rng), of_each, axis=0)
    assert position_warnings(taken(positions, np.repeat(2.0 * np.arange(20), of_each))) == []
