"""Cells and light of the maps of a report: means, tops, holes, hills lit from the north-west; columns in portions."""

import numpy as np
import pytest
from pyproj import CRS

from geo import shapes
from geo.grid import plan_box
from geo.shapes import ComputedColumn
from survey.display import plan_grid
from survey.display.plan_grid import PlanGrid, finite, median
from survey.report.maps import hillshade, without_pinholes

UTM = CRS("EPSG:25832+5778")


def _grid_of(points, crs=UTM, cell_m=1.0) -> PlanGrid:
    return PlanGrid.over(np.asarray(points, dtype=np.float64), crs, cell_m=cell_m, max_cells=1000)


@pytest.fixture(scope="module")
def block():
    """20 by 10 m in UTM; each square metre has 10 by 10 points in its north-western 0.81 by 0.81 m."""
    along = (np.arange(20)[:, None] + 0.09 * np.arange(10)).ravel()
    e, n = np.meshgrid(589000.0 + along, 5194710.0 - along[:100])
    return np.column_stack([e.ravel(), n.ravel(), np.zeros(e.size)])


def test_cells_hold_the_mean_of_their_points_from_north_to_south(block):
    grid = _grid_of(block)
    assert grid.shape == (10, 20)
    np.testing.assert_array_equal(grid.count(), np.full(grid.shape, 100))
    north, east = grid.mean(block[:, 1]), grid.mean(block[:, 0])
    np.testing.assert_allclose(north, np.tile(5194709.595 - np.arange(10)[:, None], (1, 20)), atol=1e-6)
    np.testing.assert_allclose(east, np.tile(589000.405 + np.arange(20), (10, 1)), atol=1e-6)
    assert grid.extent == pytest.approx((589000.0, 589020.0, 5194700.0, 5194710.0))


def test_the_highest_point_of_a_cell_is_on_top(block):
    rng = np.random.default_rng(3)
    height = rng.permutation(len(block)).astype(np.float64)
    grid = _grid_of(block)
    east, north = np.floor(block[:, 0] - 589000.0), np.floor(5194710.0 - block[:, 1])
    expected = [height[(20 * north + east) == cell].max() for cell in range(200)]
    np.testing.assert_array_equal(grid.highest(height, height).ravel(), expected)


