"""The cloud from above, the ground that a screen shows of it, a grid of coordinates, and key frames of a flight."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from geo.errors import GeoError
from geo.files import write_text
from refract import PinholeCamera
from survey.display.quantities import round_up
from survey.errors import SurveyError
from survey.run.edits import FOLDER
from survey.viewer.shown import Shown, Style
from survey.viewer.sightings import telling
from survey.viewer.tree import camera_in_browser
from survey.words import markdown

if TYPE_CHECKING:
    import viser

# Longer side of the overview [px], and of so many points of the cloud, the coarse ones.
_LONGER_PX, _MOST_POINTS = 180, 400_000
# Least slope of a ray to the ground: where a screen shows the horizon, its ground ends there.
_LEAST_DOWN = 0.05
KEY_FRAMES, _VIDEO = "flight.csv", ("-o", "flight", "--video", "20")


def overview(shown: Shown, style: Style) -> bytes:
    """The cloud from above, from `Shown.low` to `high`, as a PNG that is transparent where there is no point."""
    rows = shown.tree.order[:_MOST_POINTS]
    rows = rows[np.isfinite(shown.tree.points[rows, 0])]
    scale = min(_LONGER_PX / (shown.high - shown.low)[:2].max(), 1.0 / shown.gsd_m)
    wide, tall = np.ceil((shown.high - shown.low)[:2] * scale).astype(int).tolist()
    column, row = np.floor((shown.tree.points[rows, :2] - shown.low[:2]) * scale).astype(int).T
    inside = (column >= 0) & (column < wide) & (row >= 0) & (row < tall)
    picture = np.zeros((tall, wide, 4), dtype=np.uint8)
    colours = shown.colours(style.kind, rows[inside], style.limits)[:, ::-1]
    picture[tall - 1 - row[inside], column[inside]] = np.column_stack([colours, np.full(len(colours), 255)])
    return cv2.imencode(".png", picture)[1].tobytes()


def footprint(shown: Shown, camera: PinholeCamera) -> list[list[float]]:
    """Corners (4, 2) of the ground on a screen, in shares of the overview from its lower left corner."""
    corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]])
    rays = camera.directions(corners.astype(np.float64))
    reach = (camera.centre[2] - shown.middle[2]) / np.maximum(-rays[:, 2], _LEAST_DOWN)
    at = camera.centre[:2] + reach[:, None] * rays[:, :2]
    return ((at - shown.low[:2]) / (shown.high - shown.low)[:2]).tolist()


def go_to(shown: Shown, camera: viser.CameraHandle, x: float, y: float) -> None:
    """Move what a browser looks at to a place, in shares of the overview, without a turn."""
    to = shown.low[:2] + np.array([x, y]) * (shown.high - shown.low)[:2]
    camera.position = np.asarray(camera.position) + np.append(to - np.asarray(camera.look_at)[:2], 0.0)


def grid_lines(shown: Shown) -> list[tuple[str, np.ndarray]]:
    """Round eastings and northings over the cloud, with the ends (2, 3) [m], local, of their lines at its top."""
    from matplotlib.ticker import MaxNLocator

    frame, lines = shown.new_frame(), list[tuple[str, np.ndarray]]()
    low, high = frame.crs_from_local(np.array([shown.low, shown.high]))
    for axis in (0, 1):
        values = MaxNLocator(5, steps=(1, 2, 5, 10)).tick_values(low[axis], high[axis])
        for value in values[(values > low[axis]) & (values < high[axis])]:
            ends = np.array([[*low[:2], high[2]], high])
            ends[:, axis] = value
            lines.append((f"{value:.10g}", frame.local_from_crs(ends)))
    return lines


def grid_node(server: viser.ViserServer, shown: Shown) -> Any:
    """The grid of coordinates, with their values at its south and west."""
    top, lines = server.scene.add_frame("/grid", show_axes=False), grid_lines(shown)
    for number, (text, ends) in enumerate(lines):
        server.scene.add_label(f"/grid/{number}", text, position=ends[0])
    if lines:
        ends = np.array([ends for _, ends in lines])
        server.scene.add_line_segments("/grid/lines", ends, (90, 100, 110), thickness=1.0, thickness_units="screen")
    return top


def add_scale(server: viser.ViserServer, shown: Shown) -> None:
    """A bar of a round length, a fifth to half of the cloud's width, and an arrow north of it, south of the cloud.

    A cloud without width has none.
    """
    width_m = float((shown.high - shown.low)[0])
    if not width_m > 0.0:
        return
    length_m = round_up(width_m / 5.0, (1.0, 2.0, 5.0, 10.0))
    start = np.array([shown.low[0], shown.low[1] - 0.5 * length_m, shown.middle[2]])
    east, north = np.diag([length_m, length_m, 0.0])[:2]
    tip = start - 0.3 * east + 0.45 * north
    ends = [(start, start + east), *((start + k * east, start + k * east + 0.08 * north) for k in (0.0, 1.0))]
    ends += [(start - 0.3 * east, tip), *((tip, tip - 0.15 * north + side * east) for side in (-0.08, 0.08))]
    server.scene.add_frame("/scale and north", show_axes=False)
    server.scene.add_line_segments(
        "/scale and north/lines", np.array(ends), (34, 48, 60), thickness=2.5, thickness_units="screen"
    )
    server.scene.add_label("/scale and north/length", f"{length_m:g} m", position=start + 0.5 * east)
    server.scene.add_label("/scale and north/north", "N", position=tip)


def write_key_frames(path: Path, shown: Shown, cameras: Sequence[PinholeCamera]) -> None:
    """Cameras as a table of poses for `bathynerf render`, in the order of a flight."""
    # Surveys that are drawn have the same table.
    from survey.simulate.sidecars import cameras_csv

    if not cameras:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(exist_ok=True)
    names = [f"view{number:03d}" for number in range(len(cameras))]
    write_text(path, cameras_csv(names, cameras, shown.new_frame()))


def add_key_frames(server: viser.ViserServer, shown: Shown) -> None:
    """Buttons that keep from where a browser looks, for a video; a flight before is replaced by the first."""
    path, cameras = shown.folder / FOLDER / KEY_FRAMES, list[PinholeCamera]()
    with server.gui.add_folder("flight"):
        add, undo = server.gui.add_button("add this view"), server.gui.add_button("remove the last", color="gray")
        text: Any = server.gui.add_markdown("views along a flight, for a video")

    def keep(event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        if event.target is add:
            cameras.append(camera_in_browser(event.client.camera))
        elif not cameras:
            return
        else:
            cameras.pop()
        with telling([event.client], "flight", errors=(SurveyError, GeoError, OSError)):
            write_key_frames(path, shown, cameras)
        command = shlex.join(["bathynerf", "render", str(shown.folder), "--cameras", str(path), *_VIDEO])
        text.content = f"views: {len(cameras)}; for the video: {markdown(command)}"

    add.on_click(keep)
    undo.on_click(keep)
