"""The server for browsers (viser), for this machine alone unless asked otherwise, and a run as one HTML file."""

from __future__ import annotations

import asyncio
import html
import io
import json
import math
import secrets
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geo.files import write_text
from refract import PinholeCamera
from survey.display.quantities import count
from survey.errors import OutputError, SurveyError
from survey.files.paths import ReadFiles, require_file
from survey.marking.server import is_own_page
from survey.viewer.layers import add_cameras, add_water, set_initial_view
from survey.viewer.overview import add_scale, footprint, go_to, overview
from survey.viewer.shown import SCALES, Shown
from survey.viewer.sightings import AIM_PX, facts_of
from survey.viewer.tree import CloudTree, camera_in_browser, pick
from survey.words import printable

if TYPE_CHECKING:
    import viser

# Points of a page: some 20 MB.
MOST_POINTS = 1_000_000
_SUFFIX, _MARK, _TITLE = ".html", b"Viser client", "<title>Viser</title>"
_HEADING = (
    '<div style="position:fixed;z-index:5;width:100%;top:12px;text-align:center;pointer-events:none;color:#22303c;'
    'font:13px sans-serif">'
    '<b style="font-size:17px">{name}</b><br>{facts}</div>'
)


def open_server(host: str, port: int, title: str, overlay: Overlay | None = None) -> viser.ViserServer:
    """A server at an address of this machine, or the next free port; its page has the script of the overlay, if any."""
    try:
        import viser
    except ModuleNotFoundError as error:
        raise SurveyError("a run is shown by viser, which is not installed: pip install 'bathynerf[viewer]'") from error
    try:
        # viser takes a refusal for a port that is taken and tries the next one.
        asyncio.run(_listen(host))
    except OSError as error:
        raise SurveyError(
            f"--host {host} is not an address of this machine ({error.strerror or error}); give localhost, 0.0.0.0 for "
            "all of its addresses, or one of them"
        ) from error
    # viser says where it listens, which the command does itself.
    with redirect_stdout(io.StringIO()), _own_pages_only(host, overlay) as guarded:
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    if not guarded:
        server.stop()
        raise RuntimeError(f"viser {viser.__version__} does not serve by websockets.serve: origins cannot be checked")
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    # Light from the north-west and ambient light, so that surfaces keep their colours and show relief.
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(False)
    server.scene.add_light_ambient("/light/sky", intensity=2.0)
    server.scene.add_light_directional("/light/sun", intensity=1.4, position=(-1.0, 1.0, 1.2))
    # A page in the browser could ask for a public address of the run.
    server.__dict__["request_share_url"] = lambda *_, **__: None
    return server


@contextmanager
def _own_pages_only(host: str, overlay: Overlay | None) -> Iterator[list[Any]]:
    """Context in which a server of viser starts that answers its own pages only, below a path that others do not know.

    viser has no hook to refuse. Yields the guarded servers: none if viser no longer serves by this function.
    """
    from websockets.asyncio import server as websockets

    serve, made = websockets.serve, []

    def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            given, _, path = request.path.partition("?")[0].removeprefix("/").partition("/")
            if not is_own_page(request.headers, host, given, token()):
                return connection.respond(403, "open the address that bathynerf view printed\n")
            if overlay is not None and path in ("here", "overview"):
                asked = (part.partition("=") for part in request.path.partition("?")[2].split("&"))
                return connection.respond(200, overlay.answer(path, {name: value for name, _, value in asked}))
            if overlay is None or path not in ("", "index.html"):
                return process_request(connection, replace(request, path=f"/{path}"))
            # Not compressed: the script goes into it.
            del request.headers["Accept-Encoding"]
            answered = process_request(connection, replace(request, path=f"/{path}"))
            if answered is not None and answered.body:
                answered.body = answered.body.replace(b"</body>", f"<script>{SCRIPT}</script></body>".encode(), 1)
                del answered.headers["Content-Length"]
                answered.headers["Content-Length"] = str(len(answered.body))
            return answered

        made.append(serve(*arguments, process_request=answer, **options))
        return made[-1]

    websockets.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield made
    finally:
        websockets.serve = serve  # type: ignore[misc]


@cache
def token() -> str:
    """What the addresses of the servers of this process have in their path."""
    return secrets.token_urlsafe(16)


async def _listen(host: str) -> None:
    server = await asyncio.start_server(lambda _reader, _writer: None, host, 0)
    server.close()
    await server.wait_closed()


