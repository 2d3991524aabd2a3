"""Every product of runs whose cloud is no ordinary bed: it is written, or refused in a sentence, and never half."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from small_survey import small_survey
from stored_run import plane_stored, run_of

from geo.errors import GeoError
from geo.reading import read_reference
from survey.errors import SurveyError
from survey.export.export import export
from survey.export.registry import PRODUCTS, ExportOptions
from survey.folder.survey import load_survey
from survey.progress import Progress
from survey.run.flight import save_flight

SIDE = ExportOptions(resolution_m=0.2)
FILES = [(product.option, suffix) for product in PRODUCTS for suffix in product.suffixes]


def none(bed):
    return np.zeros(len(bed), dtype=bool), {}


def one(bed):
    return np.arange(len(bed)) == 7, {}


def line(bed):
    return np.abs(bed.xyz[:, 1] - bed.xyz[0, 1]) < 1e-6, {}


def same_place(bed):
    return np.arange(len(bed)) < 40, {"xyz": np.broadcast_to(bed.xyz[0], bed.xyz.shape).copy()}


def no_std(bed):
    return np.ones(len(bed), dtype=bool), {"std": np.full(len(bed), np.nan, np.float32)}


def some_std(bed):
    return np.ones(len(bed), dtype=bool), {"std": np.where(np.arange(len(bed)) % 3, bed.std, np.nan).astype(np.float32)}


def all_withheld(bed):
    return np.ones(len(bed), dtype=bool), {"std": np.full(len(bed), 1.5, np.float32)}


def dry(bed):
    depth = np.full(len(bed), np.nan, np.float32)
    return np.ones(len(bed), dtype=bool), {"depth": depth, "wet": np.zeros(len(bed), dtype=bool)}


CLOUDS = (none, one, line, same_place, no_std, some_std, all_withheld, dry)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    stored = plane_stored(folder / "small")
    near = np.abs(stored.bed.xyz[:, :2]).max(axis=1) < 2.0
    survey = load_survey(small_survey(folder / "small"))
    return replace(stored, bed=stored.bed[near], points_crs=stored.points_crs[near]), survey


@pytest.fixture(scope="module", params=CLOUDS, ids=lambda cloud: cloud.__name__)
def run(drawn, request, tmp_path_factory):
    stored, survey = drawn
    keep, columns = request.param(stored.bed)
    bed = replace(stored.bed, **columns)[keep]
    points = survey.frame.crs_from_local(bed.xyz) if len(bed) else stored.points_crs[:0]
    path = run_of(replace(stored, bed=bed, points_crs=points), tmp_path_factory.mktemp("run") / "run")
    save_flight(path, survey)
    shutil.copy(survey.folder / "survey.toml", path / "settings.toml")
    return request.param, path


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(("option", "suffix"), FILES, ids=lambda value: value or "folder")
def test_a_product_is_whole_or_refused_in_a_sentence(run, tmp_path, capsys, option, suffix):
    cloud, path = run
    file, (product,) = tmp_path / f"a{suffix}", (each for each in PRODUCTS if each.option == option)
    options = SIDE if "resolution_m" in product.takes and option != "soundings" else None
    refused = ""
    with Progress(verbosity=0):
        try:
            export(path, options=options, **{option: file})
        except (SurveyError, GeoError) as error:
            refused = str(error)
    assert len(refused) < 500
    assert bool(refused) != file.exists() or product.is_folder
    assert refused or not (cloud is none and product.is_of_points)
    if refused:
        return
    if suffix in (".tif", ".bag") and "nothing to show" not in capsys.readouterr().err:
        with rasterio.open(file) as raster:
            assert raster.read(1, masked=True).count() > 0


def test_points_without_a_standard_deviation_are_left_out_and_counted(drawn, tmp_path, capsys):
    stored, _ = drawn
    keep, columns = some_std(stored.bed)
    path = run_of(replace(stored, bed=replace(stored.bed, **columns)[keep]), tmp_path / "run")
    with Progress(verbosity=0):
        export(path, options=SIDE, dem=tmp_path / "a.tif", contours=tmp_path / "a.geojson")
    said = " ".join(capsys.readouterr().err.split())
    assert said.count(f"{-(-len(keep) // 3)} of {len(keep)} points have no standard deviation") == 1
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.read(1, masked=True).count() > 350
    assert json.loads((tmp_path / "a.geojson").read_text())["features"]


@pytest.mark.parametrize(("option", "suffix"), [("mesh", ".ply"), ("soundings", ".xyz"), ("ply", ".ply")])
def test_a_withheld_point_is_left_out_or_marked(drawn, tmp_path, option, suffix):
    stored, survey = drawn
    bed = replace(stored.bed, std=stored.bed.std.copy(), xyz=stored.bed.xyz.copy())
    bed.xyz[100, 2] += 3.0
    bed.std[100] = 1.4
    points = survey.frame.crs_from_local(bed.xyz)
    path = run_of(replace(stored, bed=bed, points_crs=points), tmp_path / "run")
    save_flight(path, survey)
    export(path, options=SIDE if option == "mesh" else None, **{option: tmp_path / f"a{suffix}"})
    if suffix == ".xyz":
        heights = np.loadtxt(tmp_path / "a.xyz")[:, 2]
    else:
        shape = read_reference(tmp_path / f"a{suffix}")
        if option == "ply":
            assert np.flatnonzero(shape.withheld).tolist() == [100]
            return
        heights = shape.vertices[:, 2]
    assert heights.max() < points[100, 2] - 1.0


def test_all_is_checked_before_anything_is_computed(drawn, tmp_path, monkeypatch, capsys):
    stored, survey = drawn
    path = run_of(stored, tmp_path / "run")
    save_flight(path, survey)
    monkeypatch.setattr("shutil.which", lambda _name: None)
    monkeypatch.setattr("survey.export.bed_raster._bed_raster", lambda *_: pytest.fail("it was computed"))
    refused = {
        "pdf": ("a.pdf", "printed by Chromium"),
        "orthophoto": ("a.tif", "not there any more"),
        "footprints": ("a.gpkg", "written by pyogrio, which is not installed"),
    }
    monkeypatch.setitem(sys.modules, "pyogrio", None)
    for view in survey.views:
        view.path.unlink()
    for option, (name, words) in refused.items():
        with pytest.raises((SurveyError, GeoError), match=words):
            export(path, dem=tmp_path / "dem.tif", **{option: tmp_path / name})
    monkeypatch.undo()
    # An error that only the computation finds: what was written by then is said.
    monkeypatch.setattr("survey.export.rasters.write_raster", lambda *_, **__: 1 / 0)
    with Progress(verbosity=0), pytest.raises(ZeroDivisionError):
        export(path, las=tmp_path / "a.las", dem=tmp_path / "dem.tif")
    said = " ".join(capsys.readouterr().err.split())
    assert f"written before it ended: {tmp_path / 'a.las'}; not written: {tmp_path / 'dem.tif'}" in said


def test_every_product_has_a_row_in_the_pages():
    pages = "".join(path.read_text(encoding="utf-8") for path in (Path(__file__).parents[1] / "docs").glob("*.md"))
    assert [product.option for product in PRODUCTS if f"--{product.option} " not in pages] == []
