"""What stands over the scene in a browser: compass, scale bar, and the coordinates under the pointer.

The script of the page asks for them; `Overlay` answers by the camera of its browser, and picks the point on the server.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from refract import PinholeCamera
from survey.viewer.detail import camera_in_browser
from survey.viewer.shown import SCALES, Shown
from survey.viewer.sightings import AIM_PX, facts_of
from survey.viewer.tree import pick

if TYPE_CHECKING:
    import viser

SCRIPT = Path(__file__).with_suffix(".js").read_text(encoding="utf-8")
# That the script finds the number of its browser by.
MARK = '<span class="bathynerf-browser" data-number="{}"></span>'
_LABELS = ("easting", "northing", "longitude", "latitude", "height", SCALES["depth"].label)


class Overlay:
    """Answers to the script; nothing before `attach`."""

    def __init__(self) -> None:
        self._server: viser.ViserServer | None = None
        self._shown: Shown | None = None

    def attach(self, server: viser.ViserServer, shown: Shown) -> None:
        """Answer for the browsers of a server from now on."""
        self._server, self._shown = server, shown

        @server.on_client_connect
        def number(client: viser.ClientHandle) -> None:
            client.gui.add_html(MARK.format(client.client_id))

    def answer(self, asked: Mapping[str, str]) -> str:
        """JSON for a browser ``number`` and a place x, y of its screen, as shares; an empty object for others."""
        try:
            number, x, y = int(asked["number"]), float(asked["x"]), float(asked["y"])
        except (KeyError, ValueError):
            return "{}"
        client = None if self._server is None else self._server.get_clients().get(number)
        if client is None or self._shown is None or not (math.isfinite(x) and math.isfinite(y)):
            return "{}"
        return json.dumps(overlay_of(self._shown, camera_in_browser(client.camera), x, y))


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
