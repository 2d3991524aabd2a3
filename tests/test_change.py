"""Volumes of change: their intervals hold the truth as often as they say."""

import csv
import json
import shutil

import laspy
import numpy as np
import pytest
import rasterio
from command_line import bathynerf
from pyproj import CRS
from slow_cases import slow

from geo.compatibility import Reprojection
from geo.las import read_cloud, write_cloud
from geo.vectors import Layer, write_geojson, write_geopackage
from survey.change.change import align, change_between, volume_text
from survey.change.differences import (
    Correlation,
    Differences,
    Volume,
    measured_correlation,
    shared_photographs,
    volume_of,
)
from survey.change.series import change_series
from survey.compare.options import ChangeOptions
from survey.errors import SurveyError
from survey.files.json_values import write_json
from survey.run.folder import RunDir

SHAPE, SIDE, LENGTH = (48, 60), 0.5, 1.5


def exponential_errors(rng, count):
    """Fields (count, rows, columns) of unit variance with an exponential correlation, by circulant embedding."""
    rows, columns = (4 * n for n in SHAPE)
    lags = np.hypot(*np.meshgrid(*(np.minimum(np.arange(n), n - np.arange(n)) for n in (rows, columns)), indexing="ij"))
    eigen = np.maximum(np.fft.fft2(np.exp(-SIDE * lags / LENGTH)).real, 0.0)
    noise = rng.standard_normal((count, rows, columns)) + 1j * rng.standard_normal((count, rows, columns))
    field = np.fft.fft2(np.sqrt(eigen / (rows * columns)) * noise).real
    return field[:, : SHAPE[0], : SHAPE[1]]