def close_server(server: viser.ViserServer) -> None:
    """Stop a server silently."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def address(server: viser.ViserServer, host: str) -> str:
    """Address to open in a browser on this machine."""
    name = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    return f"http://{name}:{server.get_port()}/{token()}/"


def require_page(path: Path, inputs: ReadFiles) -> None:
    """Raise OutputError where a page must not or cannot be written."""
    if path.suffix.lower() != _SUFFIX:
        raise OutputError(f"--export names {path}, expected a name that ends in {_SUFFIX}")
    require_file("--export", path, inputs, kind="a page that view wrote", is_of_kind=lambda head: _MARK in head)


def write_page(path: Path, shown: Shown) -> None:
    """Write water, cameras and the cloud coloured by each of its columns; large clouds are thinned."""
    server = open_server("localhost", 0, shown.name)
    try:
        set_initial_view(server, shown)
        add_water(server, shown)
        _, thumbnails = add_cameras(server, shown)
        add_scale(server, shown)
        rows, crs = thinned(shown.tree, MOST_POINTS), shown.flight.frame.crs
        rows = rows[np.isfinite(shown.tree.points[rows, 0])]
        _add_points(server, shown, rows)
        if thumbnails is not None:
            thumbnails.close(at_once=False)
        num_all = int(np.isfinite(shown.tree.points[:, 0]).sum())
        points = f"{count(len(rows))}{'' if len(rows) == num_all else f' of {count(num_all)}'} points"
        name, facts = (html.escape(printable(text)) for text in (shown.name, f"{points}, {crs.name}"))
        page = server.scene.as_html().replace(_TITLE, f"<title>{name}</title>", 1)
        page = page.replace("</body>", _HEADING.format(name=name, facts=facts) + "</body>", 1)
    finally:
        close_server(server)
    write_text(path, page)


def thinned(tree: CloudTree, most: int) -> np.ndarray:
    """Rows (K,) of at most so many points, evenly over the cloud: coarse nodes whole, of the next level every n-th."""
    level = np.round(np.log2(tree.side[0] / tree.side)).astype(np.int64)
    ends = np.cumsum(np.bincount(level, weights=tree.counts)).astype(np.int64)
    num_complete = int(np.searchsorted(ends, most, side="right"))
    done = int(ends[num_complete - 1]) if num_complete else 0
    rows = tree.order[:done]
    if num_complete == len(ends):
        return rows
    step = -((done - int(ends[num_complete])) // max(most - done, 1))
    return np.concatenate([rows, tree.order[done : ends[num_complete] : step]])[:most]


def _add_points(server: viser.ViserServer, shown: Shown, rows: np.ndarray) -> None:
    """The points once for each colour scale, of which the colours of the photographs are shown at first."""
    points = shown.tree.points[rows] - shown.middle
    size = shown.gsd_m * float(np.sqrt(len(shown.tree.points) / len(rows)))
    for kind in ("colour", *(kind for kind in SCALES if kind in shown.columns)):
        limits = shown.limits(kind)
        # The list of what is shown is the only legend of a page.
        name = "colour" if limits is None else SCALES[kind].legend(limits)
        server.scene.add_point_cloud(
            f"/points by/{name}", points, shown.colours(kind, rows, limits), position=shown.middle,
            precision="float32", point_size=size, point_shape="circle", point_shading="flat",
            visible=kind == "colour",
        )  # fmt: skip


SCRIPT = Path(__file__).with_name("overlay.js").read_text(encoding="utf-8")
# That the script finds the number of its browser by.
MARK = '<span class="bathynerf-browser" data-number="{}"></span>'
_LABELS = ("easting", "northing", "longitude", "latitude", "height", SCALES["depth"].label)


class Overlay:
    """Answers to the script; nothing before `attach`."""

    def __init__(self) -> None:
        self._session: Any = None

    def attach(self, session: Any) -> None:
        """Answer for the browsers of a `survey.viewer.session.ViewSession` from now on."""
        self._session = session

        @session.server.on_client_connect
        def number(client: viser.ClientHandle) -> None:
            client.gui.add_html(MARK.format(client.client_id))

    def answer(self, path: str, asked: Mapping[str, str]) -> str:
        """JSON for a browser ``number`` and a place x, y of its screen, as shares; an empty object for others.

        With ``to_x`` and ``to_y`` it is moved there, in shares of the overview, which has a path of its own.
        """
        if self._session is None:
            return "{}"
        shown, style = self._session.shown, self._session.panel.style
        if path == "overview":
            return json.dumps(b64encode(overview(shown, style)).decode())
        try:
            number = int(asked["number"])
            x, y, *to = (float(asked[name]) for name in ("x", "y", "to_x", "to_y") if name in asked)
        except (KeyError, ValueError):
            return "{}"
        client = self._session.server.get_clients().get(number)
        if client is None or not np.isfinite([x, y, *to]).all():
            return "{}"
        if len(to) == 2:
            go_to(shown, client.camera, *to)
        camera, legend = camera_in_browser(client.camera), {"label": "", "colours": []}
        if style.limits is not None:
            scale = SCALES[style.kind]
            legend = {"label": scale.legend(style.limits), "colours": scale.bar(16, 1)[0].tolist()}
        drawn = {"ground": footprint(shown, camera), "legend": legend, "revision": int(shown.revision.sum())}
        return json.dumps(overlay_of(shown, camera, x, y) | drawn)


def overlay_of(shown: Shown, camera: PinholeCamera, x: float, y: float) -> dict:
    """Azimuth of what is up on the screen [deg], metres of a pixel in its middle, and what is at x, y."""
    _, down, forward = camera.cam_from_local
    up = (forward - down)[:2]
    hit = _row_at(shown, camera, 0.5, 0.5)
    if hit is not None:
        distance = float(forward @ (shown.tree.points[hit] - camera.centre))
    else:
        # Where no point is in the middle, the height of that of the cloud.
        distance = float((shown.middle[2] - camera.centre[2]) / min(forward[2], -1e-3))
    row = _row_at(shown, camera, x, y)
    facts = [] if row is None else [f"{label} {text}" for label, text in facts_of(shown, row) if label in _LABELS]
    return {
        "azimuth_deg": math.degrees(math.atan2(up[0], up[1])),
        "m_per_px": abs(distance) / camera.fy,
        "height_px": camera.height,
        "place": "  ".join(facts),
    }


def _row_at(shown: Shown, camera: PinholeCamera, x: float, y: float) -> int | None:
    across, down = (x * camera.width - camera.cx) / camera.fx, (y * camera.height - camera.cy) / camera.fy
    direction = camera.cam_from_local.T @ np.array([across, down, 1.0])
    return pick(shown.tree, camera.centre, direction, angle=AIM_PX / camera.fy, least_m=0.5 * shown.gsd_m)
