"""Points marked in the scene, by a box on the screen or a polygon on the bed, and deleted or given another class."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from refract import PinholeCamera
from survey.display.quantities import count
from survey.errors import SurveyError
from survey.export.export import cloud_of
from survey.run.edits import CLASSES, Edits
from survey.viewer.shown import MARKED, Shown
from survey.viewer.sightings import row_under, send_file, table, telling
from survey.viewer.tree import camera_in_browser, seen_nodes
from survey.viewer.volumes import volume_rows, volumes_in, write_volumes
from survey.words import markdown

if TYPE_CHECKING:
    import viser

_NOTHING = np.empty(0, dtype=np.int64)
_HELP = "**Shift and drag** marks the points in a box. **Shift and click** sets corners of a polygon on the bed."


def rows_in_box(shown: Shown, camera: PinholeCamera, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Rows (K,) of all points that a camera shows in a box: corners (2,) as shares of its width and height.

    Those behind others are among them.
    """
    size = np.array([camera.width, camera.height])
    found = [_NOTHING]
    for node in np.flatnonzero(seen_nodes(shown.tree, camera)).tolist():
        rows = shown.rows(node)
        pixels = camera.project(shown.tree.points[rows], None)
        # Points behind the camera have no pixel.
        found.append(rows[((pixels >= low * size) & (pixels <= high * size)).all(axis=-1)])
    return np.concatenate(found)


class Editing:
    """The tab with which points are edited; `redraw` shows in all browsers what has changed."""

    def __init__(
        self, server: viser.ViserServer, panel: Any, shown: Shown, edits: Edits, redraw: Callable[[bool], None]
    ):
        self._server, self._shown, self._edits, self._redraw = server, shown, edits, redraw
        self._corners: list[np.ndarray] = []
        self._measured: list[tuple[np.ndarray, dict[str, float | None]]] = []
        self._line: Any = None
        self._lock = Lock()
        gui = server.gui
        with panel.add_tab("edit"):
            gui.add_markdown(_HELP)
            self._text: Any = gui.add_markdown("")
            polygon = gui.add_button("mark what is in the polygon")
            measure = gui.add_button("measure volumes in the polygon", color="gray")
            self._volumes: Any = gui.add_markdown("", visible=False)
            self._hand_out = gui.add_button("save volumes (GeoJSON)", color="gray", visible=False)
            nothing = gui.add_button("mark nothing", color="gray")
            self._class: Any = gui.add_dropdown("class", [f"{code} {name}" for code, name in CLASSES.items()])
            classify = gui.add_button("classify what is marked")
            delete = gui.add_button("delete what is marked", color="red")
            undo = gui.add_button("undo", color="gray")
            save = gui.add_button("save as LAS", color="gray", hint="with all dimensions, into the run folder")
        for button, work in (
            (polygon, self.mark_polygon),
            (measure, self.measure_polygon),
            (nothing, lambda: self._mark(_NOTHING)),
            (classify, lambda: self._change(lambda rows: edits.classify(rows, int(self._class.value.split()[0])))),
            (delete, lambda: self._change(edits.delete)),
            (undo, self._undo),
        ):
            button.on_click(self._answering(work))
        save.on_click(self._save)
        self._hand_out.on_click(self._save_volumes)
        server.scene.on_rect_select(modifier="shift")(self._box)
        server.scene.on_click(modifier="shift")(self._corner)
        self._say()

    def mark_polygon(self) -> None:
        """Mark the points in the polygon whose corners were clicked, whatever their height."""
        corners = self._shown.new_frame().crs_from_local(self._polygon())[:, :2]
        self._mark(self._edits.inside(corners))

    def measure_polygon(self) -> None:
        """Show the volumes in the polygon whose corners were clicked, and keep them to be saved."""
        corners = self._polygon()
        self._measured.append((corners, volumes_in(self._shown, corners)))
        self._volumes.content = table(volume_rows(self._measured[-1][1]))
        self._volumes.visible = self._hand_out.visible = True
        self._corners = []
        self._say()

    def _polygon(self) -> np.ndarray:
        if len(self._corners) < 3:
            raise SurveyError("a polygon has three corners or more: set them with Shift and click on the bed")
        return np.array(self._corners)

    def _answering(self, work: Callable[[], None]) -> Callable[[viser.GuiEvent], None]:
        """The answer to a button; what cannot be done is said in the browser."""

        def answer(event: viser.GuiEvent) -> None:
            with self._lock, telling([event.client], "edit"):
                work()

        return answer

    def _box(self, event: viser.SceneRectSelectEvent) -> None:
        low, high = np.array(event.screen_min), np.array(event.screen_max)
        with self._lock:
            self._mark(rows_in_box(self._shown, camera_in_browser(event.client.camera), low, high))

    def _corner(self, event: viser.SceneClickEvent) -> None:
        row = row_under(self._shown, event)
        if row is None:
            return
        with self._lock:
            self._corners.append(self._shown.tree.points[row].copy())
            self._draw_polygon()
            self._say()

    def _mark(self, rows: np.ndarray) -> None:
        self._shown.mark(rows)
        self._corners = []
        self._draw_polygon()
        self._say()
        self._redraw(False)

    def _change(self, change: Callable[[np.ndarray], None]) -> None:
        rows = np.flatnonzero(self._shown.is_marked)
        change(rows)
        self._shown.follow_edits(rows)
        self._mark(_NOTHING)
        self._redraw(True)

    def _undo(self) -> None:
        self._shown.follow_edits(self._edits.undo())
        self._say()
        self._redraw(True)

    def _save(self, event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        with telling([event.client], "save as LAS", "is being written"):
            path = cloud_of(self._shown.folder)
            event.client.add_notification("save as LAS", f"the points with all edits are in {path}")

    def _save_volumes(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            with telling([event.client], "volumes"):
                send_file(
                    event.client, "volumes.geojson", lambda path: write_volumes(path, self._shown, self._measured)
                )

    def _say(self) -> None:
        marked = count(int(np.count_nonzero(self._shown.is_marked)))
        corners = f", {len(self._corners)} corners" if self._corners else ""
        self._text.content = f"**{marked} points marked**{corners}  \nedits: {markdown(str(self._edits))}"

    def _draw_polygon(self) -> None:
        if self._line is not None:
            self._line.remove()
            self._line = None
        if len(self._corners) > 1:
            ends = np.stack([self._corners, np.roll(self._corners, -1, axis=0)], axis=1)
            self._line = self._server.scene.add_line_segments(
                "/polygon", ends, np.array(MARKED), thickness=2.0, thickness_units="screen"
            )
