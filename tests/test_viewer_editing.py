"""Points marked, deleted and classified in the scene, what stands over it, and what is saved of it."""

import json
import urllib.error
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest
from shown_run import served, small_run
from small_bed import SLOPE

from refract import PinholeCamera
from survey.display.quantities import share
from survey.errors import SurveyError
from survey.export.export import cloud_of
from survey.run.edits import DELETED, Edits
from survey.run.folder import run_in
from survey.viewer.editing import rows_in_box
from survey.viewer.page import Overlay, address, overlay_of
from survey.viewer.session import ViewOptions, _load
from survey.viewer.shown import CLASS, MARKED
from survey.viewer.sightings import profile_of, write_lines
from survey.viewer.tree import pick
from survey.viewer.volumes import volume_rows, volumes_in

# From x right, y down, z forward to east, south, down: north is up on the screen.
UP = np.array([0.0, 0.0, 5.0])
DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])


@pytest.fixture
def run(tmp_path):
    return small_run(tmp_path)


@pytest.fixture
def session(run):
    with served(_load(run, ViewOptions())) as session:
        yield session


def above(shown, cam_from_local=DOWN):
    """A screen of 900 x 600 pixels 5 m over the middle of the cloud."""
    return PinholeCamera(shown.middle + UP, cam_from_local, 700.0, 700.0, 450.0, 300.0, 900, 600)


def browser_above(shown):
    """A browser with the view of `above`, and what it is told."""
    told = []
    camera = SimpleNamespace(
        wxyz=(0.0, 1.0, 0.0, 0.0), position=shown.middle + UP, fov=2.0 * np.arctan(300.0 / 700.0),
        aspect=1.5, image_height=600,
    )  # fmt: skip
    client = SimpleNamespace(camera=camera, told=told)
    client.add_notification = lambda *words, **_: told.append(words) or SimpleNamespace(remove=lambda: None)
    client.send_file_download = lambda name, content, **_: told.append((name, content))
    return client


def box(session, low=(0.4, 0.4), high=(0.6, 0.6)):
    event = SimpleNamespace(client=browser_above(session.shown), screen_min=low, screen_max=high)
    session.editing._box(event)
    return np.flatnonzero(session.shown.is_marked)


def press(session, work):
    client = browser_above(session.shown)
    session.editing._answering(work)(SimpleNamespace(client=client))
    return client.told


def test_a_box_holds_all_points_whose_pixels_it_holds(session):
    shown, low, high = session.shown, np.array([0.3, 0.45]), np.array([0.5, 0.9])
    camera = above(shown)
    pixels = camera.project(shown.tree.points, None)
    expected = ((pixels >= low * [900, 600]) & (pixels <= high * [900, 600])).all(axis=1)
    rows = rows_in_box(shown, camera, low, high)
    assert sorted(rows.tolist()) == np.flatnonzero(expected).tolist()
    assert 10 < len(rows) < len(shown.tree.points)
    np.testing.assert_array_equal(np.flatnonzero(shown.is_marked), [])
    marked = box(session, low, high)
    np.testing.assert_array_equal(marked, np.sort(rows))
    assert (shown.colours("colour", marked, None) == MARKED).all()


def test_deleted_points_are_met_by_nothing_and_come_back(session, run):
    shown, rows = session.shown, box(session)
    points, revision = shown.tree.points.copy(), shown.revision.copy()
    ray = {"origin": shown.middle + UP, "direction": np.array([0.0, 0.0, -1.0])}
    assert pick(shown.tree, **ray, angle=0.005, least_m=0.05) in rows
    press(session, lambda: session.editing._change(shown.edits.delete))
    assert (Edits(run).classes[rows] == DELETED).all()
    assert pick(shown.tree, **ray, angle=0.005, least_m=0.05) is None
    drawn = np.concatenate([shown.rows(node) for node in range(len(shown.tree))])
    assert sorted(drawn.tolist()) == np.setdiff1d(np.arange(len(points)), rows).tolist()
    assert shown.num_shown.sum() == len(drawn)
    assert (shown.revision[shown.tree.nodes_of(rows)] > revision[shown.tree.nodes_of(rows)]).all()
    assert len(box(session)) == 0
    press(session, session.editing._undo)
    np.testing.assert_array_equal(shown.tree.points, points)
    assert not Edits(run).path.exists()


def test_a_scene_opens_with_the_edits_of_before(run):
    Edits(run).delete(np.arange(30))
    shown = _load(run, ViewOptions())
    assert np.isnan(shown.tree.points[:30]).all()
    assert np.isfinite(shown.tree.points[30:]).all()
    assert shown.num_shown.sum() == len(shown.tree.points) - 30


