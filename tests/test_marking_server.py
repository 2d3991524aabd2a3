"""The page of marking and its data over HTTP: who gets them, what a click writes, and the same in a real browser."""

import io
import json
import math
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from dataclasses import replace
from http.client import HTTPConnection
from types import SimpleNamespace
from urllib.parse import quote, urlencode

import numpy as np
import pytest
from chromium import PROGRAM, page_at
from command_line import bathynerf
from control_files import odm
from PIL import Image
from small_survey import E0, LEVEL, N0, TOML, small_survey, unposed

from survey.control.formats import read_gcp_list
from survey.errors import SurveyError
from survey.folder.found import find_survey
from survey.folder.survey import load_survey
from survey.marking.mark_store import PointKey
from survey.marking.server import TILE_PX, TOKEN_HEADER, MarkingServer, PhotographTiles, pyramid
from survey.marking.session import MarkingSession
from survey.photos.images import load_mask, read_mask
from survey.run.flight import save_flight

CONTROL = '[control]\ngcps = "gcp_list.txt"\n'
# A point 0.9 m under water, as three photographs show it.
PLACE = (E0 + 3.2, N0 - 1.3, LEVEL - 0.9)


@pytest.fixture
def folder(tmp_path):
    return small_survey(tmp_path / "s", toml=TOML + CONTROL)


@pytest.fixture
def server(folder):
    with MarkingServer(MarkingSession(folder)) as running:
        threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield running
        running.shutdown()


def answer(server, path: str, body=None, **headers):
    """Status and content of a request."""
    url = f"http://127.0.0.1:{server.server_address[1]}{path}"
    data = None if body is None else json.dumps(body).encode()
    asked = urllib.request.Request(url, data, {TOKEN_HEADER: server.token, **headers})
    try:
        with urllib.request.urlopen(asked, timeout=120) as said:
            return said.status, said.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read()


def state(server, path="/state", body=None) -> dict:
    status, content = answer(server, path, body)
    assert status == 200, content
    return json.loads(content)


def point(found: dict, name: str) -> dict:
    (one,) = [each for each in found["points"] if each["name"] == name]
    return one


def test_only_who_knows_the_token_and_is_this_page_gets_an_answer(server):
    token = server.token
    assert answer(server, "/")[0] == 403
    status, page = answer(server, f"/?token={token}", **{TOKEN_HEADER: ""})
    assert status == 200
    assert b"</html>" in page
    assert answer(server, "/state")[0] == 200
    assert answer(server, "/state", **{TOKEN_HEADER: "guessed"})[0] == 403
    assert answer(server, f"/tile/0/0/0/{quote('0000.jpg')}", **{TOKEN_HEADER: ""})[0] == 403
    for path in ("/mask/0000.jpg", "/propose?kind=ground&name=p1"):
        assert answer(server, path, **{TOKEN_HEADER: "guessed"})[0] == 403
    # Another page, and a name that another page has turned to this machine.
    assert answer(server, "/state", Origin="http://elsewhere.example")[0] == 403
    assert answer(server, "/state", Host="elsewhere.example")[0] == 403
    # The end of a tunnel has another port.
    assert answer(server, "/state", Host="localhost:9000", Origin="http://localhost:9000")[0] == 200
    assert answer(server, "/undo", {}, **{TOKEN_HEADER: "guessed"})[0] == 403


def test_the_page_is_answered_while_proposals_are_searched(server, monkeypatch):
    is_decoding, is_answered, seen = threading.Event(), threading.Event(), []

    def grey(_image):
        is_decoding.set()
        seen.append(is_answered.wait(10.0))
        return np.zeros((480, 640), dtype=np.uint8)

    monkeypatch.setattr(server.session, "grey", grey)
    server.session.store.add("ground", "p7", (E0, N0, LEVEL))
    searching = threading.Thread(target=answer, args=(server, "/propose?kind=ground&name=p7"))
    searching.start()
    assert is_decoding.wait(60.0)
    state(server)
    is_answered.set()
    searching.join()
    assert all(seen)


NO_PIXELS = ([1e300, 0], [10**400, 1], [True, 1], ["1", "2"], {"a": 1}, "12", 5, [[1], [2]])


