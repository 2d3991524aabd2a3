"""Styles of QGIS beside rasters: colours over the values that are there, names for codes."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import rasterio
from pyproj import CRS
from stored_run import run_of, stored_points

from evaluation.standards import TVU
from survey.errors import SurveyError
from survey.export.export import export
from survey.export.product import ExportOptions
from survey.export.registry import PRODUCTS
from survey.settings.config import dump_config, parse_config

STYLED = {product.option: product for product in PRODUCTS if product.style is not None}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    random = np.random.default_rng(5)
    plan = random.uniform(0, [6, 4], (6000, 2))
    points = np.column_stack([plan, 100.0 + 0.2 * plan[:, 0]]) + np.array([500_000.0, 5_200_000.0, 0.0])
    folder = run_of(
        stored_points(points, CRS("EPSG:25832+7837"), level_m=102.0), tmp_path_factory.mktemp("styles") / "run"
    )
    settings = parse_config('crs = "EPSG:25832+7837"\n[water]\nlevel_m = 102\nrefractive_index = 1.333')
    (folder / "settings.toml").write_text(dump_config(settings))
    return folder


def test_rasters_of_numbers_have_a_style():
    assert {"dem", "slope", "s44", "bag"} == STYLED.keys()


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


def test_a_project_opens_what_lies_beside_it(run, tmp_path, caplog):
    export(run, options=ExportOptions(resolution_m=0.5), qgis=tmp_path / "q")
    # This run has no photographs.
    assert "has no orthophoto" in caplog.text
    root = ElementTree.fromstring((tmp_path / "q" / "bed.qgs").read_bytes())
    layers = {layer.findtext("layername"): layer for layer in root.iter("maplayer")}
    assert list(layers) == ["cloud", "height", "standard deviation"]
    for layer in layers.values():
        assert (tmp_path / "q" / layer.findtext("datasource")).is_file()
        assert layer.findtext("srs/spatialrefsys/authid") == "EPSG:25832"
    assert [entry.get("id") for entry in root.iter("layer-tree-layer")] == [m.findtext("id") for m in layers.values()]
    assert layers["standard deviation"].find("pipe/rasterrenderer").get("band") == "2"
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "bed.qgs").write_text("<qgis/>")
    with pytest.raises(SurveyError, match="other files"):
        export(run, qgis=tmp_path / "mine")