def test_a_polygon_of_clicks_is_classified(session, run):
    shown = session.shown
    told = press(session, session.editing.mark_polygon)
    assert "three corners or more" in told[0][1]
    corners = shown.middle[:2] + np.array([[-0.8, -0.8], [0.8, -0.8], [0.8, 0.8], [-0.8, 0.8]])
    for x, y in corners:
        origin = (x, y, shown.middle[2] + 5.0)
        session.editing._corner(
            SimpleNamespace(client=browser_above(shown), ray_origin=origin, ray_direction=(0.0, 0.0, -1.0))
        )
    clicked = np.array(session.editing._corners)
    assert session.server.scene.get_handle_by_name("/polygon").points.shape == (4, 2, 3)
    session.editing._class.value = "7 noise"
    press(session, session.editing.mark_polygon)
    rows = np.flatnonzero(shown.is_marked)
    low, high = clicked[:, :2].min(axis=0), clicked[:, :2].max(axis=0)
    plan = shown.tree.points[:, :2]
    # Corners are points of a grid, which lie on the border.
    assert ((plan[rows] >= low - 1e-6) & (plan[rows] <= high + 1e-6)).all()
    assert len(rows) >= ((plan > low + 1e-6) & (plan < high - 1e-6)).all(axis=1).sum() > 0
    press(session, lambda: session.editing._change(lambda some: shown.edits.classify(some, 7)))
    assert (Edits(run).classes[rows] == 7).all()
    red = shown.colours(CLASS, rows, None)
    assert (red[:, 0] > red[:, 1]).all()
    assert not shown.edits.is_bed[rows].any()


def test_volumes_in_a_polygon_are_shown_and_saved(session):
    # No multiple of a cell of 0.4 m.
    shown, editing, half = session.shown, session.editing, 0.73
    assert "three corners or more" in press(session, editing.measure_polygon)[0][1]
    x, y, z = shown.middle
    shown.columns["std_common"] = np.full(len(shown.tree.points), 0.02)
    # A plane 10 cm under that of the bed.
    corners = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    editing._corners = [np.array([x + a, y + b, z + SLOPE * a - 0.1]) for a, b in corners]
    press(session, editing.measure_polygon)
    (_, found), middle = editing._measured[0], np.abs(shown.tree.points[:, :2] - (x, y)).max(axis=1) < half
    assert found["area_m2"] == pytest.approx(4.0 * half**2)
    assert found["with_points_m2"] == pytest.approx(4.0 * half**2, rel=1e-9)
    assert found["covered_share"] == pytest.approx(1.0)
    assert found["bed_over_plane_m3"] == pytest.approx(0.1 * found["with_points_m2"], rel=0.02)
    assert found["bed_under_plane_m3"] == 0.0
    depth = np.mean(shown.columns["depth"][middle])
    assert found["water_m3"] == pytest.approx(depth * found["with_points_m2"], rel=0.02)
    assert found["water_std_m3"] == pytest.approx(0.02 * found["with_points_m2"])
    assert "errors that all heights share" in editing._volumes.content
    client = browser_above(shown)
    editing._save_volumes(SimpleNamespace(client=client))
    (name, content) = client.told[-1]
    (feature,) = json.loads(content)["features"]
    assert (name, feature["geometry"]["type"]) == ("volumes.geojson", "Polygon")
    assert feature["properties"]["water_m3"] == pytest.approx(found["water_m3"], abs=1e-4)


def test_volumes_of_a_strip_narrower_than_a_cell_and_of_a_gap_say_what_they_cover(session):
    shown, (x, y, z) = session.shown, session.shown.middle
    square = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    strip = volumes_in(shown, shown.middle + square * (0.5, 0.07, 1.0))
    assert (strip["area_m2"], strip["covered_share"]) == (pytest.approx(0.14), pytest.approx(1.0))
    near = np.abs(shown.tree.points[:, :2] - (x, y)).max(axis=1) < 0.5
    depth = np.mean(shown.columns["depth"][near])
    assert strip["water_m3"] == pytest.approx(0.14 * depth, rel=0.05)
    high = volumes_in(shown, shown.middle + square * (0.5, 0.07, 1.0) + (0.0, 0.0, 5.0))
    assert str(high["bed_over_plane_m3"]) == "0.0"
    # A half of the square is outside of the cloud.
    edge = np.array([shown.high[0], y, z])
    beside = volumes_in(shown, edge + square)
    assert beside["covered_share"] == pytest.approx(0.5, abs=0.2)  # By a cell of 0.4 m at the edge of the cloud, of 2 m
    assert ("share of the area that the volumes cover", share(beside["covered_share"])) in volume_rows(beside)
    with pytest.raises(SurveyError, match="no point of the bed lies in the polygon"):
        volumes_in(shown, shown.middle + np.array([[-0.5, 0, 0], [0.5, 0, 0], [0.0, 0, 0]]))


def test_saved_points_lie_in_the_run_folder(session, run):
    box(session)
    press(session, lambda: session.editing._change(session.shown.edits.delete))
    client = browser_above(session.shown)
    session.editing._save(SimpleNamespace(client=client))
    assert client.told[-1] == ("save as LAS", f"the points with all edits are in {run / 'edits' / 'cloud.las'}")
    assert cloud_of(run).is_relative_to(run)