@pytest.mark.parametrize("sent", [b"[" * 90_000, b'{"a":' * 9_000, b"9" * 9_000, b"\xff\xfe", b""])
def test_a_request_that_is_no_object_is_answered_in_words(server, sent, capfd):
    url, headers = f"http://127.0.0.1:{server.server_address[1]}/mark", {TOKEN_HEADER: server.token}
    with pytest.raises(urllib.error.HTTPError, match="400") as refused:
        urllib.request.urlopen(urllib.request.Request(url, sent, headers))
    with refused.value as error:
        assert error.read().startswith(b"not understood: ")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("headers", [{"Host": "[::1"}, {"Content-Length": "\xb2"}, {"Origin": "http://[x"}])
def test_a_request_with_a_wrong_header_is_answered_in_words(server, headers, capfd):
    connection = HTTPConnection("127.0.0.1", server.server_address[1], timeout=120.0)
    connection.request("POST", "/undo", b"{}", {TOKEN_HEADER: server.token} | headers)
    answer = connection.getresponse()
    assert 400 <= answer.status < 500
    assert answer.read()
    connection.close()
    assert capfd.readouterr().err == ""


def test_bad_requests_are_answered_in_words_and_write_nothing(server, folder):
    cases = [
        ("/nothing", None, 404),
        ("/nothing", {}, 404),
        ("/mark", [], 400),
        ("/mark", {"kind": "ground", "name": "p1"}, 400),
        ("/mark", {"kind": "ground", "name": "p1", "image": "0000.jpg", "pixel": [1.0, "NaN"]}, 400),
        ("/mark", {"kind": "ground", "name": "p1", "image": "0000.jpg", "pixel": [1.0]}, 400),
        ("/mark", {"kind": "ground", "name": "p1", "image": "0000.jpg", "pixel": [1.0, 2.0]}, 422),
        ("/add", {"kind": "ground", "name": "p1", "place": None}, 422),
        ("/undo", {}, 422),
        ("/look?kind=ground&name=p1&image=0000.jpg", None, 422),
        ("/look?kind=ground", None, 400),
        ("/tile/0/0/0/..%2Fsurvey.toml", None, 422),
        ("/tile/9/0/0/0000.jpg", None, 422),
        ("/tile/x/0/0/0000.jpg", None, 400),
        *(("/mark", {"kind": "ground", "name": "p1", "image": "0000.jpg", "pixel": pixel}, 400) for pixel in NO_PIXELS),
        *(("/add", {"kind": "ground", "name": "p9", "place": place}, 400) for place in ([1e300, 0, 0], [0, 0], "abc")),
        *(
            ("/add", {"kind": "ground", "name": name, "place": None}, 422)
            for name in ("\ud800", "a\nb", "\x1b[2J", " ")
        ),
        ("/mark", {"kind": "ground", "name": "\ud800", "image": "0000.jpg", "pixel": None}, 422),
    ]
    assert [(path, answer(server, path, body)[0]) for path, body, _ in cases] == [
        (path, code) for path, _, code in cases
    ]
    assert not (folder / "gcp_list.txt").exists()


def test_the_page_knows_whether_coordinates_are_degrees_and_a_server_at_every_address_can_be_opened(server, tmp_path):
    assert not state(server)["is_geographic"]
    folder = small_survey(tmp_path / "g", toml='crs = "EPSG:4326+3855"\n', gps=True)
    (folder / "cameras.csv").unlink()
    assert MarkingSession(folder).state()["is_geographic"]
    with MarkingServer(SimpleNamespace(images={}), "0.0.0.0") as running:
        assert running.url.startswith("http://localhost:")


