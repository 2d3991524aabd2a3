"""A run on a server: what a browser is sent as its camera moves, and what is refused."""

import re
import time
import urllib.error
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest
import viser
from command_line import bathynerf
from shown_run import served, shown_of, small_run

from survey.commands.faults import BAD_INPUT
from survey.errors import SurveyError
from survey.marking.server import is_own_page
from survey.viewer import session
from survey.viewer.page import address, close_server, open_server, token
from survey.viewer.session import CloudInBrowser, node_arrays
from survey.viewer.shown import Shown, Style
from survey.viewer.tree import camera_in_browser, select_nodes


@pytest.fixture(scope="module")
def shown(tmp_path_factory) -> Shown:
    return shown_of(tmp_path_factory.mktemp("shown") / "s")


class Browser:
    """What `CloudInBrowser` asks of a client of viser."""

    def __init__(self, height: float):
        self.nodes: dict[str, SimpleNamespace] = {}
        self.scene = SimpleNamespace(add_point_cloud=self._add)
        self.look_down(height)

    def look_down(self, height: float) -> None:
        # From x right, y down, z forward to east, south, down.
        turned = {"wxyz": (0.0, 1.0, 0.0, 0.0), "fov": 0.8, "aspect": 1.5, "image_height": 900}
        self.camera = SimpleNamespace(position=(0.0, 0.0, height), **turned)

    def _add(self, name, points, colors, **more):
        handle = SimpleNamespace(points=points, colors=colors, remove=lambda: self.nodes.pop(name), **more)
        self.nodes[name] = handle
        return handle

    def until(self, ready) -> None:
        end = time.monotonic() + 120.0
        while not ready():
            assert time.monotonic() < end
            time.sleep(0.01)


def test_a_browser_gets_the_cloud_and_then_its_colours(shown):
    browser = Browser(20.0)
    cloud = CloudInBrowser(browser, shown, Style())
    total = len(shown.tree.points)
    browser.until(lambda: sum(len(node.points) for node in browser.nodes.values()) == total)
    sent = np.concatenate([node.points.astype(float) + node.position for node in list(browser.nodes.values())])
    # Half precision of half a node: 2**-11 of 15 m at most.
    found = sent[np.lexsort(sent.T)]
    assert np.abs(np.sort(sent[:, 0]) - np.sort(shown.tree.points[:, 0])).max() < 0.01
    assert len(found) == total
    limits = shown.limits("depth")
    cloud.redraw(Style("depth", limits))
    expected = node_arrays(shown, 0, Style("depth", limits))[2]
    browser.until(lambda: np.array_equal(browser.nodes["/cloud/0"].colors, expected))
    cloud.redraw(Style(is_shown=False))
    browser.until(lambda: not browser.nodes)
    cloud.close()


def test_a_browser_never_draws_more_points_than_the_limit(shown):
    browser = Browser(20.0)
    cloud = CloudInBrowser(browser, shown, Style(), 60_000)
    for height in (20.0, 2.0, 1.0, 6.0):
        browser.look_down(height)
        cloud.redraw()
        wanted = select_nodes(shown.tree, camera_in_browser(browser.camera), 60_000)
        browser.until(lambda wanted=wanted: {f"/cloud/{n}" for n in wanted} <= set(browser.nodes))
        assert sum(len(node.points) for node in browser.nodes.values()) <= 60_000
    cloud.close()


def test_the_water_lies_over_the_cloud(shown):
    corners = shown.water_corners()
    np.testing.assert_allclose(corners[:, 2], shown.water.height(*corners[:, :2].T))
    assert (corners[:, :2].min(axis=0) <= shown.middle[:2]).all()
    (ax, ay), (bx, by) = corners[1, :2] - corners[0, :2], corners[2, :2] - corners[0, :2]
    assert ax * by - ay * bx > 0.0


def test_a_session_listens_on_this_machine_alone_and_leaves_nothing(shown):
    with served(shown) as own:
        assert address(own.server, "localhost") == f"http://localhost:{own.server.get_port()}/{token()}/"
        assert len(token()) >= 20
        assert own.server.get_host() == "localhost"
        assert own.server.request_share_url() is None