def test_rasters_do_not_depend_on_how_many_points_are_looked_at_at_a_time(block, monkeypatch):
    rng = np.random.default_rng(4)
    # Whole heights, so that many points are as high as each other.
    shuffled, height = rng.permutation(block), rng.integers(0, 9, len(block)).astype(np.float64)
    number, wet = np.arange(len(block)), rng.random(len(block)) < 0.5
    grid = _grid_of(shuffled)

    def rasters():
        return grid.count(wet), grid.mean(height, wet), grid.highest(height, number), grid.covered_m2

    whole = rasters()
    monkeypatch.setattr(plan_grid, "_PORTION", 77)
    for found, expected in zip(rasters(), whole, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_the_covered_area_is_that_of_cells_with_points(block):
    grid = PlanGrid.within(block, *plan_box(block), 0.7)
    column, row = np.floor((block[:, 0] - grid.origin[0]) / 0.7), np.floor((grid.origin[1] - block[:, 1]) / 0.7)
    assert grid.covered_m2 == pytest.approx(0.49 * len(set(zip(column, row, strict=True))))


def test_values_that_are_nan_and_points_left_out_do_not_count(block):
    values = np.where(block[:, 0] < 589010.0, np.nan, 1.0)
    grid = _grid_of(block)
    mean = grid.mean(values, block[:, 1] <= 5194705.0)
    assert np.isnan(mean[:, :10]).all()
    assert np.isnan(mean[:5]).all()
    np.testing.assert_array_equal(mean[5:, 10:], 1.0)


def test_strays_do_not_shrink_the_picture(block):
    strays = np.array([[650000.0, 5194705.0, 0.0], [589010.0, 5100000.0, 0.0]])
    grid = _grid_of(np.vstack([block, strays]))
    # A twentieth more to the side where a stray lies, in each direction.
    assert grid.shape == (11, 21)
    assert grid.count().sum() == len(block)


def test_cells_grow_where_points_are_few_or_the_area_is_large(block):
    few = block[np.random.default_rng(2).choice(len(block), 100, replace=False)]
    # Three points a cell; the outermost of 100 points leave 2 % of each side uncovered.
    assert _grid_of(few).side_m == pytest.approx(np.sqrt(3.0 * 20.0 * 10.0 / 100), rel=0.05)
    fine = PlanGrid.over(block, UTM, cell_m=0.2, max_cells=50)
    assert max(fine.shape) == 50


def test_cells_in_degrees_are_square_on_the_ground():
    # 60 degrees north: a degree of longitude is half as long as one of latitude, and 0.17 % more on the ellipsoid.
    lon, lat = np.meshgrid(np.linspace(10.0, 10.002, 150), np.linspace(60.0, 60.001, 150))
    grid = _grid_of(np.column_stack([lon.ravel(), lat.ravel(), lat.ravel()]), CRS("EPSG:4979"), 5.0)
    assert -grid.step[0] / grid.step[1] == pytest.approx(2.0 / 1.00168, rel=1e-4)
    assert grid.shape == (23, 23)  # 0.001 degree is 111.4 m


def test_only_single_holes_are_closed_by_the_mean_around_them():
    raster = np.arange(49.0).reshape(7, 7)
    raster[1, 1] = raster[4:7, 4:7] = np.nan
    closed = without_pinholes(raster)
    assert closed[1, 1] == pytest.approx(8.0)  # the mean around a cell of a plane is its own value
    assert np.isnan(closed[5, 5])
    np.testing.assert_array_equal(closed[:4, 2:], raster[:4, 2:])


def test_light_comes_from_the_north_west():
    row, column = np.mgrid[0:30, 0:30].astype(np.float64)
    inner = (slice(5, -5), slice(5, -5))
    level = hillshade(np.zeros((30, 30)), 0.1)
    facing = hillshade(0.02 * (row + column), 0.1)  # rises to the south-east
    averted = hillshade(-0.02 * (row + column), 0.1)
    across = hillshade(0.02 * (row - column), 0.1)
    np.testing.assert_allclose(level, 0.5)
    assert facing[inner].min() > 0.6
    assert averted[inner].max() < 0.2
    # Light strikes such a slope at 60 degrees, not at 45: cos 60 degrees = 0.5.
    np.testing.assert_allclose(across[inner], 0.5 + 0.6 * (0.5 - np.sqrt(0.5)), atol=1e-6)


def test_unknown_cells_stay_unlit():
    height = np.random.default_rng(1).normal(size=(30, 30))
    height[:, 15:] = np.nan
    np.testing.assert_array_equal(hillshade(height, 0.1)[:, 15:], 0.5)


@pytest.fixture(autouse=True)
def small_portions(monkeypatch):
    monkeypatch.setattr(shapes, "_PORTION", 37)


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64, np.uint8, np.int64])
@pytest.mark.parametrize("count", [1, 2, 36, 37, 500])
def test_the_finite_values_are_those_of_the_whole(rng, kind, count):
    is_whole = np.dtype(kind).kind != "f"
    values = rng.integers(0, 200, count) if is_whole else rng.normal(0.0, 3.0, count)
    values, mask = values.astype(kind), rng.random(count) < 0.9
    if not is_whole and count > 36:
        values[::7], values[3], values[5], values[10] = np.nan, -np.inf, 0.0, -0.0
    known = np.isfinite(values)
    np.testing.assert_array_equal(finite(values), values[known])
    np.testing.assert_array_equal(finite(values, mask), values[known & mask])
    assert finite(values).dtype in (np.float32, np.float64)
    # float32 has steps of 6e-8.
    assert median(values) == pytest.approx(np.median(values[known].astype(np.float64)), rel=1e-7)


def test_a_column_may_hold_nothing_that_counts():
    assert not len(finite(np.array([np.nan, np.inf], dtype=np.float32)))
    assert np.isnan(median(np.zeros(0, dtype=np.float32)))


def test_a_computed_column_has_the_values_of_its_function(rng):
    east, north = rng.normal(size=(2, 200))
    column_of_both, both = ComputedColumn(np.hypot, east, north), np.hypot(east, north)
    assert len(column_of_both) == 200
    np.testing.assert_array_equal(column_of_both[[7, 150]], both[[7, 150]])
    np.testing.assert_array_equal(finite(column_of_both, east > 0.0), both[east > 0.0])
    assert median(column_of_both, east > 0.0) == np.median(both[east > 0.0])
