"""`bathynerf view`: a finished run in a browser."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING

import numpy as np

from survey.export.loaded import LoadedRun
from survey.files.paths import ReadFiles
from survey.progress import current
from survey.run.folder import RunDir
from survey.viewer import layers
from survey.viewer.editing import Editing
from survey.viewer.overview import add_key_frames, grid_node
from survey.viewer.page import Overlay, address, close_server, open_server, require_page, write_page
from survey.viewer.shown import Shown, Style, load_shown
from survey.viewer.sightings import Clicks
from survey.viewer.tree import MOST_POINTS, camera_in_browser, point_sizes, select_nodes

if TYPE_CHECKING:
    import viser

# Sizes of points that differ by less are not sent again.
_SAME_SIZE = 0.05
HOST, PORT = "localhost", 8080


def node_arrays(shown: Shown, node: int, style: Style) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middle (3,) float64, points relative to it (K, 3) float16 and colours (K, 3) uint8 of a node.

    float16 rounds by at most 1/2048 of half the side, a thirtieth of the spacing of a node's points.
    """
    rows = shown.rows(node)
    points = shown.tree.points[rows]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return middle, (points - middle).astype(np.float16), shown.colours(style.kind, rows, style.limits)


class CloudInBrowser:
    """A thread that keeps the cloud in one browser at the level of detail that it shows, until `close`."""

    def __init__(self, client: viser.ClientHandle, shown: Shown, style: Style, most_points: int = MOST_POINTS):
        self._client, self._shown, self._style, self._most_points = client, shown, style, most_points
        self._nodes: dict[int, viser.PointCloudHandle] = {}
        self._drawn: dict[int, tuple[int, tuple]] = {}
        self._wake, self._is_closed = Event(), False
        self._wake.set()
        self._thread = Thread(target=self._work, daemon=True)
        self._thread.start()

    def redraw(self, style: Style | None = None) -> None:
        """Draw the nodes that are needed after the camera has moved or the style has changed."""
        self._style = self._style if style is None else style
        self._wake.set()

    def close(self) -> None:
        """End the thread, which sends one more node at most."""
        self._is_closed = True
        self._wake.set()
        self._thread.join()

    def _work(self) -> None:
        while True:
            self._wake.wait()
            self._wake.clear()
            if self._is_closed:
                return
            self._draw()

    def _draw(self) -> None:
        """Send missing nodes; stops early on new requests, after at least one node."""
        style, tree, view = self._style, self._shown.tree, camera_in_browser(self._client.camera)
        nodes = select_nodes(tree, view, self._most_points) if style.is_shown else np.empty(0, dtype=np.int64)
        nodes = nodes[self._shown.num_shown[nodes] > 0]
        self._make_room(nodes)
        for node in nodes.tolist():
            wanted = int(self._shown.revision[node]), (style.kind, style.limits)
            if self._drawn.get(node) == wanted:
                continue
            if node in self._nodes and self._drawn[node][0] == wanted[0]:
                self._nodes[node].colors = self._shown.colours(style.kind, self._shown.rows(node), style.limits)
            else:
                # One of the same name is replaced.
                middle, points, colours = node_arrays(self._shown, node, style)
                self._nodes[node] = self._client.scene.add_point_cloud(
                    f"/cloud/{node}", points, colours, position=middle, point_size=style.size * self._shown.gsd_m,
                    point_shape="circle", point_shading="flat",
                )  # fmt: skip
            self._drawn[node] = wanted
            if self._wake.is_set():
                break
        drawn = np.array(sorted(self._nodes), dtype=np.int64)
        sizes = style.size * point_sizes(tree, drawn, view, self._shown.gsd_m)
        for node, handle in self._nodes.items():
            if abs(handle.point_size - sizes[node]) > _SAME_SIZE * sizes[node]:
                handle.point_size = float(sizes[node])

    def _make_room(self, nodes: np.ndarray) -> None:
        """Remove nodes that are not wanted from the browser, as far as it would draw too many points."""
        counts, needed = self._shown.tree.counts, set(nodes.tolist())
        total = int(counts[nodes].sum()) + sum(int(counts[node]) for node in self._nodes if node not in needed)
        for node in [node for node in self._nodes if node not in needed]:
            drawn = int(self._shown.revision[node]), (self._style.kind, self._style.limits)
            if self._style.is_shown and total <= self._most_points and self._drawn[node] == drawn:
                continue
            self._nodes.pop(node).remove()
            del self._drawn[node]
            total -= int(counts[node])


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
        layers.set_initial_view(self.server, shown)
        self.panel = layers.Panel(self.server, shown, self._restyle)
        self._add_layers()
        beside = server.gui.add_panel()
        self.clicks = Clicks(self.server, beside, shown)
        if shown.edits is not None:
            self.editing = Editing(server, beside, shown, shown.edits, self._redraw)
        # Beside the scene, not over it.
        server.gui.main_panel.dock_left()
        beside.dock_below(server.gui.main_panel)
        add_key_frames(server, shown)
        for field in shown.fields:
            layers.add_field(server, field, self.clicks.show)
        if shown.reference is not None:
            Thread(target=self._compare, daemon=True).start()
        self.server.on_client_connect(self._add_browser)
        self.server.on_client_disconnect(self._remove_browser)

    def _add_layers(self) -> None:
        water = layers.add_water(self.server, self.shown)
        cameras, self._thumbnails = layers.add_cameras(self.server, self.shown)
        if water is not None:
            self.panel.add_layer("water surface", is_on=True, show=lambda on: setattr(water, "visible", on))
        self.panel.add_layer("cameras", is_on=True, show=lambda on: setattr(cameras, "visible", on))
        self._terrain = layers.OnDemand(
            self.server, "terrain model", lambda: layers.terrain_node(self.server, self.shown)
        )
        self._box_of_terrain = self.panel.add_layer("terrain model", is_on=False, show=self._terrain.show)
        grid = layers.OnDemand(self.server, "grid of coordinates", lambda: grid_node(self.server, self.shown))
        self.panel.add_layer("grid of coordinates", is_on=False, show=grid.show)
        if (reference := self.shown.reference) is not None:
            node = layers.OnDemand(
                self.server, "reference", lambda: layers.reference_node(self.server, reference, self.shown.gsd_m)
            )
            self.panel.add_layer("reference", is_on=False, show=node.show)

    def _compare(self) -> None:
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
        for cloud in self._all_clouds():
            cloud.redraw(style)

    def _all_clouds(self) -> list[CloudInBrowser]:
        with self._lock:
            return list(self._clouds.values())

    def _redraw(self, is_edited: bool) -> None:
        """Draw what is marked or edited now; the terrain model of the cloud before is taken away."""
        self._restyle(self.panel.style)
        if is_edited:
            self._terrain.forget()
            self._box_of_terrain.value = False

    def close(self) -> None:
        """End the threads of the browsers."""
        for cloud in self._all_clouds():
            cloud.close()
        if self._thumbnails is not None:
            self._thumbnails.close()


