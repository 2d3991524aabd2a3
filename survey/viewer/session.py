"""`bathynerf view`: a finished run in a browser."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any

from survey.export.loaded import LoadedRun
from survey.files.outputs import ReadFiles
from survey.progress import current
from survey.viewer.browser import address, close_server, open_server
from survey.viewer.clicks import Clicks
from survey.viewer.detail import CloudInBrowser, Style
from survey.viewer.layers import add_cameras, add_water, look_from
from survey.viewer.page import require_page, write_page
from survey.viewer.panel import Panel
from survey.viewer.shown import Shown, load_shown
from survey.viewer.surfaces import OnDemand, coloured_mesh, mesh, reference_node, terrain

if TYPE_CHECKING:
    import viser

HOST, PORT = "localhost", 8080


@dataclass(frozen=True)
class ViewOptions:
    """Options of `bathynerf view`.

    Attributes
    ----------
    survey : str or None
        Folder of the survey, if it was moved since the run.
    reference : Path or None
        Mesh, GeoTIFF or points beside the cloud.
    host : str
    port : int
    """

    survey: str | None = None
    reference: Path | None = None
    host: str = HOST
    port: int = PORT


class Session:
    """A run on a server, and the browsers that look at it.

    Attributes
    ----------
    server : viser.ViserServer
    shown : Shown
    address : str
        For a browser on this machine.
    """

    def __init__(self, shown: Shown, options: ViewOptions):
        self.shown = shown
        self.server = open_server(options.host, options.port, "bathynerf")
        self.address = address(self.server, options.host)
        self._clouds: dict[int, CloudInBrowser] = {}
        self._lock = Lock()
        look_from(self.server, shown)
        self.panel = Panel(self.server, shown, self._restyle)
        self._add_layers()
        self.clicks = Clicks(self.server, shown, lambda: self.panel.style)
        if shown.reference is not None:
            Thread(target=self._compare, daemon=True).start()
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._forget)

    def _add_layers(self) -> None:
        water = add_water(self.server, self.shown)
        cameras, self._thumbnails = add_cameras(self.server, self.shown)
        if water is not None:
            self.panel.add_layer("water surface", is_on=True, show=lambda on: setattr(water, "visible", on))
        self.panel.add_layer("cameras", is_on=True, show=lambda on: setattr(cameras, "visible", on))
        made: dict[str, Callable[[], Any]] = {
            "terrain model": lambda: coloured_mesh(self.server, "/terrain", terrain(self.shown)),
            "mesh": lambda: coloured_mesh(self.server, "/mesh", mesh(self.shown)),
        }
        if (reference := self.shown.reference) is not None:
            made["reference"] = lambda: reference_node(self.server, reference, self.shown.gsd_m)
        for label, make in made.items():
            self.panel.add_layer(label, is_on=False, show=OnDemand(self.server, label, make).show)

    def _compare(self) -> None:
        """Errors of all points, which take a while; then the panel offers them."""
        self.shown.measure_errors()
        self.panel.offer_kinds()

    def _welcome(self, client: viser.ClientHandle) -> None:
        """A browser has come: its camera decides which nodes it gets."""
        cloud = CloudInBrowser(client, self.shown, self.panel.style)
        with self._lock:
            self._clouds[client.client_id] = cloud
        client.camera.on_update(lambda _: cloud.look_again())

    def _forget(self, client: viser.ClientHandle) -> None:
        with self._lock:
            cloud = self._clouds.pop(client.client_id, None)
        if cloud is not None:
            cloud.close()

    def _restyle(self, style: Style) -> None:
        with self._lock:
            clouds = list(self._clouds.values())
        for cloud in clouds:
            cloud.look_again(style)

    def close(self) -> None:
        """End the server and the threads of its browsers."""
        with self._lock:
            for cloud in self._clouds.values():
                cloud.close()
        if self._thumbnails is not None:
            self._thumbnails.close()
        close_server(self.server)


def open_session(run: str | Path, options: ViewOptions) -> Session:
    """A run on a server.

    Raises
    ------
    SurveyError
        If the folder is no finished run, viser is not installed or the address is not of this machine.
    """
    with LoadedRun(run) as loaded:
        loaded.folder.warn_if_unfinished()
        with current().stage("Octree"):
            shown = load_shown(loaded, options.survey, options.reference)
    return Session(shown, options)


def export_page(run: str | Path, path: Path, options: ViewOptions) -> None:
    """A run as one page; see `survey.viewer.page`."""
    with LoadedRun(run) as loaded:
        require_page(path, loaded.folder.inputs() + ReadFiles.of(options.reference))
        loaded.folder.warn_if_unfinished()
        with current().stage("Page"):
            shown = load_shown(loaded, options.survey, options.reference)
            shown.measure_errors()
            write_page(path, shown)


def wait(session: Session) -> None:
    """Serve until Ctrl-C, which is how one leaves."""
    try:
        with suppress(KeyboardInterrupt):
            while True:
                time.sleep(3600.0)
    finally:
        session.close()
