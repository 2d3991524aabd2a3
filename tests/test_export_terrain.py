"""Rasters of the bed: what is in them, as readers other than their writer see it."""

from __future__ import annotations

import json
import zlib
from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile
from gdal_programs import gdalinfo, needs_gdal
from pyproj import CRS
from rio_cogeo.cogeo import cog_validate
from slow_cases import slow
from stored_run import run_of, stored_points

from geo.errors import UnwritableFile
from geo.raster import RasterBand, RasterForm, write_cog
from survey.errors import SurveyError
from survey.export.export import export
from survey.export.registry import ExportOptions
from survey.progress import Progress

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
