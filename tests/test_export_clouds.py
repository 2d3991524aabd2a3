"""What a run stored of its cloud, and the files of points that are exported from it, soundings among them."""

import csv
from dataclasses import fields, replace

import numpy as np
import pyogrio
import pytest
import rasterio
from pyproj import CRS, Transformer
from scipy.spatial import cKDTree
from stored_run import run_of, stored_points

from geo import Cloud, read_cloud, read_reference
from geo.crs import height_unit_m
from geo.errors import UnwritableFile
from survey.compare.comparison import compare_files
from survey.compare.inputs import read_shape
from survey.errors import OutputError, SurveyError
from survey.export import export as export_room
from survey.export.bed_raster import bed_raster
from survey.export.export import export
from survey.export.loaded import LoadedRun
from survey.export.registry import PRODUCTS, ExportOptions
from survey.progress import Progress
from survey.run.folder import RunDir
from survey.run.stored import load_bed, save_bed
from survey.settings.config import SurveyConfig, WaterConfig, dump_config

# LAS steps by 1 mm: half a step, and the rounding of a northing of 5e6 m.
LAS_ROUNDING = 0.5e-3 + 1e-8
FLOAT_EPS = 1.2e-7


def in_order_of(cloud: Cloud, points: np.ndarray) -> Cloud:
    """The points of a cloud in the order of those that they are nearest to, each of them once."""
    _, order = cKDTree(cloud.points).query(points)
    assert sorted(order) == list(range(len(cloud.points)))
    extra = {name: values[order] for name, values in cloud.extra.items()}
    return Cloud(cloud.points[order], cloud.rgb[order], cloud.crs, cloud.classification[order], extra)


def test_a_stored_bed_comes_back_to_the_bit(stored, run_folder):
    again = load_bed(RunDir(run_folder).load_stage("bed"))
    for name in ("xyz", "rgb", "std", "num_views", "depth", "incidence", "wet"):
        before, after = getattr(stored.bed, name), getattr(again.bed, name)
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(again.points_crs, stored.points_crs)
    assert again.crs.equals(stored.crs)
    assert (again.name, again.gsd_m) == (stored.name, stored.gsd_m)


@pytest.mark.parametrize("option", ["las", "laz", "copc"])
def test_las_laz_and_copc_have_the_points_their_crs_and_their_extra_bytes(stored, run_folder, tmp_path, option):
    path = tmp_path / ("out.copc.laz" if option == "copc" else f"out.{option}")
    assert export(run_folder, **{option: path}) == [path]
    cloud = read_cloud(path)
    if option == "copc":
        # Nodes have an order of their own; the points of this bed differ in plan.
        cloud = in_order_of(cloud, stored.points_crs)
    np.testing.assert_allclose(cloud.points, stored.points_crs, rtol=0.0, atol=LAS_ROUNDING)
    np.testing.assert_array_equal(cloud.rgb, stored.bed.rgb)
    np.testing.assert_array_equal(cloud.classification == 40, stored.bed.wet)
    np.testing.assert_allclose(cloud.extra["depth"], stored.bed.depth, rtol=FLOAT_EPS)
    np.testing.assert_allclose(cloud.extra["std"], stored.bed.std, rtol=FLOAT_EPS)
    np.testing.assert_array_equal(cloud.extra["num_views"], stored.bed.num_views)
    np.testing.assert_allclose(cloud.extra["incidence"], np.degrees(stored.bed.incidence), rtol=FLOAT_EPS)
    assert cloud.crs.sub_crs_list[0].to_epsg() == 25832


