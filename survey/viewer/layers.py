"""The scene and the panel beside it: water, cameras with their photographs, surfaces of the bed, colours of points."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np

from geo.errors import GeoError
from survey.display.quantities import count
from survey.errors import SurveyError
from survey.photos.cameras import View
from survey.progress import current
from survey.viewer.shown import CLASS, SCALES, LocalReference, Shown, Style, TrainedField
from survey.viewer.sightings import telling, thumbnail
from survey.viewer.tree import camera_in_browser
from survey.words import markdown, printable

if TYPE_CHECKING:
    import viser


_WATER, _OPACITY = (79, 148, 173), 0.3
_CAMERA, _REFERENCE = (34, 48, 60), (195, 20, 13)
# Size of a camera relative to its distance from the bed.
_CAMERA_SHARE = 0.04
# Initial viewpoint, relative to the middle of the cloud, in units of its extent.
_FROM = np.array([0.0, -0.55, 0.6])
# Of a terrain model: most cells along the cloud, which browsers can draw, and the smallest, of which few are empty.
_MOST_CELLS, _CELL_GSD = 500, 2.0
# Of a reference that is a cloud, so many points are shown.
_MOST_POINTS = 300_000
PHOTOGRAPHED = "colour of the photographs"
_BAR_PX = (256, 14)
_MOST_SIZE = 4.0


def set_initial_view(server: viser.ViserServer, shown: Shown) -> None:
    """Set the initial view of browsers: from above the south of the cloud to its middle."""
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


def add_cameras(server: viser.ViserServer, shown: Shown) -> tuple[viser.FrameHandle, Thumbnails | None]:
    """The cameras, which a click looks through, below one node, and the thread that adds their photographs."""
    height_m = float(np.median([view.camera.centre[2] for view in shown.views])) - shown.middle[2]
    top = server.scene.add_frame("/cameras", show_axes=False)
    handles = [(view, _add_camera(server, view, _CAMERA_SHARE * abs(height_m))) for view in shown.views]
    return top, Thumbnails(handles) if shown.has_photographs else None


def _add_camera(server: viser.ViserServer, view: View, size: float) -> viser.CameraFrustumHandle:
    from viser.transforms import SO3

    camera = view.camera
    fov, wxyz = 2.0 * math.atan(0.5 * camera.height / camera.fy), SO3.from_matrix(camera.cam_from_local.T).wxyz
    handle = server.scene.add_camera_frustum(
        f"/cameras/{printable(view.name)}", fov=fov, aspect=camera.width / camera.height, scale=size, color=_CAMERA,
        thickness=0.01 * size, wxyz=wxyz, position=camera.centre, cast_shadow=False, receive_shadow=False,
    )  # fmt: skip

    @handle.on_click
    def look_through(event: viser.SceneNodePointerEvent) -> None:
        to = event.client.camera
        to.position, to.wxyz, to.fov = handle.position, handle.wxyz, handle.fov

    return handle


class Thumbnails:
    """A thread that adds the photographs to their cameras, until it is done or `close`."""

    def __init__(self, handles: list[tuple[View, viser.CameraFrustumHandle]]):
        self._handles, self._is_closed = handles, False
        self._thread = Thread(target=self._fill, daemon=True)
        self._thread.start()

    def close(self, *, at_once: bool = True) -> None:
        """End the thread, or wait until all photographs are there: a server that has stopped takes no picture."""
        self._is_closed = at_once
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


def terrain_node(server: viser.ViserServer, shown: Shown) -> viser.GlbHandle:
    """The terrain model in the scene, coloured by height."""
    import trimesh

    from survey.export.registry import ExportOptions
    from survey.handles.run import dem_mesh

    cell_m = max(_CELL_GSD * shown.gsd_m, shown.extent_m / _MOST_CELLS)
    surface = dem_mesh(shown.folder, ExportOptions(resolution_m=cell_m))
    vertices, scale = shown.new_frame().local_from_crs(surface.vertices), SCALES["height"]
    colours = scale.colours(vertices[:, 2] + shown.base_m, scale.limits(shown.columns["height"]))
    made = trimesh.Trimesh(vertices, surface.faces, vertex_colors=colours, process=False)
    return server.scene.add_mesh_trimesh("/terrain", made, cast_shadow=False, receive_shadow=False)


def reference_node(server: viser.ViserServer, reference: LocalReference, size_m: float) -> Any:
    """A reference in the scene: a mesh in one colour, or its points."""
    if reference.faces is not None:
        return server.scene.add_mesh_simple(
            "/reference", reference.points, reference.faces, color=_REFERENCE, side="double", flat_shading=True,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
    some = reference.points[:: len(reference.points) // _MOST_POINTS + 1]
    middle = some.mean(axis=0)
    return server.scene.add_point_cloud(
        "/reference", (some - middle).astype(np.float32), np.array(_REFERENCE, dtype=np.uint8), position=middle,
        precision="float32", point_size=size_m, point_shape="circle", point_shading="flat",
    )  # fmt: skip


class OnDemand:
    """A scene node that is computed when it is first shown; `label` is for the message that it is being computed."""

    def __init__(self, server: viser.ViserServer, label: str, make: Callable[[], Any]):
        self._server, self._label, self._make = server, label, make
        self._node: Any = None

    def show(self, on: bool) -> None:
        """Show or hide it; what cannot be computed is told in the browsers, and tried again the next time."""
        if on and self._node is None:
            with telling(self._server.get_clients().values(), self._label, "is being computed"):
                self._node = self._make()
        if self._node is not None:
            self._node.visible = on

    def forget(self) -> None:
        """Remove it: what it was computed from has changed."""
        if self._node is not None:
            self._node.remove()
            self._node = None


class Panel:
    """The control panel, shared by all browsers; `restyle` is called with the style that has been chosen."""

    def __init__(self, server: viser.ViserServer, shown: Shown, restyle: Callable[[Style], None]):
        self._server, self._shown, self._restyle = server, shown, restyle
        self.style = Style()
        gui = server.gui
        points = count(len(shown.tree.points))
        gui.add_markdown(f"**{markdown(shown.name)}**  \n{points} points, {len(shown.views)} photographs")
        # viser's properties have setters that type checkers do not see.
        self._kinds: Any = gui.add_dropdown("points by", self._labels())
        with gui.add_folder("colours", visible=False) as self._legend:
            self._bar = gui.add_image(SCALES["height"].bar(*_BAR_PX))
            self._range = gui.add_markdown("")
            self._limits: Any = gui.add_vector2("range", (0.0, 1.0), step=0.001, hint="of the first and last colour")
        with gui.add_folder("show"):
            self._points = gui.add_checkbox("points", True)
            self._size = gui.add_slider("size of points", 0.25, _MOST_SIZE, 0.25, 1.0)
            self.layers = gui.add_folder("layers")
        self._kinds.on_update(lambda _: self._choose())
        self._limits.on_update(self._set_limits)
        for control in (self._points, self._size):
            control.on_update(lambda _: self._apply(is_shown=self._points.value, size=self._size.value))

    def add_layer(self, label: str, *, is_on: bool, show: Callable[[bool], None]) -> Any:
        """A box that shows and hides a part of the scene; ``show`` is called with its new state, not at first."""
        with self.layers:
            box = self._server.gui.add_checkbox(label, is_on)
        box.on_update(lambda _: show(box.value))
        return box

    def offer_kinds(self) -> None:
        """Offer all columns that `Shown` has by now."""
        chosen = self._kinds.value
        self._kinds.options = self._labels()
        self._kinds.value = chosen

    def _labels(self) -> list[str]:
        labels = [scale.label for kind, scale in SCALES.items() if kind in self._shown.columns]
        return [PHOTOGRAPHED, *labels, *[CLASS] * (self._shown.edits is not None)]

    def _choose(self) -> None:
        """Colours by another column, over its own range."""
        kinds = {scale.label: kind for kind, scale in SCALES.items()} | {CLASS: CLASS}
        kind = kinds.get(self._kinds.value, "colour")
        limits = self._shown.limits(kind)
        self._legend.visible = limits is not None
        if limits is not None:
            self._bar.image = SCALES[kind].bar(*_BAR_PX)
            self._limits.value = limits
            self._say_range(kind, limits)
        self._apply(kind=kind, limits=limits)

    def _set_limits(self, event: viser.GuiEvent) -> None:
        """Apply a colour range that a user typed; those set by the program are already applied."""
        low, high = self._limits.value
        if event.client is None or not low < high or self.style.limits is None:
            return
        self._say_range(self.style.kind, (low, high))
        self._apply(limits=(low, high))

    def _say_range(self, kind: str, limits: tuple[float, float]) -> None:
        self._range.content = f"{SCALES[kind].legend(limits)}; grey where it is not known"

    def _apply(self, **changes: Any) -> None:
        self.style = replace(self.style, **changes)
        self._restyle(self.style)


def add_field(server: viser.ViserServer, field: TrainedField, show: Callable[[np.ndarray], None]) -> None:
    """A button in the panel that renders a field from where a browser looks; ``show`` gets the picture."""
    with server.gui.add_folder(f"trained field: {field.name}"):
        wet = server.gui.add_checkbox("through the water", False)
        button = server.gui.add_button("render from here")

    @button.on_click
    def render(event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        # Torch raises RuntimeError where a device has too little memory.
        errors = (SurveyError, GeoError, RuntimeError)
        with telling([event.client], "trained field", "is being rendered", errors):
            show(field.picture(camera_in_browser(event.client.camera), dry=not wet.value))
            for note in field.notes:
                event.client.add_notification("trained field", note)
