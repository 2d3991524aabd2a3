"""[control] reference: which points of an earlier survey hold a block, in whose unit and crs, and how well."""

import json
from dataclasses import replace
from functools import partial

import laspy
import numpy as np
import pytest
from pyproj import CRS, Transformer

from geo import LocalFrame, parse_crs
from geo.crs import horizontal_crs
from geo.transformation import lon_lat
from survey.errors import ConfigError, ControlError
from survey.folder.control import read_ground
from survey.folder.local_frame import water_plane
from survey.settings.config import SurveyConfig, WaterConfig
from survey.settings.tables import ControlConfig
from survey.water.surface import Departure, height_above

CRS_OF_SURVEY, ORIGIN = "EPSG:25832+5778", (500000.0, 5200000.0, 100.0)
# Local; the bank rises to the east, and the water is at 0.
GROUND = np.stack([*np.meshgrid(np.linspace(-20.0, 20.0, 41), np.linspace(-20.0, 20.0, 41)), np.zeros((41, 41))], -1)
GROUND = GROUND.reshape(-1, 3) + np.array([0.0, 0.0, 1.0]) * 0.1 * GROUND.reshape(-1, 3)[:, :1]
PLACES = np.array([[-10.1, -10.1, 30.0], [10.1, 10.1, 30.0], [0.0, 0.0, 0.0]])


def read(
    folder, *, crs: str | None = CRS_OF_SURVEY, unit_m: float = 1.0, classes=None, extra=None, departure=None, **control
):
    """The ground of a LAS file with these points."""
    frame = LocalFrame(parse_crs(CRS_OF_SURVEY), ORIGIN)
    points = frame.crs_from_local(GROUND)
    if crs is not None:
        horizontal = horizontal_crs(CRS(crs))
        points[:, :2] = np.transpose(Transformer.from_crs(25832, horizontal).transform(*points.T[:2]))
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [1e-4] * 3, np.floor(points.min(axis=0))
    if crs is not None:
        header.add_crs(CRS(crs))
    for name in extra or {}:
        header.add_extra_dim(laspy.ExtraBytesParams(name, np.float32))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points[:, 0], points[:, 1], points[:, 2] / unit_m
    cloud.classification = np.full(len(points), 2, np.uint8) if classes is None else classes
    for name, values in (extra or {}).items():
        cloud[name] = values
    cloud.write(folder / "earlier.las")
    water = WaterConfig(level_m=100.0, level_at=ORIGIN[:2], refractive_index=1.333)
    config = SurveyConfig(crs=CRS_OF_SURVEY, water=water, control=ControlConfig(reference="earlier.las", **control))
    above_water = partial(height_above, water_plane(frame, water), departure)
    return read_ground(folder, config, frame, PLACES, above_water, is_level_known=True)


def test_dry_ground_near_the_photographs_counts_and_its_accuracy_is_asked_for(tmp_path):
    ground, said = read(tmp_path)
    kept = GROUND[(GROUND[:, 2] > 0.1) & (np.abs(GROUND[:, :2]) <= 15.1).all(axis=1)]
    assert len(ground.points) == len(kept)
    assert np.abs(ground.points - kept).max() < 1e-3
    assert ground.std_m == (0.1, 0.1)
    assert "reference_std_m" in said.warnings[0]


def test_what_a_cloud_of_process_carries_says_how_well_it_is_known(tmp_path):
    ground, said = read(tmp_path, extra={"std_common": np.full(len(GROUND), 0.03)})
    assert ground.std_m == pytest.approx((0.03, 0.03))
    assert said.warnings == ()
    assert read(tmp_path, reference_std_m=(0.2, 0.05))[0].std_m == (0.2, 0.05)


def test_points_that_are_not_of_the_ground_are_left_out_by_name(tmp_path):
    classes = np.where(GROUND[:, 1] > 0.0, 7, 2).astype(np.uint8)
    ground, said = read(tmp_path, classes=classes)
    assert ground.points[:, 1].max() <= 0.01
    assert "class 7" in " ".join(said.assumptions)


def test_a_reference_in_another_crs_is_taken_into_that_of_the_survey(tmp_path):
    there, here = read(tmp_path, crs="EPSG:25833+5778")[0], read(tmp_path)[0]
    assert len(there.points) == len(here.points)
    assert np.abs(there.points - here.points).max() < 1e-3


def test_a_reference_in_another_crs_without_heights_has_those_of_the_survey(tmp_path):
    (there, said), here = read(tmp_path, crs="EPSG:25833"), read(tmp_path)[0]
    assert np.abs(there.points - here.points).max() < 1e-3
    assert "what its heights count from" in " ".join(said.assumptions)


def test_water_over_its_plane_makes_ground_wet(tmp_path):
    xy = np.array([(x, y) for x in np.linspace(-25.0, 25.0, 6) for y in np.linspace(-25.0, 25.0, 6)])
    higher = Departure(np.column_stack([xy, np.full(len(xy), 0.5)]), np.full(len(xy), 0.01))
    assert read(tmp_path, departure=higher)[0].points[:, 2].min() > 0.55
    assert read(tmp_path)[0].points[:, 2].min() < 0.2


def test_polygons_say_which_ground_is_stable(tmp_path):
    frame = LocalFrame(parse_crs(CRS_OF_SURVEY), ORIGIN)
    ring = frame.crs_from_local(np.array([[2.5, -8, 0], [12.5, -8, 0], [12.5, 3.5, 0], [2.5, 3.5, 0], [2.5, -8, 0.0]]))
    corners = lon_lat(frame.crs, ring)[:, :2].tolist()
    (tmp_path / "stable.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [corners]}))
    ground, _ = read(tmp_path, stable="stable.geojson")
    low, high = ground.points.min(axis=0), ground.points.max(axis=0)
    assert (low[:2] > (2.4, -8.2)).all()
    assert (high[:2] < (12.6, 3.6)).all()
    assert len(ground.points) == pytest.approx(10 * 12, abs=15)
    far = [[10.0, 50.0], [10.1, 50.0], [10.1, 50.1], [10.0, 50.0]]
    (tmp_path / "stable.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [far]}))
    with pytest.raises(ControlError, match="polygons"):
        read(tmp_path, stable="stable.geojson")


def test_without_dry_ground_or_a_level_it_is_refused(tmp_path):
    with pytest.raises(ControlError, match="0 points of dry ground"):
        read(tmp_path, crs=None, unit_m=2.0)
    with pytest.raises(ConfigError, match="stable is given without reference"):
        ControlConfig(stable="stable.geojson")
    frame = LocalFrame(parse_crs(CRS_OF_SURVEY), ORIGIN)
    config = SurveyConfig(crs=CRS_OF_SURVEY, control=ControlConfig(reference="earlier.las"))
    water = water_plane(frame, WaterConfig(level_m=100.0, level_at=ORIGIN[:2], refractive_index=1.333))
    with pytest.raises(ControlError, match="nothing tells which ground"):
        read_ground(tmp_path, config, frame, PLACES, partial(height_above, water, None), is_level_known=False)
    config = replace(config, control=ControlConfig())
    assert read_ground(tmp_path, config, frame, PLACES, None, is_level_known=True)[0] is None
