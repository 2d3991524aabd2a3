"""The viewer in a real browser: headless Chromium, drawn by a software renderer."""

import io

import chromium
import numpy as np
import pytest
from PIL import Image
from shown_run import served, shown_of, small_run

from survey.pose_files import read_poses
from survey.run.edits import DELETED, Edits
from survey.viewer.page import address, write_page
from survey.viewer.session import ViewOptions, _load

pytestmark = [pytest.mark.slow, pytest.mark.skipif(chromium.PROGRAM is None, reason="no chromium on this machine")]
SIZE = (1200, 800)
CALLS_OUT = "https:", "wss:"
# Not "10 points marked".
NOTHING_MARKED = "/\\b(?<!\\d\\s)0 points marked/"


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    return shown_of(tmp_path_factory.mktemp("browser") / "s")


def drawn_share(page: chromium.Page) -> float:
    """Share of the page that is neither white nor grey."""
    pixels = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)
    return float((np.ptp(pixels, axis=2) > 20).mean())


def wait_until_drawn(page: chromium.Page) -> None:
    for _ in range(300):
        if drawn_share(page) > 0.1:
            return
    raise AssertionError(f"nothing is drawn: {page.said[-5:]}")


def test_a_click_in_the_browser_brings_the_facts_of_its_point(shown):
    with served(shown) as session, chromium.page_at(address(session.server, "localhost"), *SIZE) as page:
        page.until("document.body.innerText.includes('90\u202f000 points')")
        wait_until_drawn(page)
        page.click(0.5 * SIZE[0], 0.5 * SIZE[1])
        page.until("document.body.innerText.includes('shown by')")
        assert [said for said in page.said if any(call in said for call in CALLS_OUT)] == []


def test_a_click_on_the_overview_goes_there_and_views_are_kept_for_a_flight(tmp_path):
    run = small_run(tmp_path)
    shown = _load(run, ViewOptions())
    with served(shown) as session, chromium.page_at(address(session.server, "localhost"), *SIZE) as page:
        page.until("document.querySelector('#bathynerf-overview polygon')?.getAttribute('points')")
        page.until("document.querySelector('#bathynerf-overview img').width > 100")
        left, top, width, height = page.value(
            "(box => [box.x, box.y, box.width, box.height])"
            "(document.querySelector('#bathynerf-overview img').getBoundingClientRect())"
        )
        page.click(left + 0.75 * width, top + 0.25 * height)
        (client,) = session.server.get_clients().values()
        expected = shown.low[:2] + 0.75 * (shown.high - shown.low)[:2]
        for _ in range(100):
            if np.allclose(np.asarray(client.camera.look_at)[:2], expected, atol=0.02 * shown.extent_m):
                break
            page.value("new Promise(done => setTimeout(done, 100))")
        np.testing.assert_allclose(np.asarray(client.camera.look_at)[:2], expected, atol=0.02 * shown.extent_m)
        page.click_text("add this view")
        page.until("document.body.innerText.includes('views: 1')")
        assert len(read_poses(run / "edits" / "flight.csv").poses) == 1


def test_points_in_a_box_are_deleted_in_the_browser(tmp_path):
    run = small_run(tmp_path)
    shown = _load(run, ViewOptions())
    with served(shown) as session, chromium.page_at(address(session.server, "localhost"), *SIZE) as page:
        wait_until_drawn(page)
        # The overlay, by the camera of this browser.
        page.until("document.querySelector('#bathynerf-overlay span').textContent.endsWith('m')")
        page.click_text("edit")
        page.until(f"{NOTHING_MARKED}.test(document.body.innerText)")
        page.drag((0.55 * SIZE[0], 0.45 * SIZE[1]), (0.65 * SIZE[0], 0.55 * SIZE[1]), modifiers=8)
        page.until(f"!{NOTHING_MARKED}.test(document.body.innerText)")
        assert 0 < shown.is_marked.sum() < len(shown.is_marked)
        marked = shown.is_marked.copy()
        page.click_text("delete what is marked")
        page.until("document.body.innerText.includes('deleted')")
        np.testing.assert_array_equal(Edits(run).classes == DELETED, marked)
        page.click_text("undo")
        page.until("document.body.innerText.includes('edits: none')")
        assert not (Edits(run).classes == DELETED).any()


def test_volumes_in_a_polygon_are_measured_in_the_browser(tmp_path):
    shown = _load(small_run(tmp_path), ViewOptions())
    with served(shown) as session, chromium.page_at(address(session.server, "localhost"), *SIZE) as page:
        wait_until_drawn(page)
        page.click_text("edit")
        for number, (x, y) in enumerate(((0.5, 0.45), (0.6, 0.45), (0.6, 0.55)), 1):
            page.click(x * SIZE[0], y * SIZE[1], modifiers=8)
            page.until(f"document.body.innerText.includes('{number} corners')")
        page.click_text("measure volumes in the polygon")
        page.until("document.body.innerText.includes('water over the bed')")
        assert page.value("document.body.innerText.includes('save volumes (GeoJSON)')")


def test_a_page_opens_without_a_server(shown, tmp_path):
    write_page(tmp_path / "view.html", shown)
    with chromium.page_at((tmp_path / "view.html").as_uri(), *SIZE) as page:
        wait_until_drawn(page)
        requests = [said.split()[1].partition(":")[0] for said in page.said if said.startswith("request")]
        assert set(requests) <= {"file", "data", "blob"}
        page.value("document.querySelector('[aria-label=\"Show scene tree\"]').click()")
        page.until("document.body.innerText.includes('points by')")