def test_clicks_become_marks_with_residuals_and_predictions(server, folder):
    shown = seen(folder)
    names = list(shown)
    state(server, "/add", {"kind": "ground", "name": "deep", "place": PLACE})
    key = {"kind": "ground", "name": "deep"}
    query = urlencode({**key, "image": names[0]})
    # By its coordinates, through the water.
    assert state(server, f"/look?{query}")["predicted"] == pytest.approx(shown[names[0]], abs=1e-6)
    for name in names[:2]:
        found = state(server, "/mark", {**key, "image": name, "pixel": shown[name]})
    said = point(found, "deep")
    assert said["depth_m"] == pytest.approx(0.9, abs=1e-3)
    # The file has a thousandth of a pixel; 20 m away that is 0.2 mm, and in height more by the base of the two.
    assert max(map(abs, said["off_m"])) < 3e-3
    assert max(math.hypot(*each) for each in said["residuals"].values()) < 2e-3
    look = state(server, f"/look?{urlencode({**key, 'image': names[2]})}")
    assert look["predicted"] == pytest.approx(shown[names[2]], abs=0.01)
    assert [curve["image"] for curve in look["curves"]] == names[:2]
    assert set(look["next"]) == set(names[2:])
    # A mark beside its place is told as that.
    x, y = shown[names[2]]
    found = state(server, "/mark", {**key, "image": names[2], "pixel": [x + 6.0, y]})
    assert max(math.hypot(*each) for each in point(found, "deep")["residuals"].values()) > 1.0
    found = state(server, "/undo", {})
    assert found["undone"] == {**key, "image": names[2]}
    assert list(point(found, "deep")["marks"]) == names[:2]
    # As `process` reads it.
    control = find_survey(folder).control
    assert {mark.view: mark.pixel for mark in control.merged.marks} == pytest.approx(
        {name: pytest.approx(shown[name], abs=6e-4) for name in names[:2]}
    )


def seen(folder) -> dict[str, tuple[float, float]]:
    """The pixels at which the photographs show `PLACE`."""
    (folder / "gcp_list.txt").write_text("EPSG:25832\n" + f"{E0} {N0} {LEVEL} 1 2 0000.jpg p\n")
    survey = load_survey(folder)
    (folder / "gcp_list.txt").unlink()
    local = survey.frame.local_from_crs(np.array(PLACE))
    pixels = {view.name: view.camera.project(local, survey.water) for view in survey.views}
    return {name: tuple(pixel.tolist()) for name, pixel in pixels.items() if ((pixel > 0) & (pixel < (64, 48))).all()}


def test_spots_of_the_waterline_tell_its_level(server, folder):
    survey = MarkingSession(folder)
    views = survey._views
    spot = survey._frame.local_from_crs(np.array([E0 + 3.0, N0 - 2.0, LEVEL]))
    state(server, "/add", {"kind": "water", "name": "w1"})
    key = {"kind": "water", "name": "w1"}
    names = ["0000.jpg", "0001.jpg", "0002.jpg"]
    pixels = {name: views[name].camera.project(spot, None).tolist() for name in names}
    state(server, "/mark", {**key, "image": names[0], "pixel": pixels[names[0]]})
    # One click is followed to where its ray meets the water.
    look = state(server, f"/look?{urlencode({**key, 'image': names[1]})}")
    assert look["predicted"] == pytest.approx(pixels[names[1]], abs=0.01)
    for name in names[1:]:
        found = state(server, "/mark", {**key, "image": name, "pixel": pixels[name]})
    assert point(found, "w1")["level"] == pytest.approx(LEVEL, abs=2e-3)
    assert (folder / "clicks.csv").read_text().startswith("image,x,y,name\n0000.jpg,")
    # As `process` reads it.
    toml = (folder / "survey.toml").read_text().replace(f"level_m = {LEVEL}", 'clicks = "clicks.csv"')
    (folder / "survey.toml").write_text(toml.replace(CONTROL, ""))
    assert load_survey(folder).config.water.level_m == pytest.approx(LEVEL, abs=2e-3)


def test_without_poses_photographs_are_proposed_by_their_positions(tmp_path):
    folder = unposed(tmp_path / "s")
    (folder / "gcp_list.txt").write_text(odm(images=("0000.jpg",)))
    session = MarkingSession(folder)
    found = session.state()
    assert found["poses"] is None
    assert "no poses are known yet" in " ".join(found["notes"])
    keys = [key for key in session.store.points() if key.name == "p1"]
    look = session.look(keys[0], "0003.jpg")
    assert (look["predicted"], look["curves"]) == (None, [])
    assert look["next"] == ["0001.jpg", "0002.jpg"]


def test_the_poses_of_a_finished_run_count_before_those_of_the_file(tmp_path):
    folder = small_survey(tmp_path / "s")
    survey = load_survey(folder)
    raised = replace(survey, views=tuple(_raised(view) for view in survey.views))
    (folder / "bathynerf").mkdir()
    save_flight(folder / "bathynerf", raised)
    session = MarkingSession(folder)
    assert session.state()["poses"] == f"the run {folder / 'bathynerf'}"
    session.store.add("ground", "p", PLACE)
    local = survey.frame.local_from_crs(np.array(PLACE))
    expected = raised.views[1].camera.project(local, survey.water)
    assert session.look(PointKey("ground", "p"), "0001.jpg")["predicted"] == pytest.approx(tuple(expected), abs=1e-6)
    with pytest.raises(SurveyError, match="made before runs kept their cameras"):
        MarkingSession(folder, run=tmp_path / "none")


