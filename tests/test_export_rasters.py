"""Rasters of the bed as readers other than their writer see them: DEM, BAG, orders of IHO S-44."""

import json
import zlib
from pathlib import Path
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
import rasterio
import tifffile
from gdal_programs import gdalinfo, needs_gdal
from pyproj import CRS
from rio_cogeo.cogeo import cog_validate
from slow_cases import slow
from stored_run import run_of, stored_points

from evaluation.standards import THU, TVU, order_by_thu, order_by_tvu
from geo import write_cloud
from geo.errors import UnwritableFile
from geo.raster import RasterBand, RasterForm, write_cog
from survey.errors import SurveyError
from survey.export.export import export
from survey.export.registry import PRODUCTS, ExportOptions
from survey.export.styles import of_clouds
from survey.progress import Progress
from survey.run.folder import RunDir
from survey.settings.config import CamerasConfig, SurveyConfig, WaterConfig, dump_config, parse_config

SIDE = 0.5
AT_SIDE = ExportOptions(resolution_m=SIDE)


@pytest.fixture(scope="module")
def dem(run_folder, tmp_path_factory) -> Path:
    (path,) = export(run_folder, options=AT_SIDE, dem=tmp_path_factory.mktemp("dem") / "dem.tif")
    return path


def by_hand(page: tifffile.TiffPage) -> np.ndarray:
    """Values (rows, columns, bands) of a page of one tile: bytes of the same weight side by side, each a difference."""
    assert (page.compression, page.predictor, page.dtype) == (8, 3, np.float32)
    page.parent.filehandle.seek(page.dataoffsets[0])
    packed = page.parent.filehandle.read(page.databytecounts[0])
    rows, columns, bands = page.tilelength, page.tilewidth, page.samplesperpixel
    steps = np.frombuffer(zlib.decompress(packed), dtype=np.uint8).reshape(rows, -1, bands)
    planes = np.cumsum(steps, axis=1, dtype=np.uint8).reshape(rows, 4, columns * bands)
    values = np.ascontiguousarray(planes.transpose(0, 2, 1)).view(">f4").reshape(rows, columns, bands)
    return values[: page.imagelength, : page.imagewidth]


def middles(raster) -> np.ndarray:
    """Coordinates (rows, columns, 2) of the middles of the cells of an open raster."""
    columns, rows = np.meshgrid(np.arange(raster.width) + 0.5, np.arange(raster.height) + 0.5)
    t = raster.transform
    return np.stack([t.c + t.a * columns, t.f + t.e * rows], axis=-1)


def test_a_dem_has_heights_uncertainty_points_and_depths(stored, dem):
    with rasterio.open(dem) as raster:
        height, std, common, count, depth, origin = raster.read(masked=True)
        place = middles(raster)
        assert raster.descriptions[0] == "height"
        assert raster.units == ("metre", "metre", "metre", "count", "metre", "code")
    # The plane of the bed, through its points.
    points, bed = stored.points_crs, stored.bed
    columns = np.column_stack([points[:, :2] - points[0, :2], np.ones(len(points))])
    known = count.data > 12
    for values, found, tolerance in ((points[:, 2], height, 2e-4), (bed.depth, depth, 2e-4)):
        plane, *_ = np.linalg.lstsq(columns, values, rcond=None)
        expected = np.concatenate([place - points[0, :2], np.ones((*place.shape[:2], 1))], axis=-1) @ plane
        np.testing.assert_allclose(found[known], expected[known], atol=tolerance)
    assert count.sum() == len(points)
    np.testing.assert_array_equal(origin, count > 0)
    np.testing.assert_array_equal(height.mask, count.data == 0)
    assert (common.compressed() == 0.0).all()
    # Of points 10 cm apart, seen by pixels of 2 cm, none is near another: 25 of them count as 1 + 25 / 15.
    whole = count.data == 25
    assert whole.sum() > 500
    assert 0.5 * 0.005 < std[whole].min() < std[whole].max() < 0.015


def test_it_is_a_cloud_optimised_geotiff_that_other_readers_read(dem, stored):
    valid, errors, warnings = cog_validate(dem, strict=True)
    assert (valid, errors, warnings) == (True, [], [])
    with tifffile.TiffFile(dem) as tiff:
        page = tiff.pages[0]
        assert page.is_tiled
        assert page.tags["Software"].value.startswith("bathynerf")
        assert page.tags["GDAL_NODATA"].value == "-9999"
        values = by_hand(page)
    with rasterio.open(dem) as raster:
        np.testing.assert_array_equal(values, np.moveaxis(raster.read(), 0, -1))
        found = CRS.from_wkt(raster.crs.to_wkt())
    assert [part.to_epsg() for part in found.sub_crs_list] == [part.to_epsg() for part in stored.crs.sub_crs_list]