def test_total_uncertainties_have_all_parts_at_95_percent(stored, tmp_path):
    number = len(stored.bed)
    common, plan = (np.full(number, value, dtype=np.float32) for value in (0.03, 0.02))
    run = run_of(replace(stored, std_common=common, std_plan=plan), tmp_path / "run")
    water = WaterConfig(level_m=0.0, refractive_index=1.333)
    RunDir(run).settings_path.write_text(dump_config(SurveyConfig(crs="EPSG:25832+5783", water=water)))
    export(run, options=ExportOptions(tpu=True), las=tmp_path / "out.las")
    extra = read_cloud(tmp_path / "out.las").extra
    std = stored.bed.std.astype(np.float64)
    np.testing.assert_allclose(extra["total_tvu"], 1.959964 * np.hypot(std, 0.03), rtol=1e-5)
    angle = np.arcsin(np.sin(stored.bed.incidence) / np.where(stored.bed.wet, 1.333, 1.0))
    in_plan = np.sqrt((np.tan(angle) * std) ** 2 + (0.5 * stored.gsd_m) ** 2 + 0.02**2)
    np.testing.assert_allclose(extra["total_thu"], 2.447747 * in_plan, rtol=1e-5)
    export(run, las=tmp_path / "plain.las")
    assert "total_tvu" not in read_cloud(tmp_path / "plain.las").extra
    with pytest.raises(SurveyError, match="have no standard deviation in plan; process the survey again"):
        export(run_of(stored, tmp_path / "earlier"), options=ExportOptions(tpu=True), las=tmp_path / "e.las")


def test_ply_has_the_points_in_double_precision_and_the_scalars_with_their_units(stored, run_folder, tmp_path):
    export(run_folder, ply=tmp_path / "out.ply")
    cloud = read_reference(tmp_path / "out.ply")
    np.testing.assert_array_equal(cloud.points, stored.points_crs)
    np.testing.assert_array_equal(cloud.rgb, stored.bed.rgb)
    assert set(cloud.extra) == {"depth_m", "std_m", "std_common_m", "num_views", "incidence_deg", "withheld"}
    np.testing.assert_allclose(cloud.extra["incidence_deg"], np.degrees(stored.bed.incidence), rtol=FLOAT_EPS)


def test_several_formats_are_written_at_once(run_folder, tmp_path):
    paths = [tmp_path / "a.las", tmp_path / "b.laz", tmp_path / "c.ply"]
    assert export(run_folder, las=paths[0], laz=paths[1], ply=paths[2]) == paths
    assert sorted(tmp_path.iterdir()) == paths
    assert paths[1].stat().st_size < paths[0].stat().st_size


