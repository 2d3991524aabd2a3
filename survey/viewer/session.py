"""`bathynerf view`: a finished run in a browser."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any

from survey.export.loaded import LoadedRun
from survey.files.outputs import ReadFiles
from survey.progress import current
from survey.run.folder import RunDir
from survey.viewer.browser import address, close_server, light, open_server
from survey.viewer.clicks import Clicks
from survey.viewer.detail import CloudInBrowser, Style
from survey.viewer.layers import add_cameras, add_water, look_from
from survey.viewer.live import LiveRun
from survey.viewer.page import require_page, write_page
from survey.viewer.panel import Panel
from survey.viewer.shown import Shown, load_shown
from survey.viewer.surfaces import OnDemand, coloured_mesh, mesh, reference_node, terrain
from survey.viewer.trained import TrainedField, add_field

if TYPE_CHECKING:
    import viser

HOST, PORT = "localhost", 8080
# Between two looks at a run that is being processed [s].
_EVERY_S = 1.0


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
    shown : Shown
    server : viser.ViserServer
    """

    def __init__(self, shown: Shown, server: viser.ViserServer):
        self.shown, self.server = shown, server
        self._clouds: dict[int, CloudInBrowser] = {}
        self._lock = Lock()
        look_from(self.server, shown)
        self.panel = Panel(self.server, shown, self._restyle)
        self._add_layers()
        self.clicks = Clicks(self.server, shown, lambda: self.panel.style)
        if shown.field_folder is not None:
            add_field(server, TrainedField(shown.field_folder), self.clicks.show)
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
        """End the threads of the browsers."""
        with self._lock:
            clouds = list(self._clouds.values())
        for cloud in clouds:
            cloud.close()
        if self._thumbnails is not None:
            self._thumbnails.close()


def serve(run: str | Path, options: ViewOptions, say: Callable[[str], None]) -> None:
    """Show a run in browsers until Ctrl-C, which is how one leaves; one without a result as `process` works on it.

    Parameters
    ----------
    run : str or Path
    options : ViewOptions
    say : callable
        Called with the address for a browser on this machine.

    Raises
    ------
    SurveyError, GeoError
        If the folder is no run, the reference cannot be used, viser is not installed or the address is not of this
        machine.
    """
    folder = RunDir(run)
    folder.require_run()
    server = open_server(options.host, options.port, "bathynerf")
    session = None
    try:
        if not folder.result():
            say(address(server, options.host))
            _watch(folder, server)
            session = Session(_load(run, options), server)
        else:
            session = Session(_load(run, options), server)
            say(address(server, options.host))
        _wait_for_ever()
    except KeyboardInterrupt:
        return
    finally:
        if session is not None:
            session.close()
        close_server(server)


def _load(run: str | Path, options: ViewOptions) -> Shown:
    with LoadedRun(run) as loaded:
        loaded.folder.warn_if_unfinished()
        with current().stage("Octree"):
            return load_shown(loaded, options.survey, options.reference)


def _watch(folder: RunDir, server: viser.ViserServer) -> None:
    """Show the height maps of a run until it has a result, and clear the scene for that."""
    live = LiveRun(folder, server)
    try:
        while not live.is_finished:
            live.look()
            time.sleep(_EVERY_S)
    finally:
        live.close()
    server.scene.reset()
    server.gui.reset()
    light(server)


def _wait_for_ever() -> None:
    while True:
        time.sleep(3600.0)


def export_page(run: str | Path, path: Path, options: ViewOptions) -> None:
    """A run as one page; see `survey.viewer.page`."""
    with LoadedRun(run) as loaded:
        require_page(path, loaded.folder.inputs() + ReadFiles.of(options.reference))
        loaded.folder.warn_if_unfinished()
        with current().stage("Page"):
            shown = load_shown(loaded, options.survey, options.reference)
            shown.measure_errors()
            write_page(path, shown)
