"""A survey and its run as objects: from the folder to cloud, terrain model, profile and picture."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import fake_module
from drawn_runs import drawn
from matplotlib.figure import Figure

import bathynerf
from bathynerf import CompareOptions, ExportOptions, GeoError, LoadedSurvey, Run, Survey, SurveyError
from survey.progress import Progress


@pytest.fixture(scope="module")
def survey(tmp_path_factory) -> Survey:
    return Survey.open(drawn(tmp_path_factory.mktemp("handles") / "pond", num_views=7, size_m=(2.4, 2.0)).folder)


@pytest.fixture(scope="module")
def run(survey) -> Run:
    with Progress(verbosity=-1):
        return survey.process(quality="draft", field="off")


def middle_of(run: Run) -> np.ndarray:
    low, high = run.cloud.points[:, :2].min(axis=0), run.cloud.points[:, :2].max(axis=0)
    return np.array([low + 0.25 * (high - low), low + 0.75 * (high - low)])


def test_a_survey_says_what_it_has_before_anything_is_computed(survey):
    assert isinstance(survey.load(), LoadedSurvey)
    assert [section.title for section in survey.check(quality="draft")][:2] == ["Found", "Plan"]
    shown = survey._repr_html_()
    assert "<th style='text-align: left'>photographs</th><td style='text-align: left'>7</td>" in shown
    with pytest.raises(SurveyError, match="does not exist"):
        Survey.open("no/such/folder")


def test_a_run_has_cloud_report_and_verdict(survey, run):
    assert repr(run) == f"Run({str(survey.folder / 'bathynerf')!r})"
    assert (run.passed, run.report["plan"]["quality"]) == (True, "draft")
    assert len(run.cloud.points) == run.report["cloud"]["points"] > 1000
    assert survey.run().folder == run.folder == Run.open(run.folder).folder
    assert run.report_path.is_file()
    with pytest.raises(SurveyError, match="is no run folder"):
        Run.open(survey.folder)


def test_a_terrain_model_is_that_of_the_cloud(run):
    dem = run.dem(0.1)
    known = np.isfinite(dem.height)
    assert 0.3 < known.mean() < 1.0
    low, high = run.cloud.points[:, 2].min(), run.cloud.points[:, 2].max()
    assert (dem.height[known].min() > low - 0.1, dem.height[known].max() < high + 0.1) == (True, True)
    assert (dem.num_points[~known] == 0).all()
    assert np.asarray(dem).shape == dem.height.shape == (len(dem.north), len(dem.east))
    assert dem.crs == run.cloud.crs or dem.crs.name == run.cloud.crs.name
    assert (np.diff(dem.east) > 0.0).all()
    assert (np.diff(dem.north) < 0.0).all()
    # Each cell against the median of the points in it.
    column = np.round((run.cloud.points[:, 0] - dem.east[0]) / 0.1).astype(int)
    row = np.round((dem.north[0] - run.cloud.points[:, 1]) / 0.1).astype(int)
    many = np.argwhere(known & (dem.num_points > 8))
    assert len(many) > 100
    medians = [np.median(run.cloud.points[(row == r) & (column == c), 2]) for r, c in many[::20]]
    assert np.median(np.abs(medians - dem.height[known & (dem.num_points > 8)][::20])) < 0.02
    assert np.isfinite(dem.std[known]).all()
    for layer in (dem.std, dem.std_common, dem.depth):
        assert not np.isfinite(layer[~known]).any()


def test_a_profile_is_drawn_beside_the_true_bed(survey, run):
    truth = survey.folder / "truth" / "reference.ply"
    profile = run.profile(middle_of(run), reference=truth)
    assert np.isfinite(profile.bed).mean() > 0.9
    assert abs(np.nanmedian(profile.error)) < 0.02
    own = run.plot_profile(middle_of(run), reference=truth, name="A-B")
    assert isinstance(own, Figure)
    assert own.axes[0].get_title(loc="left") == "A-B"
    figure = Figure()
    axes = figure.subplots()
    assert run.plot_profile(middle_of(run), axes=axes) is figure
    assert axes.lines
    assert abs(run.compare(truth, CompareOptions(tolerances_m=(0.1,))).distances.median_m) < 0.02


@pytest.mark.parametrize("line", [[], [1.0, 2.0], [[1.0, 2.0]], [[1.0, 2.0], [np.nan, 1.0]], [[1, 2, 3], [4, 5, 6]]])
def test_what_is_no_line_is_refused(run, line):
    with pytest.raises(SurveyError, match="expected two places or more as"):
        run.profile(line)


def test_products_are_written_and_notebooks_get_a_picture(run, tmp_path):
    assert run.export(ply=tmp_path / "bed.ply") == [tmp_path / "bed.ply"]
    shown = run._repr_html_()
    assert "passed" in shown
    assert re.search(r"src=\"data:image/png;base64,[A-Za-z0-9+/=]{1000,}\"", shown)


def test_other_libraries_get_the_same_numbers(run, monkeypatch):
    dem = run.dem(0.1)
    fake_module(monkeypatch, "xarray", Dataset=lambda values, coords: SimpleNamespace(values=values, coords=coords))
    made = dem.to_xarray()
    assert made.values["height"][0] == ("y", "x")
    assert made.values["height"][1] is dem.height
    assert {name: attributes["units"] for name, (_, _, attributes) in made.values.items()} == {
        "height": "metre", "std": "metre", "std_common": "metre", "num_points": "1", "depth": "metre",
    }  # fmt: skip
    assert all(attributes["long_name"] for _, _, attributes in made.values.values())
    assert made.coords["x"][1] is dem.east
    assert (made.coords["x"][2]["standard_name"], made.coords["y"][2]["units"]) == ("projection_x_coordinate", "metre")
    assert "CRS" in made.coords["spatial_ref"][2]["crs_wkt"]


def test_a_window_of_the_cloud_is_read_without_the_rest(run):
    low, high = middle_of(run)
    inside = ((run.cloud.points[:, :2] >= low) & (run.cloud.points[:, :2] <= high)).all(axis=1)
    window = run.cloud_in([*low, *high])
    # Places are stored to a millimetre, so that points on the edge may be either side.
    assert len(window.points) == pytest.approx(inside.sum(), abs=0.02 * inside.sum())
    assert 100 < inside.sum() < 0.5 * len(inside)
    assert set(window.extra) == set(run.cloud.extra)
    assert len(run.cloud_in([*(low - 100.0), *(low - 50.0)]).points) == 0
    with pytest.raises(SurveyError, match="expected E0 N0 E1 N1"):
        run.cloud_in([*high, *low])


def test_layers_and_profiles_are_frames_with_their_places(run, tmp_path):
    geopandas = pytest.importorskip("geopandas")
    footprints = run.layer("footprints")
    assert len(set(footprints["image"])) == 7
    assert set(footprints.geom_type) == {"Polygon"}
    np.testing.assert_allclose(footprints.area, footprints["area_m2"], rtol=2e-3)
    footprints.to_file(tmp_path / "a.geojson")
    assert geopandas.read_file(tmp_path / "a.geojson")["image"].tolist() == footprints["image"].tolist()
    contours = run.layer("contours", ExportOptions(interval_m=0.05, resolution_m=0.1))
    assert all(each.has_z for each in contours.geometry)
    heights, depths = [each.coords[0][2] for each in contours.geometry], np.array(contours["depth_m"])
    np.testing.assert_allclose(heights + depths, run.report["water"]["level_m"], atol=1e-3)
    profile = run.profile(middle_of(run))
    frame = profile.to_geopandas()
    assert [(each.x, each.y) for each in frame.geometry] == [tuple(place) for place in profile.places]
    np.testing.assert_array_equal(frame["bed"], profile.bed)
    assert frame.crs.is_projected


def test_a_layer_that_is_none_is_refused(run):
    with pytest.raises(SurveyError, match="expected one of footprints, shoreline, contours, unseen, checkpoints"):
        run.layer("walls")


def test_a_library_that_is_missing_is_named_with_its_extra(run, monkeypatch):
    # As the import of a module that is not there.
    for name in ("xarray", "geopandas"):
        monkeypatch.setitem(__import__("sys").modules, name, None)
    with pytest.raises(SurveyError, match=r"pip install 'bathynerf\[xarray\]'"):
        run.dem(0.1).to_xarray()
    with pytest.raises(GeoError, match=r"pip install 'bathynerf\[geopandas\]'"):
        run.layer("footprints")


def test_the_names_that_stay_are_listed():
    assert {"Survey", "Run", "Dem", "Profile", "LoadedSurvey", "profiles_along"} <= set(bathynerf.__all__)
