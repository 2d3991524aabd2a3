"""Water by points and rasters of its surface, and whether one plane is enough."""

import re

import numpy as np
import pytest

from geo.crs import parse_crs
from geo.errors import GeoError
from geo.frames import LocalFrame
from geo.raster import RasterBand, RasterForm, write_cog
from refract import FlatWater
from survey.errors import ConfigError
from survey.settings.config import parse_config
from survey.water.level import with_level
from survey.water.level_observation import points_of_surface
from survey.water.surface import Departure, departure_of, plane_warning

CRS = parse_crs("EPSG:25832+5778")
E0, N0, LEVEL = 589012.0, 5194736.0, 2105.0
PLANE = FlatWater((0.0, 0.0, 2.0), n_water=1.333, slope_x=0.002)


def riffle(xy):
    """Over the plane [m]: a fall by 20 cm within 10 m."""
    return -0.1 * np.tanh(xy[:, 0] / 3.0)


def grid(step, half_x=20.0, half_y=6.0):
    x, y = np.arange(-half_x, half_x + 0.1, step), np.arange(-half_y, half_y + 0.1, step)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


PLACES = grid(0.7, 16.0, 4.0)


def departure(xy, heights, std):
    return Departure(np.column_stack([xy, heights]), np.full(len(xy), std))


def test_a_raster_is_met_to_a_millimetre():
    # What second order leaves of the third derivative, 7 mm/m3, over the half metre to 12 points.
    found, _ = departure(grid(1.0), riffle(grid(1.0)), 0.002).at(PLACES)
    assert np.abs(found - riffle(PLACES)).max() < 2e-3


def test_points_with_noise_are_met_within_their_std(rng):
    xy = rng.uniform((-20.0, -6.0), (20.0, 6.0), (150, 2))
    found, std = departure(xy, riffle(xy) + 0.02 * rng.normal(size=150), 0.02).at(PLACES)
    off = found - riffle(PLACES)
    assert np.std(off) < 0.01
    # They are half noise and half curvature: neither far below nor far above what is stated.
    assert 0.5 < np.sqrt(np.mean((off / std) ** 2)) < 2.0


def test_a_line_of_levels_is_level_across(rng):
    xy = np.column_stack([np.linspace(-20.0, 20.0, 60), 0.2 * rng.normal(size=60)])
    line = departure(xy, riffle(xy) + 0.005 * rng.normal(size=60), 0.005)
    across = np.column_stack([np.full(9, -2.0), np.linspace(-5.0, 5.0, 9)])
    # Free slopes across it would be 0.1 off at 5 m: the points lie 0.2 m about the line, and are good to 5 mm.
    assert np.abs(line.at(across)[0] - riffle(across)).max() < 0.03


def test_points_on_a_plane_depart_from_it_by_less_than_their_noise(rng):
    xy = rng.uniform((-20.0, -6.0), (20.0, 6.0), (100, 2))
    found, std = departure(xy, 0.02 * rng.normal(size=100), 0.02).at(PLACES)
    assert np.abs(found).max() < 0.015
    assert std.max() < 0.01


def test_beyond_the_points_the_water_does_not_run_away(rng):
    xy = grid(1.0)
    far = np.array([[200.0, 0.0], [-200.0, 80.0]])
    assert np.abs(departure(xy, riffle(xy), 0.002).at(far)[0]).max() < 0.15


def test_beyond_a_rectangle_it_is_as_high_as_at_its_edge():
    water = departure(grid(1.0), riffle(grid(1.0)), 0.002)
    height = water.interpolated((-10.0, -4.0, 10.0, 4.0))
    beyond = np.array([[-90.0, 0.0], [60.0, 2.0], [5.0, -70.0]])
    # As high as three nodes beyond the rectangle, to where its raster goes.
    assert height(beyond) == pytest.approx(height(np.array([[-13.0, 0.0], [13.0, 2.0], [5.0, -7.0]])), abs=1e-3)
    assert np.abs(height(beyond)).max() > 0.09


def test_the_tangent_of_a_part_has_its_level_and_slope():
    xy = grid(1.0)
    tangent = departure(xy, riffle(xy), 0.002).tangent(grid(0.5, 1.0, 1.0), PLANE)
    # In the middle of the riffle, where it falls by 0.1 / 3 in a metre, less what it bends within one.
    assert tangent.slope_x == pytest.approx(0.002 - 0.1 / 3.0, abs=2e-3)
    assert float(tangent.height(0.0, 0.0)) == pytest.approx(2.0, abs=1e-3)
    assert tangent.n_water == PLANE.n_water


def test_water_over_another_plane_is_the_same_water():
    xy = grid(1.0)
    first = departure(xy, riffle(xy), 0.002)
    other = FlatWater((1.0, 2.0, 1.9), n_water=1.333, slope_x=-0.01, slope_y=0.003)
    second = first.over(PLANE, other)
    area = (-5.0, -3.0, 5.0, 3.0)
    places = (0.2 * PLACES[:40]).T
    one, two = first.surface(area, PLANE), second.surface(area, other)
    np.testing.assert_allclose(one.height(*places), two.height(*places), atol=1e-4)


def raster(path, crs, unit="metre"):
    """A GeoTIFF of cells of 1 m whose heights are LEVEL, a millimetre more for each metre east."""
    columns = np.arange(12) + 0.5
    heights = np.broadcast_to(LEVEL + 1e-3 * columns, (5, 12))
    form = RasterForm(crs, (1.0, 0.0, E0, 0.0, -1.0, N0), (5, 12), (RasterBand("water", unit),), dtype="float64")
    write_cog(path, form, [(0, 0, heights[None])])


