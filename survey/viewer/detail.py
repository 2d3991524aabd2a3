"""The cloud in one browser: octree nodes are sent by what its camera sees, coarse ones first."""

from __future__ import annotations

from dataclasses import dataclass
from threading import Event, Thread
from typing import TYPE_CHECKING

import numpy as np

from refract import PinholeCamera
from survey.photos.rotations import rotation_from_quaternion
from survey.viewer.shown import Shown
from survey.viewer.tree import MOST_POINTS, camera_of_screen, point_sizes, select_nodes

if TYPE_CHECKING:
    import viser

# Sizes of points that differ by less are not sent again.
_SAME_SIZE = 0.05
NODE = "/cloud/{}"


@dataclass(frozen=True)
class Style:
    """How points are drawn: colours, size, visibility."""

    kind: str = "colour"  # A column of `Shown`, or ``colour``
    limits: tuple[float, float] | None = None  # (low, high) or None: values of the first and the last colour
    size: float = 1.0  # [-]: factor of the sizes that leave no gap
    is_shown: bool = True

    @property
    def colouring(self) -> tuple:
        """Settings that determine the colours."""
        return self.kind, self.limits


def camera_in_browser(camera: viser.CameraHandle) -> PinholeCamera:
    """The camera of a browser."""
    rotation = rotation_from_quaternion(*(float(v) for v in camera.wxyz))
    return camera_of_screen(np.asarray(camera.position), rotation.T, camera.fov, camera.aspect, camera.image_height)


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

    def __init__(self, client: viser.ClientHandle, shown: Shown, style: Style):
        self._client, self._shown, self._style = client, shown, style
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
        nodes = select_nodes(tree, view) if style.is_shown else np.empty(0, dtype=np.int64)
        nodes = nodes[self._shown.num_shown[nodes] > 0]
        self._make_room(nodes)
        for node in nodes.tolist():
            wanted = int(self._shown.revision[node]), style.colouring
            if self._drawn.get(node) == wanted:
                continue
            if node in self._nodes and self._drawn[node][0] == wanted[0]:
                self._nodes[node].colors = self._shown.colours(style.kind, self._shown.rows(node), style.limits)
            else:
                # One of the same name is replaced.
                self._add(node, style)
            self._drawn[node] = wanted
            if self._wake.is_set():
                break
        drawn = np.array(sorted(self._nodes), dtype=np.int64)
        sizes = style.size * point_sizes(tree, drawn, view, self._shown.gsd_m)
        for node, handle in self._nodes.items():
            if abs(handle.point_size - sizes[node]) > _SAME_SIZE * sizes[node]:
                handle.point_size = float(sizes[node])

    def _add(self, node: int, style: Style) -> None:
        middle, points, colours = node_arrays(self._shown, node, style)
        self._nodes[node] = self._client.scene.add_point_cloud(
            NODE.format(node),
            points,
            colours,
            position=middle,
            point_size=style.size * self._shown.gsd_m,
            point_shape="circle",
            point_shading="flat",
        )

    def _make_room(self, nodes: np.ndarray) -> None:
        """Remove nodes that are not wanted from the browser, as far as it would draw too many points."""
        counts, needed = self._shown.tree.counts, set(nodes.tolist())
        total = int(counts[nodes].sum()) + sum(int(counts[node]) for node in self._nodes if node not in needed)
        for node in [node for node in self._nodes if node not in needed]:
            drawn = int(self._shown.revision[node]), self._style.colouring
            if self._style.is_shown and total <= MOST_POINTS and self._drawn[node] == drawn:
                continue
            self._nodes.pop(node).remove()
            del self._drawn[node]
            total -= int(counts[node])
