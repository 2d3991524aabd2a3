"""Static layers of the scene: the water, and the cameras with their photographs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from threading import Thread
from typing import TYPE_CHECKING

import numpy as np

from survey.errors import SurveyError
from survey.photos.cameras import View
from survey.progress import current
from survey.viewer.shown import Shown
from survey.viewer.sightings import thumbnail

if TYPE_CHECKING:
    import viser

_WATER, _OPACITY = (79, 148, 173), 0.3
_CAMERA = (34, 48, 60)
# Size of a camera to its distance from the bed.
_CAMERA_SHARE = 0.04
# From where a browser looks first: directions from the middle of the cloud, in its extents.
_FROM = np.array([0.0, -0.55, 0.6])


def look_from(server: viser.ViserServer, shown: Shown) -> None:
    """Let browsers begin over the south of the cloud, looking at its middle."""
    server.initial_camera.position = tuple(shown.middle + _FROM * shown.extent_m)
    server.initial_camera.look_at = tuple(shown.middle)
    server.initial_camera.up = (0.0, 0.0, 1.0)


def add_water(server: viser.ViserServer, shown: Shown) -> viser.MeshHandle | None:
    """The water surface over the cloud; None for a dry survey."""
    corners = shown.water_corners()
    if corners is None:
        return None
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return server.scene.add_mesh_simple(
        "/water", corners, faces, color=_WATER, opacity=_OPACITY, side="double", cast_shadow=False, receive_shadow=False
    )


def wxyz_of(rotation: np.ndarray) -> np.ndarray:
    """The quaternion (4,) w, x, y, z of a rotation (3, 3)."""
    from viser.transforms import SO3

    return SO3.from_matrix(rotation).wxyz


def add_cameras(server: viser.ViserServer, shown: Shown) -> tuple[viser.FrameHandle, Thumbnails | None]:
    """The cameras, below one node, and what fills them with their photographs, where the files are there.

    A click on a camera looks through it.
    """
    top, handles = add_frusta(server, shown.views, median_height(shown.views) - shown.middle[2])
    return top, Thumbnails(handles) if shown.has_photographs else None


def median_height(views: Sequence[View]) -> float:
    """Median height of the cameras over local z = 0 [m]."""
    return float(np.median([view.camera.centre[2] for view in views]))


def add_frusta(
    server: viser.ViserServer, views: Sequence[View], height_m: float
) -> tuple[viser.FrameHandle, list[tuple[View, viser.CameraFrustumHandle]]]:
    """Cameras that look at a bed so far below them, as one node and each."""
    top = server.scene.add_frame("/cameras", show_axes=False)
    return top, [(view, _add_camera(server, view, _CAMERA_SHARE * abs(height_m))) for view in views]


def _add_camera(server: viser.ViserServer, view: View, size: float) -> viser.CameraFrustumHandle:
    camera = view.camera
    handle = server.scene.add_camera_frustum(
        f"/cameras/{view.name}",
        fov=2.0 * math.atan(0.5 * camera.height / camera.fy),
        aspect=camera.width / camera.height,
        scale=size,
        color=_CAMERA,
        thickness=0.01 * size,
        wxyz=wxyz_of(camera.cam_from_local.T),
        position=camera.centre,
        cast_shadow=False,
        receive_shadow=False,
    )

    @handle.on_click
    def look_through(event: viser.SceneNodePointerEvent) -> None:
        to = event.client.camera
        to.position, to.wxyz, to.fov = handle.position, handle.wxyz, handle.fov

    return handle


class Thumbnails:
    """A thread that puts the photographs into their cameras, until it is done or `close`."""

    def __init__(self, handles: list[tuple[View, viser.CameraFrustumHandle]]):
        self._handles, self._is_closed = handles, False
        self._thread = Thread(target=self._fill, daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Until all photographs are there."""
        self._thread.join()

    def close(self) -> None:
        """End the thread: a server that has stopped takes no picture."""
        self._is_closed = True
        self._thread.join()

    def _fill(self) -> None:
        lost: list[str] = []
        for view, handle in self._handles:
            if self._is_closed:
                return
            try:
                handle.image = thumbnail(view)
            except (SurveyError, OSError) as error:
                lost.append(str(error))
        if lost:
            current().warn(f"{len(lost)} photographs cannot be shown: {lost[0]}")
