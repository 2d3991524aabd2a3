"""`bathynerf view`: a finished run in a browser."""

from __future__ import annotations

import io
import time
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from survey.export.loaded import LoadedRun
from survey.progress import current
from survey.viewer.browser import address, open_server
from survey.viewer.detail import CloudInBrowser, Style
from survey.viewer.layers import add_cameras, add_water
from survey.viewer.panel import Panel
from survey.viewer.shown import Shown, load_shown

if TYPE_CHECKING:
    import viser

HOST, PORT = "localhost", 8080
# From where a browser looks first: directions from the middle of the cloud, in its extents.
_FROM = np.array([0.0, -0.55, 0.6])


@dataclass(frozen=True)
class ViewOptions:
    """Options of `bathynerf view`.

    Attributes
    ----------
    survey : str or None
        Folder of the survey, if it was moved since the run.
    host : str
    port : int
    """

    survey: str | None = None
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
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._forget)

    def _add_layers(self) -> None:
        water = add_water(self.server, self.shown)
        cameras, self._thumbnails = add_cameras(self.server, self.shown)
        if water is not None:
            self.panel.add_layer("water surface", is_on=True, show=lambda on: setattr(water, "visible", on))
        self.panel.add_layer("cameras", is_on=True, show=lambda on: setattr(cameras, "visible", on))

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
        # viser says that it has stopped.
        with redirect_stdout(io.StringIO()):
            self.server.stop()


def look_from(server: viser.ViserServer, shown: Shown) -> None:
    """Let browsers begin over the south of the cloud, looking at its middle."""
    server.initial_camera.position = tuple(shown.middle + _FROM * shown.extent_m)
    server.initial_camera.look_at = tuple(shown.middle)
    server.initial_camera.up = (0.0, 0.0, 1.0)


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
            shown = load_shown(loaded, options.survey)
    return Session(shown, options)


def wait(session: Session) -> None:
    """Serve until Ctrl-C, which is how one leaves."""
    try:
        with suppress(KeyboardInterrupt):
            while True:
                time.sleep(3600.0)
    finally:
        session.close()