@pytest.mark.parametrize(
    ("files", "options", "error", "words"),
    [
        ({}, {}, SurveyError, "nothing to export was named; give at least one of --las"),
        ({"las": "in.las", "ply": "out.las"}, {}, SurveyError, r"--ply names .*out\.las; expected .* ends in \.ply"),
        ({"las": "missing/out.las"}, {}, OutputError, r"--las names .*missing/out\.las, whose folder does not exist"),
        ({"las": "a.las"}, {"fill_m": 1.0}, SurveyError, "--fill has no effect on what is exported here"),
        ({"xyz": "a.xyz"}, {}, TypeError, "no product is called xyz"),
        ({"soundings": "a.csv"}, {"thin": "deep"}, SurveyError, '--thin is "deep", expected one of none, shoal, mean'),
        ({"soundings": "a.csv"}, {"mesh_method": "ball"}, SurveyError, '--mesh-method is "ball", expected one of del'),
        ({"soundings": "a.csv"}, {"resolution_m": 1.0}, SurveyError, "give --thin shoal or --thin mean too"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_written(run_folder, tmp_path, files, options, error, words):
    paths = {option: tmp_path / name for option, name in files.items()}
    with pytest.raises(error, match=words):
        export(run_folder, options=ExportOptions(**options), **paths)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("option", "suffix"), [("las", "las"), ("laz", "laz"), ("ply", "ply"), ("soundings", "xyz")])
def test_an_earlier_export_is_replaced_and_nothing_else(run_folder, tmp_path, option, suffix):
    path = tmp_path / f"out.{suffix}"
    export(run_folder, **{option: path})
    export(run_folder, **{option: path}, options=ExportOptions(crs="EPSG:25833+5778"))
    changed = path.read_bytes()[:-1]
    path.write_bytes(changed)
    with pytest.raises(OutputError, match=rf"--{option} names .*out.*, which somebody has changed since"):
        export(run_folder, **{option: path})
    assert path.read_bytes() == changed
    other = tmp_path / f"other.{suffix}"
    path.rename(other)
    with pytest.raises(OutputError, match=rf"--{option} names .*other.*, which exists and is not an export of this"):
        export(run_folder, **{option: other})
    assert list(tmp_path.iterdir()) == [other]


def test_what_the_run_itself_needs_is_not_overwritten(stored, tmp_path):
    run = RunDir(run_of(stored, tmp_path / "run"))
    export(run.path, las=tmp_path / "a.las")
    run.cloud_path.write_bytes((tmp_path / "a.las").read_bytes())
    (tmp_path / "link.las").symlink_to(run.cloud_path)
    for path in (run.cloud_path, tmp_path / "link.las"):
        with pytest.raises(OutputError, match=r"would overwrite the input .*run/cloud\.las"):
            export(run.path, las=path)


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(SurveyError, match=r"is no run folder; name the folder that process wrote"):
        export(tmp_path, las=tmp_path / "out.las")
    with pytest.raises(SurveyError, match=r"gone does not exist"):
        export(tmp_path / "gone", las=tmp_path / "out.las")


def test_a_run_that_has_not_come_to_its_cloud_is_refused_with_the_mend(tmp_path):
    with RunDir(tmp_path / "run") as run:
        run.finish_stage("sweep", {}, run.open_stage("sweep"))
    with pytest.raises(SurveyError, match=r"no finished stage bed; run the same `bathynerf process` again"):
        export(tmp_path / "run", las=tmp_path / "out.las")


@pytest.mark.parametrize("spoil", ["bed.npz", "survey.json"])
def test_a_damaged_bed_is_named_with_the_mend(stored, tmp_path, spoil):
    save_bed(tmp_path, stored)
    (tmp_path / spoil).write_text("{}")
    with pytest.raises(SurveyError, match=r"bathynerf process"):
        load_bed(tmp_path)


def test_another_crs_moves_the_points_in_plan_and_keeps_their_heights(stored, run_folder, tmp_path):
    export(run_folder, options=ExportOptions(crs="EPSG:4326"), ply=tmp_path / "out.ply", las=tmp_path / "out.las")
    way = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
    lon, lat = way.transform(*stored.points_crs[:, :2].T)
    expected = np.column_stack([lon, lat, stored.points_crs[:, 2]])
    np.testing.assert_array_equal(read_reference(tmp_path / "out.ply").points, expected)
    cloud = read_cloud(tmp_path / "out.las")
    # Steps of 1e-8 degrees in plan.
    np.testing.assert_allclose(cloud.points[:, :2], expected[:, :2], rtol=0.0, atol=0.51e-8)
    assert cloud.crs.sub_crs_list[0].to_epsg() == 4326
    assert cloud.crs.sub_crs_list[1].equals(stored.crs.sub_crs_list[1])


def test_a_file_that_is_up_to_date_is_not_written_again(stored, run_folder, tmp_path, capsys):
    paths = {"las": tmp_path / "a.las", "ply": tmp_path / "a.ply"}
    export(run_folder, **paths)
    before = {path: path.stat().st_ino for path in paths.values()}
    with Progress(verbosity=0):
        export(run_folder, **paths)
    assert capsys.readouterr().err.count(": unchanged") == 2
    assert {path: path.stat().st_ino for path in paths.values()} == before
    # Another CRS, and a file that is not there any more.
    export(run_folder, options=ExportOptions(crs="EPSG:4326"), las=paths["las"])
    assert paths["las"].stat().st_ino != before[paths["las"]]
    paths["ply"].unlink()
    export(run_folder, ply=paths["ply"])
    np.testing.assert_array_equal(read_reference(paths["ply"]).points, stored.points_crs)


def test_a_run_that_cannot_be_written_to_is_exported_all_the_same(run_folder, tmp_path, monkeypatch):
    def refuse(path, _value):
        raise UnwritableFile(f"cannot write {path}: the disk is read-only")

    monkeypatch.setattr(export_room, "write_json", refuse)
    assert export(run_folder, las=tmp_path / "a.las") == [tmp_path / "a.las"]


def test_every_product_is_described_once_and_has_an_example_of_its_own():
    options = [product.option for product in PRODUCTS]
    assert len(set(options)) == len(options)
    known = {field.name for field in fields(ExportOptions)}
    for product in PRODUCTS:
        assert set(product.takes) <= known
        assert product.example.split()[0].endswith(product.suffixes)
        assert callable(product.function("write"))
        assert product.help.endswith(".")
        assert "\n" not in product.help


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
