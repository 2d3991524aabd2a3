"""Photographs that show a point of the bed, and the response to a click: rays, windows, a distance, a profile."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import RLock
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from geo.crs import is_geographic
from geo.errors import GeoError
from geo.features import Line
from geo.vectors import Layer, write_geojson
from refract import FlatWater
from survey.display.quantities import MINUS, length, number
from survey.errors import SurveyError
from survey.export.profiles import Bed, Profile, figure_of, write_csv
from survey.photos.cameras import View
from survey.photos.images import load_image
from survey.photos.pixels import damage_named, open_image
from survey.viewer.shown import SCALES, Shown
from survey.viewer.tree import CloudTree, camera_in_browser, is_blocked, pick
from survey.words import markdown

if TYPE_CHECKING:
    import viser
    from matplotlib.figure import Figure


@contextmanager
def telling(
    clients: Iterable[viser.ClientHandle | None],
    label: str,
    doing: str = "",
    errors: tuple[type[Exception], ...] = (SurveyError, GeoError),
) -> Iterator[None]:
    """Context in which browsers are told that something is being done, and why it cannot be, for these errors."""
    told = [client for client in clients if client is not None]
    notes = [client.add_notification(label, doing, loading=True) for client in told if doing]
    try:
        yield
    except errors as error:
        for client in told:
            client.add_notification(label, str(error), color="red")
    finally:
        for note in notes:
            note.remove()


def send_file(client: viser.ClientHandle, name: str, write: Callable[[Path], object]) -> None:
    """Have a browser save what is written to a path of this name."""
    with TemporaryDirectory(prefix="bathynerf-view-") as folder:
        path = Path(folder) / name
        write(path)
        client.send_file_download(name, path.read_bytes(), save_immediately=True)


# Two points (3,) [m], local.
Ends = tuple[np.ndarray, np.ndarray]


def write_lines(path: Path, shown: Shown, lines: Sequence[Ends]) -> None:
    """Lines with their lengths and height differences, as GeoJSON."""
    frame, offsets = shown.new_frame(), [end - start for start, end in lines]
    columns: dict[str, list] = {
        "name": [str(number) for number in range(1, len(lines) + 1)],
        "distance_m": [round(float(np.linalg.norm(offset)), 4) for offset in offsets],
        "in_plan_m": [round(float(np.linalg.norm(offset[:2])), 4) for offset in offsets],
        "height_difference_m": [round(float(offset[2]), 4) for offset in offsets],
    }
    shapes = [frame.crs_from_local(np.array(ends))[:, :2] for ends in lines]
    write_geojson(path, Layer("lines", "LineString", shapes, frame.crs, columns))


def profile_of(shown: Shown, lines: Sequence[Ends]) -> Profile:
    """The profile of the last line, as `bathynerf profile` has it."""
    corners = shown.new_frame().crs_from_local(np.array(lines[-1]))[:, :2]
    reference = None if shown.reference is None else shown.reference.path
    return Bed(shown.folder, reference).along(Line(str(len(lines)), corners))


# Longer side of a thumbnail in its camera [px]; side of a window of a photograph, its enlargement, windows per row.
THUMBNAIL_PX, WINDOW_PX, ENLARGED, _BESIDE = 160, 48, 3, 3
# Bytes of decoded photographs that are kept for the next click.
_MOST_BYTES = 500_000_000
_LINE, _CROSS = 16, 6
# In ground sampling distances: points of the cloud this near to a ray occlude it, except those this near to its end: so
# far a ray 35 degrees off nadir runs close to a bed of that slope.
_BLOCKS_GSD, _FREE_GSD = 1.0, 6.0
_INK, _PAPER, _MARK = (34, 48, 60), (255, 255, 255), (255, 230, 0)
RAYS, DISTANCE = "show its rays", "measure a distance"
LINES, PROFILE, PICTURE = "lines (GeoJSON)", "profile (CSV)", "profile"
# By how many pixels a click may miss a point.
AIM_PX = 3.0
# Of the picture of a profile.
_SIZE_IN, _DPI = (6.0, 4.0), 120
_AIR, _WATER, _CLICK_MARK = (242, 169, 59), (47, 111, 159), (195, 20, 13)
_BLANK = np.full((1, 1, 3), 255, dtype=np.uint8)


@dataclass(frozen=True)
class PointSighting:
    """Projection of a point into a photograph whose frame contains it, whether or not it is occluded there."""

    view: View
    pixel: np.ndarray  # (2,) [px]
    # (3,) [m], local: corners of the ray; the crossing of the water is the point itself where the ray is straight
    camera: np.ndarray
    crossing: np.ndarray
    point: np.ndarray
    incidence: float  # [rad]: between the ray in air and the vertical

    @property
    def is_bent(self) -> bool:
        """Whether the ray goes through water."""
        return bool((self.crossing != self.point).any())


def sightings_of(views: Sequence[View], point: np.ndarray, water: FlatWater | None) -> list[PointSighting]:
    """The photographs whose frames hold a point (3,) [m], local, as seen through the water; the steepest first."""
    found = [sighting for view in views if (sighting := _sighting(view, point, water)) is not None]
    return sorted(found, key=lambda sighting: sighting.incidence)


def unhidden(seen: Sequence[PointSighting], tree: CloudTree, gsd_m: float) -> list[PointSighting]:
    """The sightings whose rays are not occluded, in water or air, by points of the cloud beyond the bed itself."""
    width, free = _BLOCKS_GSD * gsd_m, _FREE_GSD * gsd_m

    def is_free(sighting: PointSighting) -> bool:
        legs = [(sighting.point, sighting.crossing, free)] if sighting.is_bent else []
        legs.append((sighting.crossing, sighting.camera, 0.0 if sighting.is_bent else free))
        return not any(is_blocked(tree, start, end, width_m=width, free_m=gap) for start, end, gap in legs)

    return [sighting for sighting in seen if is_free(sighting)]


def _sighting(view: View, point: np.ndarray, water: FlatWater | None) -> PointSighting | None:
    camera = view.camera
    pixel = camera.project(point, water)
    if not camera.sees(pixel):
        return None
    path = camera.paths(pixel, water)
    # A dry point lies before the place where its ray would meet the water.
    is_bent = bool(path.wet) and float(path.air_length) < float(np.linalg.norm(point - path.origin))
    incidence = float(np.arccos(np.clip(-path.air_direction[2], -1.0, 1.0)))
    return PointSighting(view, pixel, path.origin, path.crossing if is_bent else point, point, incidence)


def thumbnail(view: View, longer_px: int = THUMBNAIL_PX) -> np.ndarray:
    """A photograph (height, width, 3) uint8 whose longer side has about so many pixels."""
    scale = min(longer_px / max(view.camera.width, view.camera.height), 1.0)
    size = max(round(view.camera.width * scale), 1), max(round(view.camera.height * scale), 1)
    with open_image(view.path) as image:
        if image.format == "JPEG":
            with damage_named(f"{view.path} is damaged or cut off"):
                # JPEGs are decoded at an eighth of their size, which is much faster.
                image.draft("RGB", size)
                return np.asarray(image.convert("RGB").resize(size))
    return load_image(view, scale=scale)


class PhotographCache:
    def __init__(self, views: Sequence[View]):
        pixels = max((view.camera.width * view.camera.height for view in views), default=1)
        by_name = {view.name: view for view in views}
        self._load: Callable[[str], np.ndarray] = lru_cache(max(_MOST_BYTES // (3 * pixels), 2))(
            lambda name: load_image(by_name[name])
        )

    def window(self, sighting: PointSighting, side_px: int = WINDOW_PX) -> np.ndarray:
        """The photograph (side, side, 3) uint8 about the place where it shows the point, its middle on the point."""
        # OpenCV counts from the centre of the first pixel.
        u, v = (sighting.pixel - 0.5).astype(np.float64)
        return cv2.getRectSubPix(self._load(sighting.view.name), (side_px, side_px), (float(u), float(v)))


def mosaic(windows: Sequence[np.ndarray], names: Sequence[str]) -> np.ndarray:
    """Windows (side, side, 3) of one size, enlarged, under their names and with a mark in the middle."""
    side = windows[0].shape[0] * ENLARGED
    rows = math.ceil(len(windows) / _BESIDE)
    sheet = np.full((rows * (side + _LINE), min(len(windows), _BESIDE) * side, 3), _PAPER, dtype=np.uint8)
    for place, (window, name) in enumerate(zip(windows, names, strict=True)):
        top, left = (place // _BESIDE) * (side + _LINE), (place % _BESIDE) * side
        large = cv2.resize(window, (side, side), interpolation=cv2.INTER_NEAREST)
        middle = side // 2
        for gap in (-1, 1):
            start, end = middle + gap * _CROSS, middle + 3 * gap * _CROSS
            cv2.line(large, (start, middle), (end, middle), _MARK, 1)
            cv2.line(large, (middle, start), (middle, end), _MARK, 1)
        sheet[top + _LINE : top + _LINE + side, left : left + side - 2] = large[:, :-2]
        cv2.putText(sheet, name[-20:], (left + 2, top + 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, _INK, 1, cv2.LINE_AA)
    return sheet


def facts_of(
    shown: Shown, row: int, seen: Sequence[PointSighting] | None = None, num_hidden: int = 0
) -> list[tuple[str, str]]:
    """Values of a point of the cloud as labels and texts, with the number of photographs that show or hide it."""
    frame = shown.new_frame()
    east, north, height = frame.crs_from_local(shown.tree.points[row][None])[0]
    names, digits = (("longitude", "latitude"), 8) if is_geographic(frame.crs) else (("easting", "northing"), 3)
    rows = [(names[0], number(east, digits)), (names[1], number(north, digits)), ("height", number(height, 3))]
    for kind, scale in SCALES.items():
        if kind != "height" and kind in shown.columns:
            value = float(shown.columns[kind][row])
            rows.append((scale.label, number(value, 0) if kind == "num_views" else length(value)))
    if seen is not None and not seen:
        rows.append(("shown by", "no photograph"))
    elif seen:
        low, high = (math.degrees(seen[place].incidence) for place in (0, -1))
        rows.append(("shown by", f"{len(seen)} photographs, {low:.0f} to {high:.0f}° off nadir"))
    if num_hidden:
        rows.append(("hidden from", f"{num_hidden} more, by nearer points"))
    return rows


def distance_between(start: np.ndarray, end: np.ndarray) -> list[tuple[str, str]]:
    """Distances between two points (3,) [m], local, as labels and texts."""
    offset = end - start
    up = float(offset[2])
    return [
        ("distance", length(float(np.linalg.norm(offset)))),
        ("in plan", length(float(np.linalg.norm(offset[:2])))),
        ("height difference", ("+" if up > 0.0 else "") + length(up).replace("-", MINUS)),
    ]


def table(rows: Sequence[tuple[str, str]]) -> str:
    """Labels and texts as a table for the panel."""
    return "\n".join(["| | |", "|---|---|", *(f"| {markdown(label)} | {markdown(text)} |" for label, text in rows)])


def pixels_of(figure: Figure) -> np.ndarray:
    """A drawn figure (rows, columns, 3) uint8."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set(size_inches=_SIZE_IN, dpi=_DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def row_under(shown: Shown, event: viser.SceneClickEvent) -> int | None:
    """The point that a click meets; None beside the cloud."""
    angle = AIM_PX / camera_in_browser(event.client.camera).fy
    origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
    return pick(shown.tree, origin, direction, angle=angle, least_m=0.5 * shown.gsd_m)


