"""Products for hydrographic offices: BAG as its readers see it, and orders of IHO S-44 by stated uncertainty."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
import rasterio
from gdal_programs import gdalinfo, needs_gdal
from pyproj import CRS
from stored_run import run_of, stored_points

from evaluation.standards import THU, TVU, order_by_thu, order_by_tvu
from survey.errors import SurveyError
from survey.export.export import export
from survey.export.registry import ExportOptions
from survey.run.folder import RunDir
from survey.settings.config import CamerasConfig, SurveyConfig, WaterConfig, dump_config

# More than one window of the writer, and no whole number of the chunks of BAG.
FINE = ExportOptions(resolution_m=0.025)
LEVEL = 500.0


@pytest.fixture(scope="module")
def both(run_folder, tmp_path_factory) -> tuple[Path, Path]:
    """A BAG, and a DEM of the same cells."""
    folder = tmp_path_factory.mktemp("bag")
    return tuple(export(run_folder, options=FINE, bag=folder / "bed.bag", dem=folder / "bed.tif")[::-1])


def test_a_bag_has_elevation_uncertainty_tracking_list_and_metadata(both, stored):
    bag, dem = both
    with rasterio.open(dem) as raster:
        height, std = raster.read([1, 2], masked=True)
        assert (raster.read(3, masked=True).compressed() == 0.0).all()
        west, south, _, _ = raster.bounds
        side = raster.transform.a
    with h5py.File(bag) as file:
        root = file["BAG_root"]
        assert root.attrs["Bag Version"].decode().startswith("1.")
        # Rows of BAG run from south to north.
        np.testing.assert_array_equal(root["elevation"][()][::-1], height.filled(1e6))
        np.testing.assert_array_equal(root["uncertainty"][()][::-1], std.filled(1e6))
        assert root["elevation"].attrs["Minimum Elevation Value"] == height.min()
        assert root["uncertainty"].attrs["Maximum Uncertainty Value"] == std.max()
        assert root["tracking_list"].attrs["Tracking List Length"] == 0
        xml = b"".join(root["metadata"][:]).decode()
    tree = ElementTree.fromstring(xml)
    texts = [node.text or "" for node in tree.iter()]
    abstract = next(text for text in texts if "made by bathynerf" in text)
    # The name has letters that XML must not have as they are.
    assert abstract.startswith(f"{stored.name}: bed of shallow water")
    assert "one standard deviation" in abstract
    corner = next(text for text in texts if "," in text and text.count(" ") == 1 and text[0].isdigit())
    # That of the south-western node, in the middle of its cell.
    np.testing.assert_allclose([float(v) for v in corner.split()[0].split(",")], [west + side / 2, south + side / 2])
    assert any('"EPSG","25832"' in text for text in texts)
    vertical = stored.crs.sub_crs_list[1]
    assert any(text.startswith(f'VERT_CS["{vertical.name}"') for text in texts)


@needs_gdal
def test_gdal_opens_a_bag_at_its_place(both, stored):
    bag, dem = both
    found, expected = gdalinfo(bag), gdalinfo(dem)
    assert found["driverShortName"] == "BAG"
    assert found["geoTransform"] == pytest.approx(expected["geoTransform"])
    assert [band["description"] for band in found["bands"]] == ["elevation", "uncertainty"]
    for part in stored.crs.sub_crs_list:
        assert f'ID["EPSG",{part.to_epsg()}]' in found["coordinateSystem"]["wkt"]


def test_a_bag_in_degrees_is_refused(run_folder, tmp_path):
    with pytest.raises(SurveyError, match=r"--bag holds square cells and heights in metres, but .*give --crs"):
        export(run_folder, options=ExportOptions(crs="EPSG:4326"), bag=tmp_path / "bed.bag")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("depth", [0.5, 2.0, 10.0, 40.0])
def test_orders_change_where_the_standard_says(depth):
    for table, order_by, factor, limit in (
        (TVU, order_by_tvu, 1.96, lambda a, b: np.hypot(a, b * depth)),
        (THU, order_by_thu, 2.448, lambda a, b: a + b * depth),
    ):
        for number, (_, a, b) in enumerate(table, start=1):
            assert order_by(np.array(0.999 * limit(a, b) / factor), np.array(depth)) == number
            assert order_by(np.array(1.001 * limit(a, b) / factor), np.array(depth)) == number + 1
    assert list(order_by_tvu(np.array([0.01, np.nan, 0.01]), np.array([-1.0, depth, np.nan]))) == [0, 0, 0]


def stepped_run(tmp_path: Path, *, position_std_m: float | None = None) -> Path:
    """A run over a bed 2 m deep whose east is dry, and whose points are worse known from west to east."""
    along = np.arange(0.01, 10.0, 0.1)
    plan = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    height = LEVEL - 2.0 + 2.5 * (plan[:, 0] > 8.0)
    points = np.column_stack([plan + np.array([691000.0, 5334000.0]), height])
    std = np.select([plan[:, 0] < 2.0, plan[:, 0] < 4.0, plan[:, 0] < 6.0], [0.05, 0.2, 0.6], 1.5)
    path = run_of(stored_points(points, CRS("EPSG:25832+5783"), std_m=std, level_m=LEVEL), tmp_path / "run")
    config = SurveyConfig(
        crs="EPSG:25832+5783",
        water=WaterConfig(level_m=LEVEL, refractive_index=1.333),
        cameras=CamerasConfig(position_std_m=position_std_m),
    )
    RunDir(path).settings_path.write_text(dump_config(config))
    return path


def orders_of(path: Path) -> tuple[np.ndarray, dict]:
    with rasterio.open(path) as raster:
        assert (raster.dtypes, raster.nodata) == (("uint8",) * 3, 0)
        return raster.read(), raster.tags()


def test_orders_of_cells_follow_their_uncertainty_and_dry_ground_has_none(tmp_path):
    export(stepped_run(tmp_path), options=ExportOptions(resolution_m=0.1), s44=tmp_path / "s44.tif")
    orders, tags = orders_of(tmp_path / "s44.tif")
    # One point in each cell of a tenth of a metre: 95 % of 0.05 m is within 0.15 m, and so on; walls are less sure.
    assert [int(np.median(orders[1][:, column])) for column in (5, 30, 50, 70, 95)] == [1, 3, 5, 5, 0]
    assert (orders[2][:, :70] == 1).all()
    np.testing.assert_array_equal(orders[0], np.maximum(orders[1], orders[2]))
    assert "feature detection" in tags["NOT_TESTED"]
    assert "taken as exact" in tags["UNCERTAINTIES"]


def test_positions_that_are_badly_known_cost_the_horizontal_order(tmp_path):
    export(stepped_run(tmp_path, position_std_m=0.6), options=ExportOptions(resolution_m=0.1), s44=tmp_path / "s44.tif")
    orders, tags = orders_of(tmp_path / "s44.tif")
    # 2.45 times 0.6 m is more than 1 m and less than 2 m.
    assert (orders[2][:, :70] == 2).all()
    assert orders[0][50, 5] == 2
    assert "included" in tags["UNCERTAINTIES"]


def test_a_dry_survey_has_no_order(tmp_path):
    points = np.array([691000.0, 5334000.0, 500.0]) + np.random.default_rng(1).uniform(0.0, 2.0, (400, 3))
    path = run_of(stored_points(points, CRS("EPSG:25832+5783")), tmp_path / "run")
    RunDir(path).settings_path.write_text(dump_config(SurveyConfig(crs="EPSG:25832+5783")))
    with pytest.raises(SurveyError, match="--s44 judges what lies under water, but the survey is dry"):
        export(path, s44=tmp_path / "s44.tif")
