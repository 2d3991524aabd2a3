"""What an adjusted block that lies askew or beside its place does to heights, over slopes and level ground."""

from dataclasses import replace

import numpy as np
import pytest

from survey.adjust.result.std_common import BedCells, std_of_block
from tests.block_survey import drawn_adjustment, survey_of
from tests.changed_survey import changed

GSD = 0.05


def plane(slope_x: float) -> np.ndarray:
    """Points of a sloped bed under the middle of a drawn block."""
    x, y = np.meshgrid(np.linspace(-4.0, 4.0, 81), np.linspace(-4.0, 4.0, 81))
    return np.stack([x, y, -2.0 + slope_x * x], axis=-1).reshape(-1, 3)


def std_by(step: dict[str, float], bed: np.ndarray) -> np.ndarray:
    """Std of a bed where only this change of parameters, by their last names, is uncertain."""
    block, found = drawn_adjustment(dry_share=0.0)
    change = np.array([step.get(name.rpartition(".")[2], 0.0) for name in found.covariance.names])
    survey = changed(survey_of(block), ties=None)
    return std_of_block(
        bed, survey, replace(found, covariance=replace(found.covariance, matrix=np.outer(change, change))), GSD
    )


def test_what_lifts_all_heights_alike_is_no_part_of_it():
    assert std_by({"z": 0.025, "height_m": 0.025}, plane(0.2)).max() < 1e-4


@pytest.mark.parametrize("slope", [0.0, 0.2, -0.5])
def test_a_block_beside_its_place_shows_other_heights_where_the_bed_slopes(slope):
    std = std_by({"x": 0.1}, plane(slope))
    # The water of the block is level but for a rise of some millimetres per metre.
    np.testing.assert_allclose(std, 0.1 * abs(slope), atol=1e-3)


def test_a_block_far_beside_its_place_shows_heights_that_have_nothing_to_do_with_those_there():
    x, y = np.meshgrid(np.linspace(-4.0, 4.0, 161), np.linspace(-4.0, 4.0, 161))
    wave = 0.05 * np.sin(np.pi * x)
    std = std_by({"x": 1.0}, np.stack([x, y, -2.0 + wave], axis=-1).reshape(-1, 3)).reshape(x.shape)
    # Slopes would have it 0.16 m halfway up and nothing on top. The difference to a wave of any phase is its own square
    # and the mean one. Cells of 0.1 m flatten the wave by 1 %, and show it up to 0.05 m beside a point: by an
    # eighth of its height at most.
    expected = np.sqrt(wave**2 + 0.5 * 0.05**2)
    inside = (np.abs(x) < 1.0) & (np.abs(y) < 2.0)
    np.testing.assert_allclose(std[inside], expected[inside], atol=0.15 * 0.05)


def bed_of(height, step: float = 0.1) -> np.ndarray:
    """Points (N, 3) of a bed of 8 x 8 m, whose height is a function of x and y."""
    side = np.arange(-4.0, 4.0 + 0.5 * step, step)
    x, y = np.meshgrid(side, side)
    return np.stack([x, y, height(x, y)], axis=-1).reshape(-1, 3)


def rise_at(bed: np.ndarray, side: float, std) -> list[np.ndarray]:
    """What `BedCells.squared_rise` says at the points of a bed."""
    cells = BedCells.of(bed, side)
    return [cells.at(each, bed) for each in cells.squared_rise(np.array(std))]


def test_slopes_are_those_of_the_bed_and_noise_of_single_heights_averages_out(rng):
    bed = bed_of(lambda x, _: 0.3 * x)
    bed[:, 2] += 0.02 * rng.standard_normal(len(bed))
    cells = BedCells.of(bed, 1.0)
    slopes = cells.at(cells.slope, bed)
    # The fewest are 121 heights of 2 cm at a corner, in 1 m x 1 m: 6 mm per metre; five of these.
    np.testing.assert_allclose(slopes, np.tile([0.3, 0.0], (len(bed), 1)), atol=0.03)
    far = np.concatenate([bed, [[1e4, 1e4, 0.0]]])
    assert np.isfinite(BedCells.of(far, 0.1).slope).all()


@pytest.mark.parametrize("std", [(0.02, 0.3), (0.3, 0.3), (0.8, 0.2)])
def test_a_plane_rises_by_its_slope_as_far_as_the_displacement_goes(std):
    bed = bed_of(lambda x, y: 0.3 * x - 0.2 * y, 0.05)
    rise, reached = rise_at(bed, 0.1, std)
    inside = (np.abs(bed[:, :2]) < 3.8 - 4.0 * np.array(std)).all(axis=1)
    np.testing.assert_allclose(rise[inside], reached[inside] @ [0.09, 0.04], rtol=1e-6)
    # A fifth of a cell is none; four standard deviations are nearly all.
    expected = np.where(np.array(std) < 0.1, 0.0, np.square(std))
    np.testing.assert_allclose(reached[inside], np.tile(expected, (inside.sum(), 1)), rtol=0.01, atol=1e-6)


@pytest.mark.parametrize("std", [0.2, 0.5, 2.0])
def test_a_wave_rises_as_the_normal_law_has_it(std):
    k, size = 2.0 * np.pi / 3.0, 0.1
    bed = bed_of(lambda x, _: size * np.sin(k * x), 0.05)
    # Each point in the middle of a cell: half a cell beside it, the wave is another one.
    bed[:, :2] -= bed[0, :2]
    rise, _ = rise_at(np.concatenate([bed, [[-0.025, -0.025, bed[0, 2]]]]), 0.05, [std, 0.0])
    x = bed[:, 0] - 4.0
    sine, faded = np.sin(k * x), np.exp(-0.5 * (k * std) ** 2)
    expected = 0.5 * (1.0 - faded**4 * np.cos(2.0 * k * x)) - 2.0 * sine**2 * faded + sine**2
    inside = np.abs(x) < max(3.8 - 4.0 * std, 0.3)
    # Nine cells flatten the wave by half a percent; displaced by 2 m, four metres and less of it are seen to each side.
    np.testing.assert_allclose(
        rise[:-1][inside], size**2 * expected[inside], atol=(0.02 if std < 1.0 else 0.2) * size**2
    )


def test_where_nothing_is_seen_nothing_rises():
    bed = bed_of(lambda x, _: 0.1 * np.sin(3.0 * x), 0.05)
    hole = np.hypot(bed[:, 0], bed[:, 1]) > 1.0
    rise, _ = rise_at(bed[hole], 0.1, [0.1, 0.1])
    whole, _ = rise_at(bed, 0.1, [0.1, 0.1])
    assert np.isfinite(rise).all()
    far = np.hypot(bed[hole, 0], bed[hole, 1]) > 1.7
    np.testing.assert_allclose(rise[far], whole[hole][far], atol=1e-9)
    # A single point rises to nothing.
    single, _ = rise_at(bed[:1], 0.1, [0.1, 0.1])
    np.testing.assert_allclose(single, 0.0, atol=1e-12)