def test_an_address_of_another_machine_is_refused():
    with pytest.raises(SurveyError, match=r"--host 192\.0\.2\.1 is not an address of this machine"):
        open_server("192.0.2.1", 0, "test")


@pytest.fixture
def stopped(monkeypatch):
    """Ctrl-C as soon as a run is served."""

    def stop():
        raise KeyboardInterrupt

    monkeypatch.setattr(session, "_wait_for_ever", stop)


def test_the_command_prints_its_address_and_ctrl_c_ends_it(tmp_path, stopped):
    shown = bathynerf("view", small_run(tmp_path), "--port", 8765)
    assert shown.exit_code == 0
    # Where the port is taken, the next free one.
    assert re.fullmatch(r"http://localhost:87\d\d/[\w-]{22}/\n", shown.stdout)
    assert "warning" not in shown.stderr


def test_without_its_photographs_a_run_is_shown_with_a_warning_and_they_are_found_elsewhere(tmp_path, stopped):
    run = small_run(tmp_path)
    (tmp_path / "s").rename(tmp_path / "moved")
    shown = bathynerf("view", run)
    assert shown.exit_code == 0
    assert "cameras are shown without their photographs" in shown.stderr
    assert "warning" not in bathynerf("view", run, "--survey", tmp_path / "moved").stderr


def test_the_command_writes_a_page(tmp_path):
    written = bathynerf("view", small_run(tmp_path), "--export", tmp_path / "view.html")
    assert (written.exit_code, written.stdout) == (0, f"{tmp_path / 'view.html'}\n")
    assert "<title>small</title>" in (tmp_path / "view.html").read_text()


def test_what_is_no_run_is_refused(tmp_path):
    refused = bathynerf("view", tmp_path)
    assert refused.exit_code == BAD_INPUT
    assert "is no run folder" in refused.stderr


@pytest.mark.parametrize(
    ("host", "headers", "is_own"),
    [
        ("localhost", {"Host": "localhost:8080", "Origin": "http://localhost:8080"}, True),
        ("localhost", {"Host": "127.0.0.1:9000"}, True),
        ("localhost", {"Host": "localhost:8080", "Origin": "https://elsewhere.example"}, False),
        ("localhost", {"Host": "localhost:8080", "Origin": "null"}, False),
        ("localhost", {"Host": "elsewhere.example:8080", "Origin": "http://elsewhere.example:8080"}, False),
        ("localhost", {}, False),
        ("0.0.0.0", {"Host": "survey-pc:8080", "Origin": "http://survey-pc:8080"}, True),
        ("0.0.0.0", {"Host": "survey-pc:8080", "Origin": "http://localhost:8080"}, False),
    ],
)
def test_pages_of_other_sites_are_not_own(host, headers, is_own):
    assert is_own_page(headers, host, "token", "token") is is_own
    assert not is_own_page(headers, host, "tokem", "token")


def test_a_page_of_another_site_and_who_does_not_know_the_token_get_no_connection():
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    server = open_server("localhost", 8790, "run")
    try:
        page = address(server, "localhost")
        # As the client of viser makes it of the address of its page.
        place, here = page.replace("http", "ws").removesuffix("/"), f"http://localhost:{server.get_port()}"
        for path, origin in (
            (place, "https://elsewhere.example"),
            (place[:-1], here),
            (place.rpartition("/")[0], None),
        ):
            with pytest.raises(InvalidStatus, match="403"):
                connect(path, origin=origin)
        with connect(place, origin=here, subprotocols=[f"viser-v{viser.__version__}"]) as own:
            assert own.recv()
        with urllib.request.urlopen(page) as answer:
            assert b"Viser" in answer.read()
        for path in (f"{here}/", f"{here}/index.html", f"{here}/{token()[:-1]}/", f"{page}../../index.html"):
            with pytest.raises(urllib.error.HTTPError, match=r"40[34]") as refused:
                urllib.request.urlopen(path)
            refused.value.close()
    finally:
        close_server(server)
