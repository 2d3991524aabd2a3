"""Places on the water beside the cameras: in another order, of another water, on no map."""

import numpy as np
import pytest
from pyproj import CRS, Transformer
from small_survey import E0, LEVEL, N0, replaced, small_survey

from geo.crs import parse_crs
from survey.errors import ConfigError
from survey.folder.survey import load_survey
from survey.settings.config import WaterConfig
from survey.water.level_observation import DOUBTFUL_M, FARTHEST_M, LevelObservation, water_place_warnings

SYSTEMS = {
    "EPSG:25832+5778": (11.4, 47.2),
    "EPSG:32733+3855": (15.2, -22.9),
    "EPSG:2264+6360": (-79.0, 35.5),  # US survey feet
    "EPSG:4326+5773": (11.4, 47.2),
    "EPSG:2193+7839": (175.0, -40.0),
    "EPSG:3832+3855": (179.99, -17.0),  # beside the antimeridian
}
SOURCES = ("level_at", "shoreline", "gnss_points")


def place_of(code, km_east=0.0, km_north=0.0):
    """The place of a system in its crs, moved by kilometres."""
    lon, lat = SYSTEMS[code]
    lat += km_north / 111.2
    lon += km_east / (111.2 * np.cos(np.radians(lat)))
    return Transformer.from_crs(4326, CRS(code).sub_crs_list[0], always_xy=True).transform(lon, lat)


def doubts(code, source, *places):
    levels = [
        LevelObservation(1.0, 0.02, place, None, "level_m" if source == "level_at" else source) for place in places
    ]
    cameras = np.array([SYSTEMS[code], np.array(SYSTEMS[code]) + 1e-4, [np.nan, np.nan]])
    return water_place_warnings(parse_crs(code), cameras, WaterConfig(level_m=1.0), levels)


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("code", SYSTEMS)
def test_places_near_the_cameras_are_taken_and_others_named(code, source):
    near = place_of(code, 0.2, -0.3)
    assert doubts(code, source, near, near) == []
    (said,) = doubts(code, source, near, place_of(code, 0.0, 5.0))
    assert f"[water] {source}: 1 of 2 places lie more than {DOUBTFUL_M / 1e3:g} km" in said
    assert "5 km" in said
    with pytest.raises(ConfigError, match=rf"\[water\] {source} has a place at .*, which lies 40 km from the nearest"):
        doubts(code, source, near, place_of(code, 0.0, -40.0))


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("code", SYSTEMS)
def test_northing_first_is_refused_with_the_order_that_was_meant(code, source):
    swapped = [place_of(code, k, 0.0)[::-1] for k in (0.0, 0.1, 0.2)]
    with pytest.raises(ConfigError, match=r"near the cameras as .*: give easting \(or longitude\) first"):
        doubts(code, source, *swapped)


def test_clicks_gauges_and_surveys_without_places_pass():
    far = LevelObservation(1.0, 0.02, place_of("EPSG:25832+5778", 900.0), None, "clicks")
    gauge = LevelObservation(1.0, 0.02, None, None, "gauge")
    crs, cameras = parse_crs("EPSG:25832+5778"), np.array([[11.4, 47.2]])
    assert water_place_warnings(crs, cameras, WaterConfig(level_m=1.0), [far, gauge]) == []
    assert water_place_warnings(crs, np.zeros((0, 2)), WaterConfig(level_m=1.0), []) == []
    assert water_place_warnings(crs, cameras, None, []) == []


@pytest.mark.parametrize("order", ["", "swapped"])
@pytest.mark.parametrize("key", ["level_at", "shoreline"])
def test_a_survey_says_where_its_water_lies(tmp_path, key, order):
    east, north = (N0, E0) if order else (E0 + 2.0 * FARTHEST_M, N0)
    if key == "level_at":
        toml = replaced((f"level_at = [{E0}, {N0}]", f"level_at = [{east}, {north}]"))
    else:
        toml = replaced((f"level_m = {LEVEL}", 'shoreline = "w.csv"'))
    folder = small_survey(tmp_path / "s", toml=toml)
    lines = ["easting,northing,height", *(f"{east + k},{north + k * k},{LEVEL}" for k in range(3))]
    (folder / "w.csv").write_text("\n".join(lines))
    with pytest.raises(ConfigError, match="give easting" if order else "40 km from the nearest camera") as refused:
        load_survey(folder)
    assert f"[water] {key}" in str(refused.value)
