"""Soundings as XYZ and CSV: all points, the shoalest of each cell, or the mean."""

from __future__ import annotations

import csv

import numpy as np
import pyogrio
import pytest
import rasterio
from pyproj import CRS
from stored_run import run_of, stored_points

from geo.crs import height_unit_m
from survey.compare.comparison import compare_files
from survey.compare.inputs import read_shape
from survey.errors import OutputError, SurveyError
from survey.export.bed_raster import bed_raster
from survey.export.export import export
from survey.export.loaded import LoadedRun
from survey.export.registry import ExportOptions
from survey.progress import Progress

LEVEL_M = 101.5


def run_with(folder, code="EPSG:25832+7837", *, level_m: float | None = LEVEL_M):
    """A rough bed of 6 x 4 m with some thousand points."""
    crs = CRS(code)
    unit = np.array([crs.axis_info[0].unit_conversion_factor] * 2 + [height_unit_m(crs)])
    random = np.random.default_rng(3)
    local = np.column_stack([random.uniform(0, [6, 4], (4000, 2)), 100.0 + 0.05 * random.standard_normal(4000)])
    points = local / unit + np.array([500_000.0, 5_200_000.0, 0.0])
    level = None if level_m is None else level_m / unit[2]
    return points, run_of(stored_points(points, crs, level_m=level), folder / "run")


def numbers_in(path) -> np.ndarray:
    return np.loadtxt(path)