def test_the_cells_of_an_overview_are_cells_of_the_raster(tmp_path, stored):
    run = run_of(stored, tmp_path / "run")
    (path,) = export(run, options=ExportOptions(resolution_m=0.025, fill_m=0.05), dem=tmp_path / "fine.tif")
    with rasterio.open(path) as raster:
        whole, step = raster.read(), raster.overviews(1)[0]
    with rasterio.open(path, overview_level=0) as raster:
        few = raster.read()
    assert set(np.unique(few[5])) <= {0.0, 1.0, 2.0}
    assert step == 2
    rows, columns = (2 * np.arange(length) for length in few.shape[1:])
    # Which of the four cells it is, is GDAL's choice: all bands have the same one.
    options = [whole[:, rows.clip(0, whole.shape[1] - 2) + i][:, :, columns.clip(0, whole.shape[2] - 2) + j]
               for i in (0, 1) for j in (0, 1)]  # fmt: skip
    assert np.any([(few == option).all(axis=0) for option in options], axis=0).all()


@needs_gdal
def test_gdal_finds_the_crs_and_the_place(dem, stored):
    found = gdalinfo(dem)
    wkt = found["coordinateSystem"]["wkt"]
    for part in stored.crs.sub_crs_list:
        assert f'ID["EPSG",{part.to_epsg()}]' in wkt
    (west, south), (east, north) = stored.points_crs[:, :2].min(axis=0), stored.points_crs[:, :2].max(axis=0)
    corners = found["cornerCoordinates"]
    assert west - SIDE < corners["upperLeft"][0] <= west
    assert east <= corners["lowerRight"][0] < east + SIDE
    assert south - SIDE < corners["lowerRight"][1] <= south
    assert north <= corners["upperLeft"][1] < north + SIDE
    assert found["metadata"]["IMAGE_STRUCTURE"]["LAYOUT"] == "COG"


def test_depths_of_a_dry_survey_are_no_data(tmp_path):
    points = np.array([691000.0, 5334000.0, 500.0]) + np.random.default_rng(2).uniform(0.0, 2.0, (400, 3)) * [1, 1, 0]
    run = run_of(stored_points(points, CRS("EPSG:25832+5783")), tmp_path / "run")
    export(run, options=AT_SIDE, dem=tmp_path / "dem.tif")
    with rasterio.open(tmp_path / "dem.tif") as raster:
        assert (raster.read(5) == raster.nodata).all()
        assert (raster.read(1) == 500.0).all()


def test_a_dem_in_another_crs_lies_at_the_same_place(run_folder, stored, tmp_path):
    export(run_folder, options=ExportOptions(resolution_m=SIDE, crs="EPSG:32633"), dem=tmp_path / "a.tif")
    export(run_folder, options=ExportOptions(resolution_m=SIDE, crs="EPSG:4326"), dem=tmp_path / "b.tif")
    for path, code in ((tmp_path / "a.tif", 32633), (tmp_path / "b.tif", 4326)):
        with rasterio.open(path) as raster:
            crs = CRS.from_wkt(raster.crs.to_wkt())
            assert [part.to_epsg() for part in crs.sub_crs_list] == [code, stored.crs.sub_crs_list[1].to_epsg()]
            height = raster.read(1, masked=True)
            area = height.count() * abs(raster.transform.a * raster.transform.e)
            # Cells at the edge shift the mean by half a cell at most, on a slope of 0.047.
            assert abs(height.mean() - stored.points_crs[:, 2].mean()) < 0.5 * SIDE * 0.047
            if code == 4326:
                middle = np.radians(0.5 * (raster.bounds.top + raster.bounds.bottom))
                area *= 111_300.0**2 * np.cos(middle)
            # 14 m squared, and what the cells at its edge have more.
            assert 0.98 * 14.0**2 < area < 1.12 * 14.0**2