def test_what_cannot_be_saved_is_said_in_the_browser(session, run):
    box(session)
    Edits(run).delete(np.array([0]))
    told = press(session, lambda: session.editing._change(session.shown.edits.delete))
    assert "changed by somebody else" in told[0][1]


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, -135.0])
def test_the_overlay_has_azimuth_scale_and_place(session, azimuth_deg):
    shown, turn = session.shown, np.radians(azimuth_deg)
    # What is up on the screen has this azimuth.
    up = np.array([np.sin(turn), np.cos(turn), 0.0])
    camera = above(shown, np.array([np.cross(up, [0.0, 0.0, 1.0]), -up, [0.0, 0.0, -1.0]]))
    found = overlay_of(shown, camera, 0.5, 0.5)
    assert found["azimuth_deg"] == pytest.approx(azimuth_deg)
    row = pick(shown.tree, camera.centre, np.array([0.0, 0.0, -1.0]), angle=3.0 / 700.0, least_m=0.05)
    assert found["m_per_px"] == pytest.approx((camera.centre[2] - shown.tree.points[row, 2]) / 700.0)
    east = shown.flight.frame.crs_from_local(shown.tree.points[row][None])[0, 0]
    assert f"easting {east:.3f}" in found["place"].replace("\u202f", "")
    assert overlay_of(shown, camera, 0.5, -40.0)["place"] == ""


def test_a_tilted_view_looks_where_the_compass_says(session):
    # 45 degrees down to the east.
    half = 0.5**0.5
    camera = above(session.shown, np.array([[0.0, -1.0, 0.0], [-half, 0.0, -half], [half, 0.0, -half]]))
    assert overlay_of(session.shown, camera, 0.5, 0.5)["azimuth_deg"] == pytest.approx(90.0)


def test_the_overlay_answers_no_nonsense_and_only_those_who_know_the_token(session):
    overlay = Overlay()
    assert overlay.answer("here", {"number": "0", "x": "0", "y": "0"}) == "{}"
    overlay.attach(session)
    for asked in ({}, {"number": "9", "x": "0", "y": "0"}, {"number": "<b>", "x": "0", "y": "0"}, {"number": "0"}):
        assert overlay.answer("here", asked) == "{}"
    page = address(session.server, "localhost")
    with urllib.request.urlopen(page) as answer:
        text = answer.read()
    assert text.count(b"bathynerf-overlay") == 1
    with urllib.request.urlopen(f"{page}here?number=77&x=0.5&y=nan") as answer:
        assert answer.read() == b"{}"
    with pytest.raises(urllib.error.HTTPError, match="403") as refused:
        urllib.request.urlopen(f"{page[:-3]}/here?number=0&x=0.5&y=0.5")
    refused.value.close()


def test_measured_lines_are_saved_as_geojson_and_the_last_one_has_a_profile(session, tmp_path):
    shown = session.shown
    ends = np.array([[-1.0, 0.0], [1.0, 0.0]])
    lines = [tuple(np.column_stack([shown.middle[:2] + ends * way, [0.0, 0.3]])) for way in (1.0, 0.5)]
    write_lines(tmp_path / "a.geojson", shown, lines)
    features = json.loads((tmp_path / "a.geojson").read_text())["features"]
    assert [feature["properties"]["in_plan_m"] for feature in features] == [2.0, 1.0]
    assert features[0]["properties"]["distance_m"] == pytest.approx(np.hypot(2.0, 0.3), abs=1e-4)
    profile = profile_of(shown, lines)
    # The scale of the grid is within 0.0004 of that of the ground.
    assert profile.distance[-1] == pytest.approx(1.0, abs=2e-3)
    bed = profile.bed[np.isfinite(profile.bed)]
    assert len(bed) > 3
    assert np.ptp(bed) < 0.2


def test_a_browser_gets_what_was_measured(session):
    shown, clicks = session.shown, session.clicks
    start, end = shown.tree.points[0].copy(), shown.tree.points[5].copy()
    clicks._lines.append((start, end))
    client = browser_above(shown)
    for kind in clicks._save.options:
        clicks._save.value = kind
        clicks._hand_out(SimpleNamespace(client=client))
    sent = {name: content for name, content in client.told if name != "line"}
    assert list(sent) == ["lines.geojson", "profile.csv"]
    assert sent["lines.geojson"].startswith(b"{")
    assert sent["profile.csv"].startswith(b"line,distance_m")
    assert clicks._picture.visible


def test_the_folder_of_a_survey_stands_for_its_run(run, tmp_path):
    (tmp_path / "survey").mkdir()
    assert run_in(tmp_path / "survey") == tmp_path / "survey"
    run.rename(tmp_path / "survey" / "bathynerf")
    assert run_in(tmp_path / "survey") == tmp_path / "survey" / "bathynerf"
    assert run_in(tmp_path / "survey" / "bathynerf") == tmp_path / "survey" / "bathynerf"
    with pytest.raises(SurveyError, match="is no run folder"):
        Edits(tmp_path)