def drawn(seed, *, common=(0.01, 0.02), shared=0.0):
    """Differences of a bed with a pit and a mound, and its true volume."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] * SIDE
    change = 0.5 * np.exp(-((x - 8) ** 2 + (y - 8) ** 2) / 4) - 0.3 * np.exp(-((x - 22) ** 2 + (y - 14) ** 2) / 6)
    std = 0.03 + 0.02 * (x / x.max())
    first = rng.standard_normal()
    second = shared * first + np.sqrt(1.0 - shared**2) * rng.standard_normal()
    height = change + std * exponential_errors(rng, 1)[0] + common[1] * second - common[0] * first
    height[20:26, 5:12] = np.nan
    pattern = np.array([np.full(SHAPE, c) for c in common])
    true = SIDE**2 * change[np.isfinite(height)].sum()
    return Differences(height, std, pattern, shared, SIDE), true


@pytest.mark.parametrize(("common", "shared"), [((0.01, 0.02), 0.0), slow((0.0, 0.0), 0.0), slow((0.02, 0.02), 1.0)])
@pytest.mark.parametrize("is_measured", [slow(False), True])
def test_intervals_of_95_per_cent_hold_the_true_volume(common, shared, is_measured):
    held = []
    for seed in range(200):
        differences, true = drawn(seed, common=common, shared=shared)
        cells = differences.is_known
        correlation = measured_correlation(differences, cells) if is_measured else Correlation(1.0, LENGTH)
        low, high = volume_of(differences, cells, correlation).interval95_m3
        held.append(low <= true <= high)
    assert 0.90 <= np.mean(held) <= 0.99


def test_the_variance_of_a_sum_is_that_of_all_pairs():
    differences, _ = drawn(1)
    cells = differences.is_known
    cells[:, 12:] = False
    at = SIDE * np.argwhere(cells)
    apart = np.hypot(*(at[:, None] - at[None]).T)
    std, correlation = differences.std[cells], Correlation(0.7, LENGTH)
    own = (np.outer(std, std) * correlation.at(apart)).sum()
    common = sum(each[cells].sum() ** 2 for each in differences.common)
    assert volume_of(differences, cells, correlation).std_m3 == pytest.approx(SIDE**2 * np.sqrt(own + common))


def test_errors_without_correlation_have_none():
    rng = np.random.default_rng(3)
    zero = np.zeros((2, *SHAPE))
    differences = Differences(0.1 * rng.standard_normal(SHAPE), np.full(SHAPE, 0.1), zero, 0.0, SIDE)
    found = measured_correlation(differences, differences.is_known)
    # A field of 2880 cells tells a correlation to 0.02 at each lag.
    assert found.at(np.array([SIDE]))[0] < 0.1
    assert found.scatter == pytest.approx(1.0, abs=0.1)


def test_a_level_that_both_surveys_share_does_not_count():
    differences, _ = drawn(5, common=(0.02, 0.02), shared=1.0)
    assert differences.detection == pytest.approx(1.959964 * differences.std)


E0, N0 = 676120.0, 5311480.0
CRS_OF_CLOUDS = "EPSG:25832+7837"
PIT_M3 = 0.4 * 4.0 * 3.0


def write(path, seed, *, pit_m=0.0, crs=CRS_OF_CLOUDS, std=0.02, common=0.005):
    """A sloping bed of 12 x 9 m with a pit of 4 x 3 m, whose edges are those of cells, as a cloud of 10 cm."""
    rng = np.random.default_rng(seed)
    x, y = (np.mgrid[0:120, 0:90] * 0.1 + 0.05 + rng.uniform(-0.02, 0.02, (2, 120, 90))).reshape(2, -1)
    is_pit = (x > 3.0) & (x < 7.0) & (y > 3.0) & (y < 6.0)
    height = 580.0 + 0.02 * x - pit_m * is_pit + std * rng.standard_normal(x.shape) + common * rng.standard_normal()
    points = np.column_stack([E0 + x, N0 + y, height])
    full = np.ones(len(points))
    write_cloud(
        path, points, CRS(crs), rgb=np.zeros((len(points), 3), np.uint8), depth_m=full, std_m=std * full,
        std_common_m=common * full, num_views=3 * full.astype(int), incidence_deg=full, is_wet=full > 0,
    )  # fmt: skip
    return path


def test_a_pit_is_found_with_its_volume(tmp_path):
    before, after = write(tmp_path / "a.las", 1), write(tmp_path / "b.laz", 2, pit_m=0.4)
    json_path, tif, picture = (tmp_path / name for name in ("d.json", "d.tif", "d.png"))
    said = bathynerf(
        "change", before, after, "--resolution", "0.5", "--json", json_path, "--tif", tif, "--picture", picture
    )
    assert said.exit_code == 0, said.output
    numbers = json.loads(json_path.read_text())
    assert numbers["cut"]["area_m2"] == pytest.approx(12.0, abs=0.5)
    for kind in ("cut", "net"):
        volume, std = numbers[kind]["volume_m3"], numbers[kind]["std_m3"]
        assert abs(volume + PIT_M3) < 3.0 * std
        # What both surveys share, over the area; the rest is small against it.
        assert std == pytest.approx(np.hypot(0.005, 0.005) * numbers[kind]["area_m2"], rel=0.3)
    assert picture.read_bytes().startswith(b"\x89PNG")
    with rasterio.open(tif) as raster:
        difference, _, detection, beyond = raster.read(masked=True)
        assert raster.crs.to_epsg() == 25832 or "25832" in raster.crs.to_wkt()
    assert beyond.sum() == pytest.approx(48, abs=5)
    assert np.ma.median(difference[beyond == 1]) == pytest.approx(-0.4, abs=0.03)
    assert detection.min() > 0.0


def test_a_polygon_bounds_the_volume(tmp_path):
    before, after = write(tmp_path / "a.las", 1), write(tmp_path / "b.las", 2, pit_m=0.4)
    half = np.array([[3.0, 2.0], [5.0, 2.0], [5.0, 7.0], [3.0, 7.0], [3.0, 2.0]]) + np.array([E0, N0])
    layer = Layer("area", "Polygon", [[half]], CRS(CRS_OF_CLOUDS))
    write_geojson(tmp_path / "area.geojson", layer)
    write_geopackage(tmp_path / "area.gpkg", layer)
    found = []
    for name in ("area.geojson", "area.gpkg"):
        options = ChangeOptions(area=tmp_path / name, resolution_m=0.5, correlation_length_m=0.1)
        found.append(change_between(before, after, options).net)
    assert found[0] == found[1]
    assert found[0].area_m2 == pytest.approx(10.0)
    assert abs(found[0].volume_m3 + 0.5 * PIT_M3) < 3.0 * found[0].std_m3


@pytest.mark.parametrize("other", ["EPSG:32632+7837", "EPSG:25833+7837"])
def test_the_second_survey_is_taken_into_the_crs_of_the_first(tmp_path, other):
    before, after = write(tmp_path / "a.las", 1), write(tmp_path / "b.las", 2, pit_m=0.4)
    cloud = read_cloud(after)
    points = Reprojection.between(cloud.crs, other)(cloud.points)
    full = np.ones(len(points))
    moved = tmp_path / "c.las"
    write_cloud(
        moved, points, CRS(other), rgb=cloud.rgb, depth_m=full, std_m=0.02 * full, std_common_m=0.005 * full,
        num_views=3 * full.astype(int), incidence_deg=full, is_wet=full > 0,
    )  # fmt: skip
    options = ChangeOptions(resolution_m=0.5, correlation_length_m=0.1)
    a, b = (change_between(before, path, options).net.volume_m3 for path in (after, moved))
    # A millimetre is a step of LAS: points change cells.
    assert a == pytest.approx(b, abs=0.05)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--resolution", "0"), "--resolution is 0"),
        (("--common-correlation", "2"), "expected -1 to 1"),
        (("--tif", "d.png"), "ends in .tif"),
        (("--area", "nowhere.geojson"), "nowhere.geojson"),
        ((), "hold the same points: give two surveys"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(tmp_path, options, words):
    cloud = write(tmp_path / "a.las", 1)
    said = bathynerf("change", cloud, cloud, *options)
    assert said.exit_code == 2, said.output
    assert words in said.output


def test_a_cloud_without_stds_needs_them_stated(tmp_path):
    cloud = write(tmp_path / "a.las", 1)
    las = laspy.read(write(tmp_path / "b.las", 2))
    las.remove_extra_dims(["std", "std_common"])
    las.write(tmp_path / "plain.las")
    refused = bathynerf("change", cloud, tmp_path / "plain.las", "--resolution", "0.5")
    assert refused.exit_code == 2
    assert "--std 0.02" in refused.output
    said = bathynerf("change", cloud, tmp_path / "plain.las", "--resolution", 0.5, "--std", 0.05, "--std-common", 0.01)
    assert said.exit_code == 0, said.output


@pytest.mark.parametrize(("began", "is_said"), [("2026-05-01T10:00", True), ("2026-06-01T10:00", False), (None, False)])
def test_two_runs_of_one_flight_are_said_to_be(tmp_path, began, is_said):
    for name, first in (("a", "2026-05-01T10:00"), ("b", began)):
        report = {"taken": {"first": first}, "photographs": [{"name": "1.jpg"}, {"name": f"{name}.jpg"}]}
        (tmp_path / name).mkdir()
        (tmp_path / name / "report.json").write_text(json.dumps(report))
    said = shared_photographs(tmp_path / "a", tmp_path / "b")
    assert [text.startswith("both runs are of the flight of 2026-05-01T10:00 and share 1 phot") for text in said] == (
        [True] if is_said else []
    )
    assert shared_photographs(tmp_path / "a", tmp_path / "cloud.las") == []
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "report.json").write_text(json.dumps({"photographs": [{"name": "1.jpg"}]}))
    shutil.copytree(tmp_path / "c", tmp_path / "d")
    (said,) = shared_photographs(tmp_path / "c", tmp_path / "d")
    assert said.startswith("both runs have 1 photographs of the same names, without a time: if they are of one flight")


def test_volumes_after_an_alignment_on_stable_ground_hold_the_truth():
    held, shifts = [], []
    for seed in range(200):
        differences, _ = drawn(seed, common=(0.05, 0.1))
        stable = np.zeros(SHAPE, dtype=bool)
        stable[38:, :] = True
        area = differences.is_known & (np.arange(SHAPE[0])[:, None] < 34)
        true = SIDE**2 * (drawn(seed, common=(0.0, 0.0))[0].height - own_errors(seed))[area].sum()
        again, found = align(differences, stable, Correlation(1.0, LENGTH))
        low, high = volume_of(again, area, Correlation(1.0, LENGTH)).interval95_m3
        held.append(low <= true <= high)
        shifts.append(found.shift_m)
        assert found.std_m < 0.02
    assert 0.90 <= np.mean(held) <= 0.99
    # What the surveys had in common was of this size, and is gone.
    assert np.std(shifts) == pytest.approx(np.hypot(0.05, 0.1), rel=0.2)


def own_errors(seed):
    """Errors of the cells of `drawn`."""
    rng = np.random.default_rng(seed)
    rng.standard_normal(2)
    x = np.mgrid[: SHAPE[0], : SHAPE[1]][1] * SIDE
    return (0.03 + 0.02 * (x / x.max())) * exponential_errors(rng, 1)[0]


def test_what_is_common_and_grows_over_a_survey_stays_after_an_alignment():
    differences, _ = drawn(5)
    growing = np.hypot(0.02, 0.05 * np.linspace(0.0, 1.0, SHAPE[1]))[None, :] * np.ones(SHAPE)
    differences = Differences(differences.height, differences.std, np.stack([growing, 0.0 * growing]), 0.0, SIDE)
    again, found = align(differences, np.arange(SHAPE[1]) < 8 * np.ones(SHAPE, dtype=int), Correlation(1.0, LENGTH))
    assert again.common[0, 0, 0] == pytest.approx(found.std_m, rel=0.2)
    assert again.common[0, 0, -1] == pytest.approx(np.hypot(0.05, found.std_m), rel=0.02)


def test_two_surveys_are_aligned_on_polygons(tmp_path):
    before, after = write(tmp_path / "a.las", 1), write(tmp_path / "b.las", 2, pit_m=0.4, common=0.3)
    bank = np.array([[7.5, 0.5], [11.5, 0.5], [11.5, 8.5], [7.5, 8.5], [7.5, 0.5]]) + np.array([E0, N0])
    write_geojson(tmp_path / "stable.geojson", Layer("stable", "Polygon", [[bank]], CRS(CRS_OF_CLOUDS)))
    options = ("--resolution", 0.5, "--stable", tmp_path / "stable.geojson", "--json", tmp_path / "d.json")
    said = bathynerf("change", before, after, *options)
    assert said.exit_code == 0, said.output
    assert "of stable ground" in said.output
    numbers = json.loads((tmp_path / "d.json").read_text())
    assert abs(numbers["net"]["volume_m3"] + PIT_M3) < 3.0 * numbers["net"]["std_m3"] < 1.0
    assert numbers["alignment"]["std_m"] < 0.005
    far = Layer("stable", "Polygon", [[bank + 900.0]], CRS(CRS_OF_CLOUDS))
    write_geojson(tmp_path / "stable.geojson", far)
    refused = bathynerf("change", before, after, *options)
    assert refused.exit_code == 2
    assert "0 cells of both surveys lie in it" in refused.output


def polygon_file(path, *corners):
    """Polygons by name, each a box (west, south, east, north) [m] from the corner of the clouds of `write`."""
    boxes = [np.array([[w, s], [e, s], [e, n], [w, n], [w, s]]) + np.array([E0, N0]) for w, s, e, n in corners]
    names = [f"{number}. area, $\\frac" for number in range(1, len(boxes) + 1)]
    write_geojson(path, Layer("areas", "Polygon", [[box] for box in boxes], CRS(CRS_OF_CLOUDS), {"name": names}))
    return names


@pytest.fixture(scope="module")
def epochs(tmp_path_factory):
    """Three runs: the bed, a pit of 0.2 m, and one of 0.4 m, half a year apart."""
    folder, paths = tmp_path_factory.mktemp("series"), []
    for number, (taken, pit_m) in enumerate((("2025-03-15", 0.0), ("2025-09-15", 0.2), ("2026-03-15", 0.4))):
        with RunDir(folder / taken) as run:
            write(run.cloud_path, number + 1, pit_m=pit_m)
            write_json(run.report_json_path, {"taken": {"first": f"{taken}T10:00:00"}})
        paths.append(folder / taken)
    return paths


def test_a_series_has_the_volume_of_each_survey_over_the_first_in_each_polygon(epochs, tmp_path):
    names = polygon_file(tmp_path / "areas.geojson", (2.0, 2.0, 8.0, 7.0), (8.5, 1.0, 11.5, 8.0))
    out, areas = tmp_path / "out", tmp_path / "areas.geojson"
    said = bathynerf("change", *epochs, "--area", areas, "--resolution", 0.5, "-o", out)
    assert said.exit_code == 0, said.output
    with (out / "series.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["area"] for row in rows] == ["all", "all", *(name for name in names for _ in range(2))]
    assert [row["taken"] for row in rows] == ["2025-09-15T10:00:00", "2026-03-15T10:00:00"] * 3
    for row, pit_m3 in zip(rows, [0.5 * PIT_M3, PIT_M3] * 2 + [0.0, 0.0], strict=True):
        volume, std, area = (float(row[name]) for name in ("net_m3", "net_std_m3", "area_m2"))
        assert abs(volume + pit_m3) < 3.0 * std
        # What all cells of a survey share does not average out, however many they are.
        assert float(row["mean_std_m"]) == pytest.approx(std / area, rel=1e-3)
        assert np.hypot(0.005, 0.005) < std / area < 1.3 * np.hypot(0.005, 0.005)
        assert float(row["mean_m"]) == pytest.approx(volume / area, abs=1e-5)
    assert (out / "series.png").read_bytes().startswith(b"\x89PNG")
    assert "2026-03-15" in said.output
    again = bathynerf("change", *epochs, "--area", areas, "--resolution", 0.5, "-o", out)
    assert again.exit_code == 0, again.output


def test_a_series_of_two_is_what_change_says_of_them(epochs):
    options = ChangeOptions(resolution_m=0.5, correlation_length_m=0.1)
    (epoch,) = change_series(epochs[::2], options=options)
    assert epoch.net == change_between(epochs[0], epochs[2], options).net


def test_surveys_of_a_series_count_in_the_cells_that_all_cover(epochs, tmp_path):
    las = laspy.read(epochs[2] / "cloud.las")
    las.points = las.points[las.x < E0 + 9.0]
    las.write(tmp_path / "half.las")
    options = ChangeOptions(resolution_m=0.5, correlation_length_m=0.1)
    found = change_series([*epochs[:2], tmp_path / "half.las"], tmp_path / "out", options)
    assert {epoch.net.area_m2 for epoch in found} == {81.0}
    assert found[1].taken is None


@pytest.mark.parametrize(
    ("option", "name", "words"),
    [
        ("--tif", "d.tif", "--tif shows two surveys, and 3 are given"),
        ("-o", "taken", "exists and is not a series"),
        ("--area", "far.geojson", "no cell that both surveys cover"),
    ],
)
def test_a_series_that_cannot_be_is_refused(epochs, tmp_path, option, name, words):
    polygon_file(tmp_path / "far.geojson", (900.0, 900.0, 950.0, 950.0))
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "series.csv").write_text("mine")
    said = bathynerf("change", *epochs, option, tmp_path / name)
    assert said.exit_code == 2, said.output
    assert words in " ".join(said.output.split())


def test_a_survey_named_twice_in_a_series_is_refused(epochs):
    with pytest.raises(SurveyError, match="hold the same points"):
        change_series([*epochs, epochs[1]])


@pytest.mark.parametrize(
    ("volume", "text"),
    [
        (Volume(-3.4945, 1.004, 85.0), "−3.5 m³ ± 2.0 m³ (95 %) over 85 m²"),
        (Volume(0.007254, 0.5738, 50.0), "+0.0 m³ ± 1.1 m³ (95 %) over 50 m²"),
        (Volume(12345.6, 78.2, 9000.0), "+12346 m³ ± 153 m³ (95 %) over 9000 m²"),
    ],
)
def test_a_volume_has_the_digits_of_its_uncertainty(volume, text):
    assert volume_text(volume) == text
