"""Styles of QGIS beside rasters: colours over the values that are there, names for codes."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import rasterio
from pyproj import CRS
from stored_run import run_of, stored_points

from evaluation.standards import TVU
from geo import write_cloud
from survey.export.export import export
from survey.export.registry import PRODUCTS, ExportOptions
from survey.export.styles import of_clouds
from survey.settings.config import dump_config, parse_config

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