class Clicks:
    """The answers to clicks, in the scene and in the panel."""

    def __init__(self, server: viser.ViserServer, panel: Any, shown: Shown):
        self._server, self._shown = server, shown
        self._photographs = PhotographCache(shown.views)
        self._nodes: list[Any] = []
        self._first: np.ndarray | None = None
        self._lock = RLock()
        self._lines: list[tuple[np.ndarray, np.ndarray]] = []
        with panel.add_tab("click on a point"):
            self._does = server.gui.add_dropdown("action", (RAYS, DISTANCE))
            self._text: Any = server.gui.add_markdown("")
            self._picture = server.gui.add_image(_BLANK, visible=False)
            clear = server.gui.add_button("clear")
            self._save = server.gui.add_button_group("line", (LINES, PROFILE, PICTURE), visible=False)
        self._does.on_update(lambda _: self.clear())
        clear.on_click(lambda _: self.clear())
        self._save.on_click(self._hand_out)
        server.scene.on_click()(self._clicked)

    def clear(self) -> None:
        """Remove all answers to clicks."""
        with self._lock:
            for node in self._nodes:
                node.remove()
            self._nodes, self._first = [], None
            self._text.content = ""
            self._picture.visible = False

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        row = row_under(self._shown, event)
        with self._lock:
            if row is not None:
                (self._show_rays if self._does.value == RAYS else self._measure)(row)

    def _show_rays(self, row: int) -> None:
        self.clear()
        point = self._shown.tree.points[row]
        framed = sightings_of(self._shown.views, point, self._shown.water)
        seen = unhidden(framed, self._shown.tree, self._shown.gsd_m)
        self._mark(point)
        self._draw("air", [(s.camera, s.crossing) for s in seen], _AIR)
        self._draw("water", [(s.crossing, s.point) for s in seen if s.is_bent], _WATER)
        self._text.content = table(facts_of(self._shown, row, seen, len(framed) - len(seen)))
        if seen and self._shown.has_photographs:
            self._show_windows(seen)

    def _show_windows(self, seen: list[PointSighting]) -> None:
        try:
            windows = [self._photographs.window(sighting) for sighting in seen]
        except (SurveyError, OSError) as error:
            self._text.content += f"\n\n{markdown(str(error))}"
            return
        self.show(mosaic(windows, [sighting.view.name for sighting in seen]))

    def _measure(self, row: int) -> None:
        """Mark the first of two points, or measure from it to the second and draw the line between them."""
        point = self._shown.tree.points[row]
        if self._first is None:
            self.clear()
            self._first = point
            self._mark(point)
            self._text.content = table([*facts_of(self._shown, row), ("then", "click a second point")])
            return
        first, self._first = self._first, None
        self._mark(point)
        self._draw("way", [(first, point)], _CLICK_MARK)
        self._lines.append((first, point))
        self._save.visible = True
        self._text.content = table(distance_between(first, point))

    def _hand_out(self, event: viser.GuiEvent) -> None:
        """Send the browser all measured lines, or the profile of the last one as a table; or draw that profile."""
        if event.client is None:
            return
        with telling([event.client], "line", "is being computed"):
            if self._save.value == LINES:
                send_file(event.client, "lines.geojson", lambda path: write_lines(path, self._shown, self._lines))
                return
            profile = profile_of(self._shown, self._lines)
            if self._save.value == PICTURE:
                self.show(pixels_of(figure_of([profile])))
            else:
                send_file(event.client, "profile.csv", lambda path: write_csv(path, [profile]))

    def _mark(self, point: np.ndarray) -> None:
        name = f"/click/point {len(self._nodes)}"
        size = 0.004 * self._shown.extent_m
        self._nodes.append(self._server.scene.add_icosphere(name, size, _CLICK_MARK, position=point, cast_shadow=False))

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