def rows_in(path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.mark.parametrize("code", ["EPSG:25832+7837", "EPSG:2263+6360"])
def test_all_points_are_in_xyz_and_csv(tmp_path, code):
    points, run = run_with(tmp_path, code)
    for name in ("a.xyz", "a.csv"):
        export(run, soundings=tmp_path / name)
    assert numbers_in(tmp_path / "a.xyz") == pytest.approx(points, abs=6e-4)
    rows = rows_in(tmp_path / "a.csv")
    assert [float(row["height"]) for row in rows] == pytest.approx(points[:, 2], abs=6e-4)
    assert {(row["std_m"], row["std_common_m"], row["points"]) for row in rows} == {("0.010", "", "1")}
    assert CRS(rows[0]["crs"]).name == CRS(code).name
    assert {row["crs"] for row in rows[1:]} == {""}


def test_gdal_opens_both_as_they_are(tmp_path):
    _, run = run_with(tmp_path)
    options = ExportOptions(thin="mean", resolution_m=1.0)
    for name in ("m.xyz", "m.csv"):
        export(run, soundings=tmp_path / name, options=options)
    with rasterio.open(tmp_path / "m.xyz") as raster:
        assert raster.shape == (4, 6)
    meta, *_ = pyogrio.raw.read(tmp_path / "m.csv")
    assert list(meta["fields"])[:4] == ["easting", "northing", "height", "depth_m"]


@pytest.mark.parametrize("suffix", [".csv", ".xyz"])
@pytest.mark.parametrize("code", ["EPSG:25832+7837", "+proj=utm +zone=32 +ellps=GRS80 +vunits=m +type=crs"])
def test_compare_reads_soundings_back(tmp_path, suffix, code):
    points, run = run_with(tmp_path, code)
    las, path = tmp_path / "a.las", tmp_path / f"s{suffix}"
    export(run, las=las, soundings=path)
    for first, second in ((las, path), (path, las)):
        figures = compare_files(first, second)
        assert figures.distances.n_points + figures.distances.n_nan == len(points)
        assert abs(figures.distances.mean_m) < 1e-3
    assert (read_shape(path, None).crs is None) == (suffix == ".xyz")
    assert ("depth" in read_shape(path, None).extra) == (suffix == ".csv")


def test_compare_reads_a_bag_back(tmp_path):
    _, run = run_with(tmp_path)
    export(run, las=tmp_path / "a.las", bag=tmp_path / "b.bag", options=ExportOptions(resolution_m=0.5))
    distances = compare_files(tmp_path / "a.las", tmp_path / "b.bag").vertical
    assert abs(distances.mean_m) < 0.005
    assert distances.std_m == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize("thin", ["none", "shoal", "mean"])
def test_points_that_las_flags_as_withheld_are_no_soundings(tmp_path, capsys, thin):
    """A false match 1.5 m over the bed whose standard deviation is 1.4 m."""
    points, _ = run_with(tmp_path)
    points[17, 2] += 1.5
    stored = stored_points(points, CRS("EPSG:25832+7837"), level_m=LEVEL_M)
    stored.bed.std[17] = 1.4
    run = run_of(stored, tmp_path / "run")
    options = ExportOptions(thin=thin, resolution_m=None if thin == "none" else 0.5)
    with Progress(verbosity=0):
        export(run, soundings=tmp_path / "s.csv", options=options)
    assert max(float(row["height"]) for row in rows_in(tmp_path / "s.csv")) < 100.4
    said = " ".join(capsys.readouterr().err.split())
    if thin != "mean":
        assert "1 of 4000 points are left out" in said
    assert ("1 cells have a withheld point higher than their sounding" in said) == (thin == "shoal")


@pytest.mark.parametrize("suffix", [".csv", ".xyz"])
def test_soundings_that_somebody_edited_are_kept(tmp_path, suffix):
    _, run = run_with(tmp_path)
    path = tmp_path / f"s{suffix}"
    export(run, soundings=path)
    text = path.read_text()
    path.write_text("\n".join(text.splitlines()[:-1]) + "\n")
    with pytest.raises(OutputError, match="which somebody has changed since bathynerf wrote it; remove it"):
        export(run, soundings=path, options=ExportOptions(thin="shoal"))
    # Touched, and the same.
    path.write_text(text)
    export(run, soundings=path, options=ExportOptions(thin="shoal"))
    assert len(path.read_text()) < len(text)


def test_the_shoalest_point_of_each_cell_is_kept_as_it_is(tmp_path):
    points, run = run_with(tmp_path)
    export(run, soundings=tmp_path / "s.csv", options=ExportOptions(thin="shoal", resolution_m=0.5))
    kept = rows_in(tmp_path / "s.csv")
    cells = np.floor(points[:, :2] / 0.5)
    true = {tuple(cell): points[(cells == cell).all(axis=1)] for cell in np.unique(cells, axis=0)}
    assert len(kept) == len(true)
    for row in kept:
        place = np.array([float(row["easting"]), float(row["northing"])])
        there = min(true.values(), key=lambda some: np.abs(some[:, :2] - place).sum(axis=1).min())
        assert float(row["height"]) == pytest.approx(there[:, 2].max(), abs=6e-4)
        assert int(row["points"]) == len(there)
        assert float(row["depth_m"]) == pytest.approx(LEVEL_M - float(row["height"]), abs=2e-3)
    assert sum(int(row["points"]) for row in kept) == len(points)


def test_points_on_the_outer_edge_lie_in_the_last_cells(tmp_path):
    crs = CRS("EPSG:25832+7837")
    plan = np.array([(0.5, 1.5), (1.5, 1.5), (0.5, 0.5), (1.5, 0.5), (2.0, 1.5), (1.5, 0.0)])
    heights = [100.0, 100.0, 100.0, 100.0, 100.5, 100.5]
    points = np.column_stack([plan, heights]) + np.array([500_000.0, 5_200_000.0, 0.0])
    run = run_of(stored_points(points, crs), tmp_path / "run")
    options = ExportOptions(thin="shoal", resolution_m=1.0)
    export(run, soundings=tmp_path / "s.csv", options=options)
    kept = {tuple(float(row[name]) for name in ("easting", "northing")): row for row in rows_in(tmp_path / "s.csv")}
    places = [(500_000.5, 5_200_001.5), (500_000.5, 5_200_000.5), (500_002.0, 5_200_001.5), (500_001.5, 5_200_000.0)]
    assert sorted(kept) == sorted(places)
    assert [int(kept[place]["points"]) for place in places] == [1, 1, 2, 2]
    with LoadedRun(run) as loaded:
        assert bed_raster(loaded, options).count.tolist() == [[1, 2], [1, 2]]


def test_a_mean_stands_in_the_middle_of_its_cell(tmp_path):
    points, run = run_with(tmp_path)
    export(run, soundings=tmp_path / "m.xyz", options=ExportOptions(thin="mean", resolution_m=1.0))
    found = numbers_in(tmp_path / "m.xyz")
    assert len(found) == 24
    assert (found[:, :2] % 1.0 == 0.5).all()
    for east, north, height in found:
        there = (np.abs(points[:, :2] - [east, north]) <= 0.5).all(axis=1)
        assert height == pytest.approx(points[there, 2].mean(), abs=0.02)


def test_a_dry_bed_has_no_depths(tmp_path):
    _, run = run_with(tmp_path, level_m=None)
    export(run, soundings=tmp_path / "a.csv")
    assert {row["depth_m"] for row in rows_in(tmp_path / "a.csv")} == {""}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (ExportOptions(thin="deep"), '--thin is "deep", expected one of none, shoal, mean'),
        (ExportOptions(mesh_method="ball"), '--mesh-method is "ball", expected one of delaunay, poisson'),
        (ExportOptions(resolution_m=1.0), "give --thin shoal or --thin mean too"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path, options, words):
    _, run = run_with(tmp_path)
    with pytest.raises(SurveyError, match=words):
        export(run, soundings=tmp_path / "a.csv", options=options)


def test_a_table_of_somebody_else_stays(tmp_path):
    _, run = run_with(tmp_path)
    path = tmp_path / "a.xyz"
    path.write_text("1 2 3\n")
    with pytest.raises(SurveyError, match="is not an export of this run"):
        export(run, soundings=path)
    path.unlink()
    export(run, soundings=path)
    export(run, soundings=path, options=ExportOptions(thin="shoal"))
    assert len(numbers_in(path)) < 4000
