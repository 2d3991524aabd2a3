"""Heights of cells: planes through their points, what is seen from above, gaps, and how well all of it is known."""

from dataclasses import replace

import numpy as np
import pytest
from pyproj import CRS
from scipy import ndimage
from stored_run import GSD_M, run_of, stored_points

from geo.grid import Window
from survey.errors import SurveyError
from survey.export import bed_raster as bed_raster_module
from survey.export.bed_raster import LevelFit, bed_raster, cells_over, round_side, seen_from_above
from survey.export.cell_fit import LEAST_PX2, CellPoints, correlated_px2, fit_cells
from survey.export.loaded import LoadedRun
from survey.export.registry import ExportOptions

CRS_OF_TEST = CRS("EPSG:25832+5783")
CORNER = np.array([691000.0, 5334000.0])
SIDE = 0.1


def grid_of_points(size_m: float = 4.0, spacing_m: float = GSD_M) -> np.ndarray:
    """Points (N, 2) on a regular grid from (0, 0), shifted by a quarter of a step."""
    along = np.arange(0.25 * spacing_m, size_m, spacing_m)
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


def in_cells(plan: np.ndarray, across: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Number of the cell and place in it (sides from its middle) of points (N, 2)."""
    whole = np.floor(plan / SIDE).astype(int)
    return whole[:, 1] * across + whole[:, 0], plan / SIDE - whole - 0.5


def made(plan: np.ndarray, height: np.ndarray, tmp_path, *, level_m=None, std_m=0.01, **options):
    """The raster of points (N, 2) from `CORNER` with heights (N,), and the options that it was made with."""
    points = np.column_stack([plan + CORNER, height])
    path = run_of(stored_points(points, CRS_OF_TEST, std_m=std_m, level_m=level_m), tmp_path / "run")
    return LoadedRun(path), ExportOptions(**{"resolution_m": SIDE, **options})


def test_the_cells_of_a_plane_have_its_heights_wherever_their_points_lie():
    plan = grid_of_points()
    # A third of the points, more of them in the west of each cell.
    cell, offset = in_cells(plan)
    keep = np.random.default_rng(1).random(len(plan)) < 0.35 - 0.3 * offset[:, 0]
    height = 2000.0 + 0.8 * plan[:, 0] - 0.5 * plan[:, 1]
    fits = fit_cells(
        CellPoints(cell[keep], offset[keep], height[keep], np.full(keep.sum(), 1e-5)),
        side=SIDE,
        pixel=GSD_M,
        correlated=LEAST_PX2,
    )
    middle = SIDE * (np.stack([fits.cell % 40, fits.cell // 40], axis=1) + 0.5)
    enough = fits.count >= 5
    assert enough.sum() > 1000
    np.testing.assert_allclose(fits.height[enough], (2000.0 + middle @ [0.8, -0.5])[enough], atol=1e-6)


def test_a_cell_whose_points_lie_on_one_side_is_less_sure():
    offset = np.array([[-0.4, 0.0], [-0.35, 0.1], [-0.4, -0.1], [-0.3, 0.0]])
    whole = np.array([[-0.4, 0.3], [0.4, -0.3], [-0.3, -0.3], [0.3, 0.3]])
    cell, height, std = np.repeat([0, 1], 4), np.zeros(8), np.full(8, 0.005)
    fits = fit_cells(
        CellPoints(cell, np.concatenate([offset, whole]), height, std), side=SIDE, pixel=GSD_M, correlated=LEAST_PX2
    )
    # Slopes of 45 degrees either way move the middle, a third of a side off, by a third of it.
    assert fits.std[0] > 4 * fits.std[1]
    assert 0.5 * 0.36 * SIDE < fits.std[0] < 0.36 * SIDE


def test_a_point_that_stands_apart_hardly_moves_its_cell():
    rng = np.random.default_rng(2)
    offset, height = rng.uniform(-0.5, 0.5, (25, 2)), 0.005 * rng.standard_normal(25)
    cell, std = np.zeros(25, dtype=int), np.full(25, 0.01)
    before = fit_cells(CellPoints(cell, offset, height, std), side=SIDE, pixel=GSD_M, correlated=LEAST_PX2)
    height[7] += 1.0
    after = fit_cells(CellPoints(cell, offset, height, std), side=SIDE, pixel=GSD_M, correlated=LEAST_PX2)
    # A mean would move by 4 cm.
    assert abs(after.height[0] - before.height[0]) < 0.002


@pytest.mark.parametrize(("side", "radius_px"), [(0.1, 0.8), (0.1, 1.2), (0.3, 1.2)])
def test_the_standard_deviation_of_cells_is_that_of_their_errors_where_neighbouring_points_err_alike(side, radius_px):
    num = 300
    rng = np.random.default_rng(3)
    # Errors correlated over a radius as measured on drawn surveys: by a Gaussian, an effective area of 4 pi r^2.
    error = ndimage.gaussian_filter(rng.standard_normal((num, num)), radius_px, mode="wrap")
    error *= 0.01 / error.std()
    rows, columns = np.mgrid[0:num, 0:num]
    plan = GSD_M * (np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5)
    across = int(num * GSD_M / side)
    whole = np.minimum(np.floor(plan / side).astype(int), across - 1)
    fits = fit_cells(
        CellPoints(whole[:, 1] * across + whole[:, 0], plan / side - whole - 0.5, error.ravel(), np.full(num**2, 0.01)),
        side=side,
        pixel=GSD_M,
        correlated=LEAST_PX2,
    )
    covered = np.mean(np.abs(fits.height) < 1.96 * fits.std)
    assert 0.88 < covered <= 1.0
    ratio = np.sqrt(np.mean(fits.height**2)) / fits.std.mean()
    assert 0.5 < ratio < 1.25


@pytest.mark.parametrize(
    ("radius_px", "relief_m", "low", "high"), [(1.7, 0.0, 25.0, 45.0), (0.3, 0.0, LEAST_PX2, LEAST_PX2),
                                               (1.7, 0.03, LEAST_PX2, LEAST_PX2)],
)  # fmt: skip
def test_the_area_over_which_errors_are_alike_is_that_of_smooth_beds_and_the_least_of_rough_ones(
    radius_px, relief_m, low, high
):
    num, rng = 200, np.random.default_rng(5)
    # An effective area of 4 pi r^2: 36 and 1 px^2.
    error = ndimage.gaussian_filter(rng.standard_normal((num, num)), radius_px, mode="wrap")
    height = 0.01 * error / error.std() + relief_m * rng.standard_normal((num, num))
    rows, columns = np.mgrid[0:num, 0:num]
    plan = GSD_M * (np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5)
    # A bed that rises and bends, as beds do.
    height = height.ravel() + 0.2 * plan[:, 0] + 0.05 * plan[:, 1] ** 2
    assert low <= correlated_px2(plan, height, np.full(num**2, 0.01), GSD_M) <= high


def test_the_bed_under_a_deck_is_not_seen_from_above_and_that_beside_it_is():
    plan = grid_of_points()
    on_deck = (np.abs(plan - 2.0) < 0.6).all(axis=1)
    both = np.concatenate([plan, plan[on_deck]])
    height = np.concatenate([np.zeros(len(plan)), np.ones(on_deck.sum())])
    is_seen, wall_std = seen_from_above(both, height, np.full(len(both), 0.005), GSD_M)
    distance = np.abs(both - 2.0).max(axis=1) - 0.6
    assert is_seen[len(plan) :].all()
    assert not is_seen[: len(plan)][distance[: len(plan)] < -2 * GSD_M].any()
    assert is_seen[: len(plan)][distance[: len(plan)] > 2 * GSD_M].all()
    edge = (np.arange(len(both)) >= len(plan)) & (distance > -2 * GSD_M)
    # Anywhere between deck and bed, less what a steep slope explains.
    assert (wall_std[edge] > 0.4).all()
    assert (wall_std[np.abs(distance) > 5 * GSD_M] == 0.0).all()


def test_a_steep_slope_is_no_wall():
    plan = grid_of_points()
    is_seen, wall_std = seen_from_above(plan, 2.0 * plan[:, 0], np.full(len(plan), 0.005), GSD_M)
    assert is_seen.all()
    assert (wall_std == 0.0).all()


def test_a_badly_known_point_high_above_the_bed_hides_nothing():
    plan = np.concatenate([grid_of_points(1.0), [[0.5, 0.5]]])
    height = np.append(np.zeros(len(plan) - 1), 0.3)
    is_seen, _ = seen_from_above(plan, height, np.append(np.full(len(plan) - 1, 0.005), 0.2), GSD_M)
    assert is_seen.all()


def test_a_raster_does_not_depend_on_its_bands(tmp_path, monkeypatch):
    rng = np.random.default_rng(4)
    plan = rng.uniform(0.0, 13.0, (60_000, 2))
    height = 500.0 + 0.1 * np.sin(3.0 * plan[:, 0]) + np.where(plan[:, 1] > 6.0, 0.5, 0.0)
    run, options = made(plan, height, tmp_path)
    with run:
        whole = bed_raster(run, options)
        monkeypatch.setattr(bed_raster_module, "_POINTS_OF_BAND", 5000)
        banded = bed_raster(run, ExportOptions(resolution_m=SIDE, fill_m=0.01))
        assert whole.cells.shape == (130, 130)
        np.testing.assert_array_equal(banded.count, whole.count)
        np.testing.assert_array_equal(banded.height, whole.height)
        np.testing.assert_array_equal(banded.std, whole.std)


def test_what_all_heights_share_is_not_averaged_away(tmp_path):
    run, options = made(grid_of_points(), np.zeros(40_000), tmp_path)
    run.folder.report_json_path.write_text('{"adjustment": {"height_std_common_m": {"mean": 0.01, "typical": 0.04}}}')
    with run:
        raster = bed_raster(run, options)
        assert run.common_std_m == 0.04
        assert (raster.common == np.float32(0.04)).all()
        stds = raster.stds(Window(0, 40, 0, 40))
        assert (stds > 0.04).all()
        assert np.median(stds) < np.hypot(0.04, 0.01)


def test_what_heights_share_is_that_of_the_points_where_they_have_it(tmp_path):
    plan = grid_of_points()
    points = np.column_stack([plan + CORNER, np.zeros(len(plan))])
    common = np.where(plan[:, 0] < 2.0, 0.03, np.nan).astype(np.float32)
    stored = replace(stored_points(points, CRS_OF_TEST), std_common=common)
    with LoadedRun(run_of(stored, tmp_path / "run")) as run:
        raster = bed_raster(run, ExportOptions(resolution_m=SIDE))
        np.testing.assert_allclose(raster.common[:, :20], 0.03, rtol=1e-6)
        # Not known of the others, and the run has no adjustment.
        assert (raster.common[:, 20:] == 0.0).all()


def test_gaps_up_to_a_width_are_filled_marked_and_less_sure(tmp_path):
    plan = grid_of_points()
    narrow, wide = np.abs(plan[:, 0] - 1.05) < 0.151, np.abs(plan - 2.75).max(axis=1) < 0.45
    plan = plan[~narrow & ~wide]
    run, options = made(plan, 10.0 + 0.5 * plan[:, 1], tmp_path, fill_m=0.5)
    with run:
        raster = bed_raster(run, options)
        at = raster.cells.middles(Window(0, 40, 0, 40)) - CORNER
        in_narrow, in_wide = np.abs(at[..., 0] - 1.05) < 0.15, np.abs(at - 2.75).max(axis=-1) < 0.4
        assert (raster.origin[in_narrow] == 2).all()
        assert (raster.count[in_narrow] == 0).all()
        assert (raster.origin[in_wide] == 0).all()
        assert np.isnan(raster.heights(Window(0, 40, 0, 40))[in_wide]).all()
        error = raster.height[in_narrow] - (10.0 + 0.5 * at[..., 1][in_narrow])
        assert (np.abs(error) < 2.0 * raster.std[in_narrow]).all()
        assert raster.std[in_narrow].min() > 2.0 * np.median(raster.std[raster.origin == 1])


@pytest.mark.parametrize("width", [1, 2, 7])
def test_a_gap_is_closed_where_no_square_fits_into_it(width):
    known = np.random.default_rng(width).random((40, 53)) < 1.5 / (width + 1) ** 2
    square = np.ones((width + 1, width + 1), dtype=bool)
    around = np.pad(~known, width + 1, constant_values=True)
    fits = ndimage.binary_opening(around, square)[width + 1 : -width - 1, width + 1 : -width - 1]
    closed = bed_raster_module._closed(known, width)
    np.testing.assert_array_equal(closed, ~fits)
    assert (closed & ~known).any()


def test_the_level_of_sloped_water_is_found_from_the_depths_to_a_tenth_of_a_millimetre():
    rng = np.random.default_rng(5)
    plan = CORNER + rng.uniform(0.0, 300.0, (5000, 2))
    level = 500.0 + 0.004 * (plan[:, 1] - CORNER[1]) - (plan - CORNER - 150.0) ** 2 @ [1.0, 1.0] / (2 * 6.37e6)
    height = level - rng.uniform(0.5, 4.0, 5000)
    depth = np.where(np.arange(5000) % 3, level - height, np.nan)
    fit = LevelFit.of(np.column_stack([plan, height]), depth)
    np.testing.assert_allclose(fit(plan), level, atol=1e-4)
    assert LevelFit.of(np.column_stack([plan, height]), np.full(5000, np.nan)) is None


def test_cells_lie_at_multiples_of_their_side_and_cover_all_points():
    points = CORNER + np.array([[0.31, 0.49], [7.2, 3.0]])
    cells = cells_over(points, CRS_OF_TEST, 0.25)
    assert cells.origin == (691000.25, 5334003.0)
    assert cells.shape == (11, 28)
    at = cells.columns_rows(points)
    assert (at >= 0.0).all()
    assert (at[:, ::-1] <= cells.shape).all()
    np.testing.assert_allclose(cells.middles(Window(0, 1, 0, 1))[0, 0], [691000.375, 5334002.875])


def test_a_resolution_that_makes_too_many_cells_or_none_is_refused(tmp_path):
    with pytest.raises(SurveyError, match=r"is too large; give a larger --resolution"):
        cells_over(np.array([CORNER, CORNER + 1000.0]), CRS_OF_TEST, 0.001)
    run, _ = made(grid_of_points(0.2), np.zeros(100), tmp_path)
    for wrong in (0.0, -1.0, float("nan"), float("inf"), 1e-300, 1e9):
        with pytest.raises(SurveyError, match=r"--resolution is .*, expected the side of a cell in metres"):
            bed_raster(run, ExportOptions(resolution_m=wrong))
    with pytest.raises(SurveyError, match=r"--fill is -1, expected the width of the gaps"):
        bed_raster(run, ExportOptions(fill_m=-1.0))


@pytest.mark.parametrize(("side", "expected"), [(0.083, 0.1), (0.1, 0.1), (0.106, 0.2), (0.21, 0.25), (3.0, 5.0)])
def test_a_side_that_is_chosen_is_round(side, expected):
    assert round_side(side) == expected


@pytest.mark.parametrize("share", [0.7, 0.5])
def test_the_part_of_a_cell_without_points_makes_its_height_uncertain(share):
    rng = np.random.default_rng(5)
    num, side = 400, 1.0
    plan = grid_of_points(side, 0.025) / side - 0.5
    cell = np.repeat(np.arange(num), len(plan))
    offset = np.tile(plan, (num, 1))
    # Waves of every direction and of one to three metres.
    turn, phase = rng.uniform(0.0, 2.0 * np.pi, (2, num))
    length = rng.uniform(1.0, 3.0, num)
    along = offset[:, 0] * np.cos(turn)[cell] + offset[:, 1] * np.sin(turn)[cell]
    height = 0.15 * np.sin(2.0 * np.pi * along / length[cell] + phase[cell])
    true = np.bincount(cell, height) / len(plan)
    keep = offset[:, 0] < share - 0.5
    noise = 0.002 * rng.standard_normal(keep.sum())
    fits = fit_cells(
        CellPoints(cell[keep], offset[keep], height[keep] + noise, np.full(keep.sum(), 0.002)),
        side=side,
        pixel=0.025,
        correlated=LEAST_PX2,
    )
    covered = np.mean(np.abs(fits.height - true[fits.cell]) < 1.96 * fits.std)
    # 95 % of normal errors, and waves have others; without the bare part of the variance it is 39 and 45 %.
    assert covered > 0.85


def test_a_cell_that_is_covered_by_less_than_a_third_has_no_height():
    plan = grid_of_points(1.0, 0.025)
    offset = np.concatenate([plan, plan[plan[:, 0] < 0.25]]) - 0.5
    cell = np.repeat([0, 1], [len(plan), len(offset) - len(plan)])
    fits = fit_cells(
        CellPoints(cell, offset, np.zeros(len(cell)), np.full(len(cell), 0.01)),
        side=1.0,
        pixel=0.025,
        correlated=LEAST_PX2,
    )
    assert fits.cell.tolist() == [0]
