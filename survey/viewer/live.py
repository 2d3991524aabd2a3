"""A run that `process` works on: its height maps as they come, then the finished cloud."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geo.files import disk_refusals
from survey.errors import SurveyError
from survey.run.flight import FLIGHT, load_flight
from survey.run.folder import RunDir
from survey.run.live import LIVE
from survey.run.stored import load_arrays
from survey.viewer.layers import add_frusta, median_height

if TYPE_CHECKING:
    import viser

# Size of points to the distance of the cameras from the bed.
_SIZE_SHARE = 0.002


class LiveRun:
    """The maps of a run without a result, on a server; the run is asked to show them from here on.

    Parameters
    ----------
    run : RunDir
    server : viser.ViserServer
    """

    def __init__(self, run: RunDir, server: viser.ViserServer):
        self._run, self._server, self._folder = run, server, run.path / LIVE
        self._stamps: dict[Path, int] = {}
        self._nodes: dict[Path, Any] = {}
        self._cameras: Any = None
        self._size_m = 0.0
        with disk_refusals(self._folder):
            self._folder.mkdir(exist_ok=True)
        self._text: Any = server.gui.add_markdown(f"**{run.path}**  \nwaiting for the first height map")

    @property
    def is_finished(self) -> bool:
        """Whether the run has a result by now."""
        return bool(self._run.result())

    def look(self) -> int:
        """Show the maps that have come or changed since the last look; their number."""
        if self._cameras is None and (self._folder / FLIGHT).is_file():
            self._show_cameras()
        if self._cameras is None:
            return 0
        fresh = 0
        for path in sorted(self._folder.glob("*.npz")):
            stamp = path.stat().st_mtime_ns
            if self._stamps.get(path) != stamp:
                self._stamps[path] = stamp
                self._show(path)
                fresh += 1
        if fresh:
            self._text.content = f"**{self._run.path}**  \n{len(self._stamps)} height maps, the sweep goes on"
        return fresh

    def close(self) -> None:
        """Tell the run that nobody looks any more."""
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
        """Let browsers, those that are there too, look at the first map."""
        away = np.array([0.0, -0.6, 0.7]) * self._size_m / _SIZE_SHARE
        start: Any = self._server.initial_camera
        for camera in (start, *(client.camera for client in self._server.get_clients().values())):
            camera.position, camera.look_at = tuple(middle + away), tuple(middle)
