"""Surfaces of the bed beside its points: terrain model, mesh, reference; made when they are first asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from survey.viewer.shown import SCALES, Shown
from survey.viewer.slices import Reference

if TYPE_CHECKING:
    import viser

# Cells of a terrain model and of a mesh along the extent of the cloud: about as many triangles as a browser likes.
_MOST_CELLS = 500
# A cell has this many ground sampling distances at least: some points, so that few are empty.
_CELL_GSD = 2.0
# Of a reference that is a cloud, so many points are shown.
_MOST_POINTS = 300_000
_REFERENCE = (195, 20, 13)


def grid_faces(known: np.ndarray) -> np.ndarray:
    """Two triangles (F, 3) for every four neighbouring cells (rows, columns) bool that are known, upwards.

    Cells are counted row by row; the first row lies in the north.
    """
    number = np.arange(known.size).reshape(known.shape)
    corners = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    whole = known[:-1, :-1] & known[1:, :-1] & known[1:, 1:] & known[:-1, 1:]
    a, b, c, d = (corner[whole] for corner in corners)
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def terrain(shown: Shown) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The terrain model as vertices (V, 3), local, faces (F, 3) and colours (V, 3) by height."""
    from survey.export.product import ExportOptions
    from survey.handles.dem import dem_of

    dem = dem_of(shown.folder, ExportOptions(resolution_m=_cell_m(shown)))
    height = np.asarray(dem.height, dtype=np.float64)
    known = np.isfinite(height)
    east, north = np.meshgrid(dem.east, dem.north)
    places = np.column_stack([east.ravel(), north.ravel(), np.where(known, height, np.nanmedian(height)).ravel()])
    vertices = shown.new_frame().local_from_crs(places)
    limits = shown.limits("height")
    if limits is None:
        raise RuntimeError("a cloud has heights")
    colours = SCALES["height"].colours(vertices[:, 2] + shown.base_m, limits)
    return vertices, grid_faces(known), colours


def mesh(shown: Shown) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The triangulated bed, as `terrain`, in the colours of the photographs."""
    from survey.mesh.surface import bed_surface

    std = shown.columns["std"]
    surface = bed_surface(
        shown.tree.points, shown.rgb, std, spacing_m=_cell_m(shown), method="delaunay", path=shown.folder
    )
    return surface.vertices, surface.faces, np.asarray(surface.rgb)


def _cell_m(shown: Shown) -> float:
    return max(_CELL_GSD * shown.gsd_m, shown.extent_m / _MOST_CELLS)


def coloured_mesh(server: viser.ViserServer, name: str, parts: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Any:
    """A mesh whose vertices have colours, in the scene."""
    import trimesh

    vertices, faces, colours = parts
    made = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
    return server.scene.add_mesh_trimesh(name, made, cast_shadow=False, receive_shadow=False)


def reference_node(server: viser.ViserServer, reference: Reference, size_m: float) -> Any:
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
    """A node that is made when it is first shown.

    Parameters
    ----------
    server : viser.ViserServer
    label : str
        For the message that it is being computed.
    make : callable
    """

    def __init__(self, server: viser.ViserServer, label: str, make: Callable[[], Any]):
        self._server, self._label, self._make = server, label, make
        self._node: Any = None

    def show(self, on: bool) -> None:
        """Show or hide it."""
        if on and self._node is None:
            said = [
                client.add_notification(self._label, "is being computed", loading=True, with_close_button=False)
                for client in self._server.get_clients().values()
            ]
            try:
                self._node = self._make()
            finally:
                for each in said:
                    each.remove()
        if self._node is not None:
            self._node.visible = on
