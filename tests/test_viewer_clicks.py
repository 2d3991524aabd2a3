"""What clicks show and what layers are made of: references, terrain, texts, and the page for others."""

import html
import re
from types import SimpleNamespace

import numpy as np
import pytest
from shown_run import served, shown_of
from small_bed import SLOPE, write_plane_mesh
from small_survey import small_survey

from geo.errors import GeoError
from survey.errors import OutputError, SurveyError
from survey.files.paths import ReadFiles
from survey.folder.survey import load_survey
from survey.viewer.layers import OnDemand
from survey.viewer.page import require_page, thinned, write_page
from survey.viewer.shown import LocalReference, load_reference
from survey.viewer.sightings import DISTANCE, RAYS, distance_between, facts_of
from survey.viewer.tree import build_tree

RAISED_M = 0.04


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """The plane, with a reference that lies 4 cm above it."""
    folder = tmp_path_factory.mktemp("clicks")
    shown = shown_of(folder / "s", num=140)
    survey = load_survey(folder / "s")
    path = write_plane_mesh(folder / "plane.ply", survey, raised_m=RAISED_M)
    shown.reference = load_reference(path, survey.frame, survey.frame.crs_from_local(shown.tree.points[::50]))
    shown.measure_errors()
    return shown


@pytest.fixture(scope="module")
def session(shown):
    with served(shown) as session:
        yield session


def test_errors_are_distances_below_a_raised_plane(shown):
    # Along the normal of the plane; its corners in the file have millimetres' thousandths.
    expected = -RAISED_M / np.sqrt(1.0 + SLOPE**2)
    np.testing.assert_allclose(shown.columns["error"], expected, atol=2e-5)


def test_a_reference_of_points_is_looked_up_between_them():
    x, y = (v.ravel() for v in np.meshgrid(np.arange(40) * 0.25, np.arange(40) * 0.25))
    plane = np.column_stack([x, y, 0.1 * x])
    reference = LocalReference(None, plane, None)
    places = np.array([[3.1, 4.2, 5.0], [8.03, 1.9, -5.0], [-30.0, 0.0, 0.0]])
    np.testing.assert_allclose(reference.errors(places)[:2], places[:2, 2] - 0.1 * places[:2, 0], atol=1e-9)


def test_a_reference_of_another_place_is_refused(shown, tmp_path):
    other = load_survey(small_survey(tmp_path / "o"))
    path = write_plane_mesh(tmp_path / "plane.ply", other, raised_m=0.0)
    with pytest.raises(GeoError):
        load_reference(path, other.frame, other.frame.crs_from_local(shown.tree.points[:5] + np.array([5e4, 0.0, 0.0])))


def test_the_facts_of_a_point_are_those_of_the_cloud(shown):
    row = 4321
    facts = dict(facts_of(shown, row))
    east, north, height = shown.flight.frame.crs_from_local(shown.tree.points[row][None])[0]
    assert (float(facts["easting"]), float(facts["northing"])) == pytest.approx((east, north), abs=6e-4)
    assert float(facts["height"]) == pytest.approx(height, abs=6e-4)
    assert facts["distance to the reference"] == "−40.0\u00a0mm"
    assert distance_between(np.zeros(3), np.array([3.0, 4.0, -12.0])) == [
        ("distance", "13.00\u00a0m"), ("in plan", "5.000\u00a0m"), ("height difference", "−12.00\u00a0m"),
    ]  # fmt: skip


def click(session, row: int) -> None:
    """A click on a point, seen from straight above."""
    point = session.shown.tree.points[row]
    above = point + np.array([0.0, 0.0, 5.0])
    camera = SimpleNamespace(wxyz=(0.0, 1.0, 0.0, 0.0), position=above, fov=0.8, aspect=1.5)
    camera.image_height = 900
    ray = {"ray_origin": tuple(above), "ray_direction": (0.0, 0.0, -1.0)}
    session.clicks._clicked(SimpleNamespace(client=SimpleNamespace(camera=camera), **ray))