def test_a_raster_that_fails_leaves_nothing_behind(tmp_path):
    form = RasterForm(CRS("EPSG:25832"), (1, 0, 0, 0, -1, 0), (600, 600), (RasterBand("height"),))

    def parts():
        yield 0, 0, np.zeros((1, 512, 512), dtype=np.float32)
        raise RuntimeError("no such tile")

    with pytest.raises(RuntimeError, match="no such tile"):
        write_cog(tmp_path / "a.tif", form, parts())
    with pytest.raises(UnwritableFile, match=r"cannot write .*a\.tif"):
        write_cog(tmp_path / "missing" / "a.tif", form, [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "side", [1e-300, 1e-4, 3e-4, 0.05, slow(0.3), slow(2.0), 5.0, slow(30.0), 1e4, 1e9, float("inf")]
)
@pytest.mark.parametrize("product", ["dem", "bag", "contours"])
def test_at_no_resolution_a_product_is_empty_without_a_word(run_folder, tmp_path, capsys, product, side):
    """Far too fine or too coarse: it is refused with the lengths, or has values, or is said to have none."""
    suffix = {"bag": "bag", "contours": "geojson"}.get(product, "tif")
    path = tmp_path / f"{product}.{suffix}"
    with Progress(verbosity=0):
        try:
            export(run_folder, options=ExportOptions(resolution_m=side), **{product: path})
            refused = None
        except SurveyError as error:
            refused = str(error)
    if refused is not None:
        assert "--resolution" in refused
        assert len(refused) < 400
        assert not path.exists()
        return
    is_said = f"{path}: nothing to show" in capsys.readouterr().err
    if suffix in ("tif", "bag"):
        with rasterio.open(path) as raster:
            has_values = bool((raster.read(1) != raster.nodata).any())
    else:
        has_values = bool(json.loads(path.read_text())["features"])
    assert has_values != is_said


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


STYLED = {product.option: product for product in PRODUCTS if product.function("style") and product.option != "copc"}


PLAN = np.random.default_rng(5).uniform(0, [6, 4], (6000, 2))
POINTS = np.column_stack([PLAN, 100.0 + 0.2 * PLAN[:, 0]]) + np.array([500_000.0, 5_200_000.0, 0.0])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = run_of(
        stored_points(POINTS, CRS("EPSG:25832+7837"), level_m=102.0), tmp_path_factory.mktemp("styles") / "run"
    )
    settings = parse_config('crs = "EPSG:25832+7837"\n[water]\nlevel_m = 102\nrefractive_index = 1.333')
    (folder / "settings.toml").write_text(dump_config(settings))
    return folder


def test_rasters_of_numbers_have_a_style():
    assert {"dem", "s44", "bag"} == STYLED.keys()


@pytest.mark.parametrize(("is_dry", "attribute", "ends"), [(False, "depth", (0.8, 2)), (True, "Z", (100, 101.2))])
def test_a_cloud_has_colours_of_depth_or_of_height_where_it_is_dry(run, tmp_path, is_dry, attribute, ends):
    path = tmp_path / "bed.copc.laz"
    export(run, copc=path)
    text = (tmp_path / "bed.copc.qml").read_text()
    if is_dry:
        n = len(POINTS)
        write_cloud(
            path, POINTS, CRS("EPSG:25832+7837"), rgb=np.full((n, 3), 90, np.uint8), depth_m=np.full(n, np.nan),
            std_m=np.full(n, 0.02), num_views=np.full(n, 5, np.uint8), incidence_deg=np.zeros(n),
            is_wet=np.zeros(n, bool),
        )  # fmt: skip
        text = of_clouds(path)
    renderer = ElementTree.fromstring(text).find("renderer")
    assert (renderer.get("type"), renderer.get("attribute")) == ("ramp", attribute)
    assert (float(renderer.get("min")), float(renderer.get("max"))) == pytest.approx(ends, abs=0.05)
    values = [float(item.get("value")) for item in renderer.iter("item")]
    assert values == sorted(set(values))


@pytest.mark.parametrize("option", STYLED)
def test_the_style_fits_the_values(run, tmp_path, option):
    path = tmp_path / f"out{STYLED[option].suffixes[0]}"
    export(run, options=ExportOptions(resolution_m=0.5), **{option: path})
    renderer = ElementTree.fromstring(path.with_suffix(".qml").read_bytes()).find("pipe/rasterrenderer")
    assert renderer.get("band") == "1"
    with rasterio.open(path) as raster:
        values = raster.read(1, masked=True).compressed()
    if option == "s44":
        entries = {int(e.get("value")): e.get("label") for e in renderer.iter("paletteEntry")}
        assert set(values.tolist()) <= entries.keys() == set(range(1, len(TVU) + 2))
        assert entries[1] == "S-44 Exclusive"
        assert entries[3] == "S-44 order 1a and 1b"
        return
    steps = [float(item.get("value")) for item in renderer.iter("item")]
    assert steps == sorted(set(steps))
    assert values.min() <= steps[0] + 1e-5
    assert steps[-1] <= max(values.max(), steps[0] + 1.0) + 1e-5
    assert len({item.get("color") for item in renderer.iter("item")}) == len(steps)


def test_a_style_that_somebody_changed_stays(run, tmp_path):
    path = tmp_path / "dem.tif"
    export(run, dem=path)
    style = path.with_suffix(".qml")
    first = style.read_text()
    export(run, dem=path, options=ExportOptions(resolution_m=1.0))
    assert "made by bathynerf" in style.read_text()
    style.write_text(first.replace("<!-- made by bathynerf -->", ""))
    export(run, dem=path, options=ExportOptions(resolution_m=0.5))
    assert "made by bathynerf" not in style.read_text()
