"""`bathynerf view`: a finished run in a browser, or a running one with its height maps as they are finished."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any

import numpy as np

from geo.files import reporting_disk_errors
from survey.errors import SurveyError
from survey.escaping import markdown
from survey.export.loaded import LoadedRun
from survey.files.outputs import ReadFiles
from survey.progress import current
from survey.run.flight import FLIGHT, load_flight
from survey.run.folder import RunDir
from survey.run.stored import load_arrays
from survey.run.stored_maps import LIVE
from survey.viewer.detail import CloudInBrowser, Style
from survey.viewer.layers import (
    OnDemand,
    Panel,
    add_cameras,
    add_field,
    add_frusta,
    add_water,
    coloured_mesh,
    median_height,
    mesh,
    reference_node,
    set_initial_view,
    terrain,
)
from survey.viewer.page import address, close_server, light, open_server, require_page, write_page
from survey.viewer.shown import Shown, load_shown
from survey.viewer.sightings import Clicks

if TYPE_CHECKING:
    import viser

HOST, PORT = "localhost", 8080
# Polling interval of a run that is being processed [s].
_EVERY_S = 1.0
# Size of points to the distance of the cameras from the bed.
_SIZE_SHARE = 0.002


class LiveRun:
    """The maps of a run without a result, on a server. `process` writes them for viewers while the folder exists."""

    def __init__(self, run: RunDir, server: viser.ViserServer):
        self._run, self._server, self._folder = run, server, run.path / LIVE
        self._stamps: dict[Path, int] = {}
        self._nodes: dict[Path, Any] = {}
        self._cameras: Any = None
        self._size_m = 0.0
        with reporting_disk_errors(self._folder):
            self._folder.mkdir(exist_ok=True)
        self._text: Any = server.gui.add_markdown("")
        self._say("waiting for the first height map")

    @property
    def is_finished(self) -> bool:
        """Whether the run has a result by now."""
        return bool(self._run.result())

    def show_new_maps(self) -> int:
        """Show the maps that have come or changed since the last look; their number."""
        # Another viewer of the run removes the folder when it closes.
        with suppress(OSError):
            self._folder.mkdir(exist_ok=True)
        if self._cameras is None and (self._folder / FLIGHT).is_file():
            self._show_cameras()
        if self._cameras is None:
            return 0
        fresh = 0
        for path in sorted(self._folder.glob("*.npz")):
            try:
                stamp = path.stat().st_mtime_ns
            except FileNotFoundError:
                continue
            if self._stamps.get(path) != stamp:
                self._stamps[path] = stamp
                self._show(path)
                fresh += 1
        if fresh:
            self._say(f"{len(self._stamps)} height maps, the sweep goes on")
        return fresh

    def _say(self, text: str) -> None:
        self._text.content = f"**{markdown(str(self._run.path))}**  \n{text}"

    def close(self) -> None:
        """Stop asking the run to show its maps."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _show_cameras(self) -> None:
        flight = load_flight(self._folder)
        self._size_m = _SIZE_SHARE * abs(median_height(flight.views))
        self._cameras = add_frusta(self._server, flight.views, abs(median_height(flight.views)))

    def _show(self, path: Path) -> None:
        try:
            arrays = load_arrays(path)
        except SurveyError:
            # Of an older run, or half removed: the next one replaces it.
            return
        xyz, rgb = arrays["xyz"], arrays["rgb"]
        if not len(xyz):
            return
        middle = xyz.mean(axis=0)
        if not self._nodes:
            self._look_at(middle)
        self._nodes[path] = self._server.scene.add_point_cloud(
            f"/maps/{path.stem}", (xyz - middle).astype(np.float32), rgb, position=middle, precision="float32",
            point_size=self._size_m, point_shape="circle", point_shading="flat",
        )  # fmt: skip

    def _look_at(self, middle: np.ndarray) -> None:
        """Point the cameras of new and connected browsers at the first map."""
        offset = np.array([0.0, -0.6, 0.7]) * self._size_m / _SIZE_SHARE
        start: Any = self._server.initial_camera
        for camera in (start, *(client.camera for client in self._server.get_clients().values())):
            camera.position, camera.look_at = tuple(middle + offset), tuple(middle)


@dataclass(frozen=True)
class ViewOptions:
    """Options of `bathynerf view`."""

    survey: str | None = None  # Folder of the survey, if it was moved since the run
    reference: Path | None = None  # Mesh, GeoTIFF or points beside the cloud
    field: Path | None = None  # Folder of `bathynerf field`, whose field is rendered on request
    host: str = HOST
    port: int = PORT


class ViewSession:
    """A run on a server, and the browsers that look at it."""

    def __init__(self, shown: Shown, server: viser.ViserServer):
        self.shown, self.server = shown, server
        self._clouds: dict[int, CloudInBrowser] = {}
        self._lock = Lock()
        set_initial_view(self.server, shown)
        self.panel = Panel(self.server, shown, self._restyle)
        self._add_layers()
        self.clicks = Clicks(self.server, shown, lambda: self.panel.style)
        for field in shown.fields:
            add_field(server, field, self.clicks.show)
        if shown.reference is not None:
            Thread(target=self._compare, daemon=True).start()
        self.server.on_client_connect(self._add_browser)
        self.server.on_client_disconnect(self._remove_browser)

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

    def _add_browser(self, client: viser.ClientHandle) -> None:
        """Send a new browser the nodes that its camera sees."""
        cloud = CloudInBrowser(client, self.shown, self.panel.style)
        with self._lock:
            self._clouds[client.client_id] = cloud
        client.camera.on_update(lambda _: cloud.redraw())

    def _remove_browser(self, client: viser.ClientHandle) -> None:
        with self._lock:
            cloud = self._clouds.pop(client.client_id, None)
        if cloud is not None:
            cloud.close()

    def _restyle(self, style: Style) -> None:
        with self._lock:
            clouds = list(self._clouds.values())
        for cloud in clouds:
            cloud.redraw(style)

    def close(self) -> None:
        """End the threads of the browsers."""
        with self._lock:
            clouds = list(self._clouds.values())
        for cloud in clouds:
            cloud.close()
        if self._thumbnails is not None:
            self._thumbnails.close()


def serve(run: str | Path, options: ViewOptions, report: Callable[[str], None]) -> None:
    """Show a run in browsers until Ctrl-C; one without a result while `process` is running.

    `report` is called with the address for a browser on this machine.
    """
    folder = RunDir(run)
    folder.require_run()
    server = open_server(options.host, options.port, "bathynerf")
    session = None
    try:
        if not folder.result():
            report(address(server, options.host))
            _watch(folder, server)
            session = ViewSession(_load(run, options), server)
        else:
            session = ViewSession(_load(run, options), server)
            report(address(server, options.host))
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
            return load_shown(loaded, options.survey, options.reference, options.field)


def _watch(folder: RunDir, server: viser.ViserServer) -> None:
    """Show the height maps of a run until it has a result, and clear the scene for that."""
    live = LiveRun(folder, server)
    try:
        while not live.is_finished:
            live.show_new_maps()
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