def test_a_click_shows_rays_and_windows_and_the_next_one_replaces_them(session):
    scene, middle = session.server.scene, len(session.shown.tree.points) // 2
    session.clicks._does.value = RAYS
    for row in (middle, middle + 3):
        click(session, row)
        air, water = (scene.get_handle_by_name(f"/click/{leg}") for leg in ("air", "water"))
        assert air.points.shape == water.points.shape
        np.testing.assert_allclose(
            water.points[:, 1], np.broadcast_to(session.shown.tree.points[row], (len(water.points), 3)), atol=1e-6
        )
        np.testing.assert_array_equal(air.points[:, 1], water.points[:, 0])
    assert session.clicks._picture.visible
    session.clicks.clear()
    assert scene.get_handle_by_name("/click/air") is None
    assert not session.clicks._picture.visible


def test_two_clicks_measure(session):
    session.clicks.clear()
    session.clicks._does.value = DISTANCE
    middle = len(session.shown.tree.points) // 2
    click(session, middle)
    assert "click a second point" in session.clicks._text.content
    click(session, middle + 20)
    # Twenty points of a row 0.1 m apart.
    assert "| in plan | 2.000\u00a0m |" in html.unescape(session.clicks._text.content)


def test_a_layer_is_made_once_and_when_it_is_asked_for(session):
    made = []
    layer = OnDemand(session.server, "mesh", lambda: made.append(1) or SimpleNamespace(visible=True))
    layer.show(False)
    assert made == []
    layer.show(True)
    layer.show(False)
    layer.show(True)
    assert made == [1]


def test_a_layer_that_cannot_be_computed_is_told_in_the_browser_and_tried_again():
    said, made = [], []

    def notify(*words, **_):
        said.append(words)
        return SimpleNamespace(remove=lambda: None)

    def make():
        made.append(1)
        raise SurveyError("the cloud has no surface")

    server = SimpleNamespace(get_clients=lambda: {0: SimpleNamespace(add_notification=notify)})
    layer = OnDemand(server, "mesh", make)
    layer.show(True)
    layer.show(False)
    layer.show(True)
    assert said.count(("mesh", "the cloud has no surface")) == len(made) == 2


@pytest.mark.parametrize("most", [10**9, 9000, 500])
def test_a_thinned_cloud_is_even(most):
    points = np.random.default_rng(2).uniform([0.0, 0.0, 0.0], [10.0, 10.0, 0.1], (90_000, 3))
    rows = thinned(build_tree(points), most)
    assert len(rows) == len(set(rows.tolist()))
    assert min(most, 90_000) * 0.3 < len(rows) <= most
    counts, *_ = np.histogram2d(*points[rows, :2].T, bins=4)
    assert counts.min() > 0.4 * counts.mean()


def test_a_page_of_a_thinned_cloud_says_of_how_many_points(shown, tmp_path, monkeypatch):
    monkeypatch.setattr("survey.viewer.page.MOST_POINTS", 100)
    write_page(tmp_path / "thin.html", shown)
    assert re.search(r"<br>100 of [\d\u202f]{4,} points, ", (tmp_path / "thin.html").read_text())


def test_a_page_has_all_in_one_file(shown, tmp_path):
    path = tmp_path / "view.html"
    require_page(path, ReadFiles())
    write_page(path, shown)
    text = path.read_text()
    assert "<title>small</title>" in text
    assert re.search(r">small</b><br>[\d\u202f]+ points, .*height</div>", text)
    assert "__VISER_EMBED_DATA__=" in text
    require_page(path, ReadFiles())
    (tmp_path / "own.html").write_text("<html>mine</html>")
    for name, why in (("own.html", "is not a page that view wrote"), ("a.txt", r"ends in \.html")):
        with pytest.raises(OutputError, match=why):
            require_page(tmp_path / name, ReadFiles())