def _raised(view):
    """A view as an adjustment may have it, half a metre higher."""
    return replace(view, camera=replace(view.camera, centre=view.camera.centre + np.array([0.0, 0.0, 0.5])))


def test_tiles_join_to_the_photograph_and_halves_keep_their_place(tmp_path):
    pixels = np.zeros((TILE_PX + 31, 2 * TILE_PX + 5, 3), dtype=np.uint8)
    pixels[:, :, 0] = np.linspace(0, 250, pixels.shape[1]).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a b.png")
    tiles = PhotographTiles({"a b.png": tmp_path / "a b.png"})
    sizes = [
        [Image.open(io.BytesIO(tiles.jpeg("a b.png", 0, column, row))).size for column in range(3)] for row in range(2)
    ]
    assert sizes == [[(512, 512), (512, 512), (5, 512)], [(512, 31), (512, 31), (5, 31)]]
    levels = pyramid(pixels)
    assert [level.shape[:2] for level in levels] == [(543, 1029), (272, 515), (136, 258)]
    # Pixel x of a level is the mean of those that begin at twice of it.
    assert abs(float(levels[1][0, 100, 0]) - pixels[:2, 200:202, 0].mean()) <= 1.0
    tile = np.asarray(Image.open(io.BytesIO(tiles.jpeg("a b.png", 0, 1, 0))))
    assert np.abs(tile[:, :, 0].astype(float) - pixels[:TILE_PX, TILE_PX : 2 * TILE_PX, 0]).max() <= 3.0


def test_the_command_prints_the_address_and_at_its_end_what_it_wrote(folder):
    (folder / "survey.toml").write_text(TOML)
    (folder / "gcp_list.txt").write_text(odm())
    code = "import sys; from survey.commands.verbs import app; app(sys.argv[1:])"
    command = [sys.executable, "-c", code, "mark", str(folder), "--no-browser"]
    # A shell in the background ignores SIGINT, and a child inherits that.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        started = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    finally:
        signal.signal(signal.SIGINT, before)
    with started as running:
        url = running.stdout.readline().strip()
        assert url.startswith("http://localhost:")
        page, _, token = url.partition("?token=")
        # The page is there before the survey is loaded, and its questions wait until then.
        for path, body in (
            ("add", {"kind": "water", "name": "w1"}),
            ("mark", {"kind": "water", "name": "w1", "image": "0000.jpg", "pixel": [5.0, 6.0]}),
        ):
            asked = urllib.request.Request(page + path, json.dumps(body).encode(), {TOKEN_HEADER: token})
            urllib.request.urlopen(asked, timeout=120).close()
        running.send_signal(signal.SIGINT)
        lines = running.communicate(timeout=120)[0].split("\n")
    assert running.returncode == 0
    assert [str(folder / "gcp_list.txt"), str(folder / "clicks.csv")] == lines[:2]
    assert 'in survey.toml: [control] gcps = "gcp_list.txt"' in lines
    assert 'in survey.toml: [water] clicks = "clicks.csv", in place of the level that is there' in lines


def test_a_survey_that_cannot_be_loaded_ends_the_command_with_a_sentence(folder):
    (folder / "survey.toml").write_text("name = ")
    found = bathynerf("mark", folder, "--no-browser")
    assert found.exit_code == 2
    assert "survey.toml" in found.stderr


def test_a_page_before_its_survey_is_loaded_says_that_it_is_loading(folder):
    with MarkingServer() as running:
        threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        assert b"loading" in answer(running, f"/?token={running.token}")[1]
        waits = threading.Thread(target=lambda: found.append(state(running)), daemon=True)
        found = []
        waits.start()
        running.show(MarkingSession(folder))
        waits.join()
        assert found[0]["name"] == "small"
        running.shutdown()


