"""A run on a server: what a browser is sent as its camera moves, and what is refused."""

from __future__ import annotations

import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import bathynerf
from shown_run import served, shown_of

from survey.commands.faults import BAD_INPUT
from survey.errors import SurveyError
from survey.viewer import detail
from survey.viewer.browser import address, open_server
from survey.viewer.detail import CloudInBrowser, Style, node_arrays
from survey.viewer.shown import Shown


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
        end = time.monotonic() + 30.0
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
    cloud.look_again(Style("depth", limits))
    expected = node_arrays(shown, 0, Style("depth", limits))[2]
    browser.until(lambda: np.array_equal(browser.nodes["/cloud/0"].colors, expected))
    cloud.look_again(Style(is_shown=False))
    browser.until(lambda: not browser.nodes)
    cloud.close()


def test_a_browser_never_draws_more_points_than_the_limit(shown, monkeypatch):
    for module in (detail, sys.modules["survey.viewer.viewpoint"]):
        monkeypatch.setattr(module, "MOST_POINTS", 60_000)
    monkeypatch.setattr(detail, "select_nodes", lambda tree, view: SELECT(tree, view, 60_000))
    browser = Browser(20.0)
    cloud = CloudInBrowser(browser, shown, Style())
    for height in (20.0, 2.0, 1.0, 6.0):
        browser.look_down(height)
        cloud.look_again()
        wanted = SELECT(shown.tree, detail.viewpoint_of(browser.camera), 60_000)
        browser.until(lambda wanted=wanted: {f"/cloud/{n}" for n in wanted} <= set(browser.nodes))
        assert sum(len(node.points) for node in browser.nodes.values()) <= 60_000
    cloud.close()


SELECT = detail.select_nodes


def test_the_water_lies_over_the_cloud(shown):
    corners = shown.water_corners()
    np.testing.assert_allclose(corners[:, 2], shown.water.height(*corners[:, :2].T))
    assert (corners[:, :2].min(axis=0) <= shown.middle[:2]).all()
    (ax, ay), (bx, by) = corners[1, :2] - corners[0, :2], corners[2, :2] - corners[0, :2]
    assert ax * by - ay * bx > 0.0


def test_a_session_listens_on_this_machine_alone_and_leaves_nothing(shown):
    with served(shown) as session:
        assert address(session.server, "localhost") == f"http://localhost:{session.server.get_port()}"
        assert session.server.get_host() == "localhost"
        assert session.server.request_share_url() is None


def test_an_address_of_another_machine_is_refused():
    with pytest.raises(SurveyError, match=r"--host 192\.0\.2\.1 is no address of this machine"):
        open_server("192.0.2.1", 0, "test")


def test_without_viser_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SurveyError, match=r"pip install 'bathynerf\[viewer\]'"):
        open_server("localhost", 0, "test")


def test_what_is_no_run_is_refused(tmp_path):
    refused = bathynerf("view", tmp_path)
    assert refused.exit_code == BAD_INPUT
    assert "is no run folder" in refused.stderr