def test_a_raster_gives_the_middles_of_its_cells(tmp_path):
    raster(tmp_path / "water.tif", CRS)
    found, _ = points_of_surface(tmp_path / "water.tif", "surface", CRS)
    assert len(found) == 60
    for level in found:
        assert level.level_m == pytest.approx(LEVEL + 1e-3 * (level.place[0] - E0), abs=1e-6)


def test_a_raster_in_another_datum_of_heights_is_refused(tmp_path):
    raster(tmp_path / "water.tif", parse_crs("EPSG:25832+7837"))
    with pytest.raises(GeoError, match=r"heights of water\.tif are above"):
        points_of_surface(tmp_path / "water.tif", "surface", CRS)


def test_points_of_a_file_are_over_the_plane(tmp_path):
    raster(tmp_path / "water.tif", CRS)
    levels, _ = points_of_surface(tmp_path / "water.tif", "surface", CRS)
    frame = LocalFrame(CRS, (E0, N0, LEVEL))
    found = Departure.of(levels, frame, FlatWater((0.0, 0.0, 0.0), n_water=1.333))
    assert found.points[:, 2].max() == pytest.approx(11.5e-3, abs=2e-4)
    assert Departure.of((), frame, FlatWater((0.0, 0.0, 0.0), n_water=1.333)) is None


def test_points_at_one_place_are_no_surface(tmp_path):
    rows = [f"{E0 + 0.01 * i:.3f},{N0:.3f},{LEVEL + 0.001 * i:.3f}" for i in range(5)]
    (tmp_path / "points.csv").write_text("\n".join(["easting,northing,height", *rows]))
    config = parse_config('crs = "EPSG:25832+5778"\n[water]\nsurface = "points.csv"')
    with pytest.raises(ConfigError, match="5 points of the water surface within 4 cm of each other, expected points"):
        with_level(tmp_path, config, {}, CRS)


@pytest.mark.parametrize("key", ["slope_east = 0.01", "level_at = [1.0, 2.0]"])
def test_a_surface_has_its_slopes_itself(key):
    with pytest.raises(ConfigError, match="surface gives the level everywhere"):
        parse_config(f'crs = "EPSG:25832+5778"\n[water]\nsurface = "water.tif"\n{key}\n')


def test_a_surface_and_a_level_contradict_each_other():
    with pytest.raises(ConfigError, match="level_m and surface"):
        parse_config('crs = "EPSG:25832+5778"\n[water]\nsurface = "water.tif"\nlevel_m = 3.0\n')


def points(rng, shape, *, count=80, std=0.02, length=40.0, width=10.0, wrong=0.0):
    xy = rng.uniform((-0.5 * length, -0.5 * width), (0.5 * length, 0.5 * width), (count, 2))
    noise = rng.normal(size=count) * np.where(rng.random(count) < wrong, 10.0, 1.0)
    return np.column_stack([xy, shape(xy[:, 0]) + xy @ rng.normal(0.0, 0.003, 2) + std * noise])


def small_riffle(x):
    return -0.1 * np.tanh(x / 3.0)


def flat_(x):
    return 0.0 * x


def test_a_riffle_is_found_as_large_as_it_is(rng):
    found = departure_of(points(rng, small_riffle), np.full(80, 0.02))
    x = np.linspace(-20.0, 20.0, 401)
    rest = small_riffle(x) - np.polyval(np.polyfit(x, small_riffle(x), 1), x)
    # Polynomials of fifth order leave a fifth of it.
    assert found == pytest.approx(np.std(rest), rel=0.3)


def test_the_warning_has_what_the_bed_moves(rng):
    said = plane_warning(points(rng, small_riffle), np.full(80, 0.02), 0.016, "gnss_points")
    assert said is not None
    assert "one plane is not enough" in said
    assert re.search(r"gnss_points depart from it by [2-4]\d\.\d.mm", said)


def test_a_departure_within_the_std_of_the_level_is_not_said(rng):
    assert plane_warning(points(rng, small_riffle), np.full(80, 0.02), 0.06, "gnss_points") is None


@pytest.mark.parametrize("places", [1, 2, 3, 5])
def test_readings_at_a_few_stakes_are_one_plane(rng, places):
    xy = np.repeat(rng.uniform(-20.0, 20.0, (places, 2)), 24 // places, axis=0)
    readings = np.column_stack([xy, 0.02 * rng.normal(size=len(xy))])
    assert departure_of(readings, np.full(len(xy), 0.02)) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("width", [0.5, 10.0])
@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_scatter_hardly_ever_gives_an_alarm(rng, width, wrong):
    # 1 of 600 with scatter that is stated two times too small or too large.
    alarms = 0
    for _ in range(60):
        count = int(rng.integers(16, 150))
        drawn = points(rng, flat_, count=count, std=rng.choice([0.01, 0.02, 0.05]), width=width, wrong=wrong)
        alarms += plane_warning(drawn, np.full(count, 0.02), np.hypot(0.015, 0.03 / np.sqrt(count)), "x") is not None
    assert alarms <= 1


def test_few_points_tell_nothing(rng):
    assert departure_of(points(rng, small_riffle, count=15), np.full(15, 0.02)) == pytest.approx(0.0, abs=1e-9)


def test_a_line_of_levels_is_judged_along_itself(rng):
    assert departure_of(points(rng, small_riffle, width=0.1, std=0.01), np.full(80, 0.01)) == pytest.approx(
        0.04, rel=0.5
    )
