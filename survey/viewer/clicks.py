"""Response to a click on the cloud: rays and windows of the photographs, a distance, a slice."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from survey.errors import SurveyError
from survey.viewer.detail import Style, viewpoint_of
from survey.viewer.shown import Shown
from survey.viewer.sightings import (
    Photographs,
    Sighting,
    facts_of,
    markdown,
    mosaic,
    sightings_of,
    unhidden,
    way_between,
)
from survey.viewer.slices import picture_of, slice_of
from survey.viewer.tree import pick

if TYPE_CHECKING:
    import viser

RAYS, DISTANCE, SLICE = "shows its rays", "measures a distance", "cuts a slice"
# By how many pixels a click may miss a point.
_AIM_PX = 3.0
# A slice takes points up to so many ground sampling distances to either side.
_SLICE_GSD = 2.0
_AIR, _WATER, _MARK = (242, 169, 59), (47, 111, 159), (195, 20, 13)
_BLANK = np.full((1, 1, 3), 255, dtype=np.uint8)


class Clicks:
    """The answers to clicks, in the scene and in the panel.

    Parameters
    ----------
    server : viser.ViserServer
    shown : Shown
    style : callable
        Gives the style of the points, whose colours slices have.
    """

    def __init__(self, server: viser.ViserServer, shown: Shown, style: Callable[[], Style]):
        self._server, self._shown, self._style = server, shown, style
        self._photographs = Photographs(shown.views)
        self._nodes: list[Any] = []
        self._first: np.ndarray | None = None
        self._lock = Lock()
        panel = server.gui.add_panel()
        with panel.add_tab("a click on a point"):
            self._does = server.gui.add_dropdown("it", (RAYS, DISTANCE, SLICE))
            self._text: Any = server.gui.add_markdown("")
            self._picture = server.gui.add_image(_BLANK, visible=False)
            clear = server.gui.add_button("clear")
        panel.dock_left()
        self._does.on_update(lambda _: self.clear())
        clear.on_click(lambda _: self.clear())
        server.scene.on_click()(self._clicked)

    def clear(self) -> None:
        """Take all answers away."""
        with self._lock:
            self._clear()

    def _clear(self) -> None:
        for node in self._nodes:
            node.remove()
        self._nodes, self._first = [], None
        self._text.content = ""
        self._picture.visible = False

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        angle = _AIM_PX / viewpoint_of(event.client.camera).focal_px
        row = pick(self._shown.tree, origin, direction, angle=angle, least_m=0.5 * self._shown.gsd_m)
        with self._lock:
            if row is not None:
                {RAYS: self._show_rays, DISTANCE: self._measure, SLICE: self._cut}[self._does.value](row)

    def _show_rays(self, row: int) -> None:
        self._clear()
        point = self._shown.tree.points[row]
        framed = sightings_of(self._shown.views, point, self._shown.water)
        seen = unhidden(framed, self._shown.tree, self._shown.gsd_m)
        self._mark(point)
        self._draw("air", [(s.camera, s.crossing) for s in seen], _AIR)
        self._draw("water", [(s.crossing, s.point) for s in seen if s.is_bent], _WATER)
        self._text.content = markdown(facts_of(self._shown, row, seen, len(framed) - len(seen)))
        if seen and self._shown.has_photographs:
            self._show_windows(seen)

    def _show_windows(self, seen: list[Sighting]) -> None:
        try:
            windows = [self._photographs.window(sighting) for sighting in seen]
        except (SurveyError, OSError) as error:
            self._text.content += f"\n\n{error}"
            return
        self.show(mosaic(windows, [sighting.view.name for sighting in seen]))

    def _measure(self, row: int) -> None:
        between = self._between(row)
        if between is not None:
            self._text.content = markdown(way_between(*between))

    def _cut(self, row: int) -> None:
        between = self._between(row)
        if between is None or not np.linalg.norm((between[1] - between[0])[:2]) > 0.0:
            return
        shown, style = self._shown, self._style()
        found = slice_of(shown.tree, *between, _SLICE_GSD * shown.gsd_m, shown.water, shown.reference)
        self._text.content = markdown(
            [*way_between(*between), ("points within", f"{100.0 * found.half_m:.0f} cm to either side")]
        )
        self.show(picture_of(found, shown.base_m, shown.colours(style.kind, found.rows, style.limits)))

    def _between(self, row: int) -> tuple[np.ndarray, np.ndarray] | None:
        """The first point and this one, a line between them drawn; None where this is the first."""
        point = self._shown.tree.points[row]
        if self._first is None:
            self._clear()
            self._first = point
            self._mark(point)
            self._text.content = markdown([*facts_of(self._shown, row), ("then", "click a second point")])
            return None
        first, self._first = self._first, None
        self._mark(point)
        self._draw("way", [(first, point)], _MARK)
        return first, point

    def _mark(self, point: np.ndarray) -> None:
        name = f"/click/point {len(self._nodes)}"
        size = 0.004 * self._shown.extent_m
        self._nodes.append(self._server.scene.add_icosphere(name, size, _MARK, position=point, cast_shadow=False))

    def _draw(self, name: str, lines: list[tuple[np.ndarray, np.ndarray]], colour: tuple[int, int, int]) -> None:
        if lines:
            ends = np.array(lines)
            node = self._server.scene.add_line_segments(
                f"/click/{name}", ends, np.array(colour), thickness=2.0, thickness_units="screen"
            )
            self._nodes.append(node)

    def show(self, picture: np.ndarray) -> None:
        """A picture (rows, columns, 3) uint8 in the panel."""
        self._picture.image = picture
        self._picture.visible = True