def test_the_std_of_a_point_with_a_gross_error_says_so(server, folder):
    shown = seen(folder)
    state(server, "/add", {"kind": "ground", "name": "deep", "place": PLACE})
    for name, (x, y) in shown.items():
        key = {"kind": "ground", "name": "deep", "image": name}
        good = point(state(server, "/mark", {**key, "pixel": [x, y]}), "deep")["std_m"]
    bad = point(state(server, "/mark", {**key, "pixel": [x + 3.0, y]}), "deep")
    # As the scatter of the residuals about the place has it.
    misses = sum(math.hypot(*each) ** 2 for each in bad["residuals"].values()) / (bad["limit_px"] / 3.0) ** 2
    assert bad["std_m"][2] / good[2] == pytest.approx(math.sqrt(misses / (2 * len(shown) - 3)), rel=0.2)
    assert bad["std_m"][2] > 2.0 * good[2]


def test_a_part_that_is_left_out_is_a_mask_that_the_next_run_takes(server, folder):
    corners = [[10.0, 5.0], [30.0, 5.0], [30.0, 25.0], [10.0, 25.0]]
    asked = {"image": "0001.jpg", "corners": corners, "is_used": False}
    state(server, "/mask", asked)
    state(server, "/mask", asked | {"corners": [[10.0, 5.0], [15.0, 5.0], [15.0, 25.0], [10.0, 25.0]], "is_used": True})
    (folder / "survey.toml").write_text(TOML)
    (view,) = [view for view in load_survey(folder).views if view.name == "0001.jpg"]
    assert view.mask_path == folder / "images" / "0001_mask.png"
    used = load_mask(view)
    assert not used[7:23, 17:28].any()
    assert used[:, :14].all()
    assert used[:, 32:].all()
    assert used[27:].all()
    status, content = answer(server, "/mask/0001.jpg")
    assert (status, np.asarray(Image.open(io.BytesIO(content)))[15, [2, 20]].tolist()) == (200, [255, 0])
    assert answer(server, "/mask", asked | {"image": "../survey.toml"})[0] == 400
    assert answer(server, "/mask", asked | {"corners": []})[0] == 400


def test_a_port_that_is_taken_is_an_error_in_one_sentence(server, folder):
    found = bathynerf("mark", folder, "--no-browser", "--port", server.server_address[1])
    assert found.exit_code == 2
    assert "cannot listen at localhost, port" in found.stderr


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="no Chromium is installed")
def test_clicks_in_a_real_browser_land_in_the_files(server, folder):
    rng = np.random.default_rng(3)
    marked = {}
    with page_at(server.url) as page:
        page.until("document.body && document.body.dataset.ready === '1'")
        page.value(f"change('/add', {json.dumps({'kind': 'ground', 'name': 'g', 'place': PLACE})})")
        page.value("choose({kind: 'ground', name: 'g'})")
        for name in ("0000.jpg", "0001.jpg", "0002.jpg"):
            page.value(f"open('{name}')")
            page.value("fit()")
            pixel = rng.uniform([5.0, 5.0], [59.0, 43.0]).tolist()
            count = len(marked) + 1
            page.click(*page.value(f"pageOf({pixel})"))
            page.until(f"Object.keys(pointOf(chosen).marks).length === {count}")
            marked[name] = pixel
        written = {mark.view: mark.pixel for mark in read_gcp_list(folder / "gcp_list.txt").marks}
        assert written.keys() == marked.keys()
        assert max(math.dist(written[name], marked[name]) for name in marked) < 0.1
        page.press("Delete")
        page.until("Object.keys(pointOf(chosen).marks).length === 2")
        page.press("u")
        page.until("Object.keys(pointOf(chosen).marks).length === 3")
        assert {mark.view: mark.pixel for mark in read_gcp_list(folder / "gcp_list.txt").marks} == written
        page.click(
            *page.value("(() => { const b = $('add-water').getBoundingClientRect(); return [b.x + 5, b.y + 5]; })()")
        )
        page.until("chosen.name === 'w1'")
        page.value("open('0001.jpg')")
        page.value("fit()")
        page.click(*page.value("pageOf([30.25, 20.75])"))
        page.until("Object.keys(pointOf(chosen).marks).length === 1")
        page.press("m")
        for corner in ([10, 10], [40, 10], [40, 30]):
            page.click(*page.value(f"pageOf({corner})"))
        page.press("Enter")
        page.until("leftOut && leftOut.width > 1")
    assert not read_mask(folder / "images" / "0001_mask.png")[13:17, 25:37].any()
    row = (folder / "clicks.csv").read_text().splitlines()[1].split(",")
    assert row[0] == "0001.jpg"
    assert math.dist([float(row[1]), float(row[2])], [30.25, 20.75]) < 0.1