def serve(run: str | Path, options: ViewOptions, report: Callable[[str], None]) -> None:
    """Show a run in browsers until Ctrl-C; `report` is called with the address for a browser on this machine."""
    RunDir(run).require_run()
    overlay = Overlay()
    server = open_server(options.host, options.port, "bathynerf", overlay)
    session = None
    try:
        session = ViewSession(_load(run, options), server)
        overlay.attach(session)
        report(address(server, options.host))
        _wait_for_ever()
    except KeyboardInterrupt:
        return
    finally:
        if session is not None:
            session.close()
        close_server(server)


def _load(run: str | Path, options: ViewOptions) -> Shown:
    with LoadedRun(run, as_computed=True) as loaded:
        loaded.folder.warn_if_unfinished()
        with current().stage("Octree"):
            return load_shown(loaded, options.survey, options.reference, options.field)


def _wait_for_ever() -> None:
    while True:
        time.sleep(3600.0)


def export_page(run: str | Path, path: Path, options: ViewOptions) -> None:
    """A run as one page; see `survey.viewer.page`."""
    with LoadedRun(run, as_computed=True) as loaded:
        require_page(path, loaded.folder.inputs() + ReadFiles.of(options.reference))
        loaded.folder.warn_if_unfinished()
        with current().stage("Page"):
            shown = load_shown(loaded, options.survey, options.reference)
            shown.measure_errors()
            write_page(path, shown)
