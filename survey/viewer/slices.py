"""A slice through the cloud along a line in plan, with the water and a reference beside the cloud."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo import Cloud, Mesh, read_reference, require_same_crs, require_same_place
from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.shapes import ground_of, in_height_unit, vertices_of
from survey.viewer.tree import CloudTree

if TYPE_CHECKING:
    from refract import FlatWater

# Places along the line at which water and reference are looked up.
_PLACES = 400
# Points that a picture shows.
_MOST = 60_000
_SIZE_IN, _DPI = (4.0, 3.0), 160


@dataclass(frozen=True)
class LocalReference:
    """A reference, mesh or cloud, in the local frame of a run."""

    path: Path
    points: np.ndarray  # (V, 3) float64 [m], local: Vertices, or points
    faces: np.ndarray | None  # (F, 3) int or None: None of a cloud

    def errors(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (N,) [m] of points (N, 3), local, to a mesh (C2M), or heights over the surface of a cloud.

        As `bathynerf compare` measures them; nothing is aligned.
        """
        # Imported where they are needed: they take a second, and most runs are shown without a reference.
        from evaluation import distance_to_mesh, local_surface

        if self.faces is not None:
            return distance_to_mesh(points, self.points, self.faces).signed
        return points[:, 2] - local_surface(self.points, points[:, :2]).height

    def heights(self, places: np.ndarray) -> np.ndarray:
        """Its heights (K,) [m] at places (K, 3), local; of several those nearest to the places; NaN where none is."""
        from evaluation import local_surface, vertical_difference

        if self.faces is not None:
            return places[:, 2] - vertical_difference(places, self.points, self.faces)
        return local_surface(self.points, places[:, :2]).height


def load_reference(path: Path, frame: LocalFrame, cloud_crs: np.ndarray) -> LocalReference:
    """The reference in a file: mesh, GeoTIFF or points in the CRS of the run, or without a CRS.

    It has to lie near some points (N, 3) of the run, in crs.
    """
    from evaluation import weld

    shape: Mesh | Cloud = read_reference(path)
    require_same_crs(frame.crs, shape.crs, "the run", str(path))
    shape = in_height_unit(shape, height_unit_m(frame.crs))
    require_same_place(cloud_crs, vertices_of(shape), "the run", str(path))
    if isinstance(shape, Mesh):
        vertices, faces = weld(shape.vertices, shape.faces)
        return LocalReference(path, frame.local_from_crs(vertices), faces)
    return LocalReference(path, frame.local_from_crs(ground_of(shape, path)[0].points), None)


@dataclass(frozen=True)
class Slice:
    """Cross-section: the points near a vertical plane, with water and reference in it."""

    rows: np.ndarray  # (K,) int: of the cloud
    # distance, height (K,) [m]: along the line, and local
    distance: np.ndarray
    height: np.ndarray
    along: np.ndarray  # (P,) [m]: places along the line
    # water, reference (P,) [m], local: heights there; NaN where there is none
    water: np.ndarray
    reference: np.ndarray
    half_m: float  # [m]: points so far to either side are in it


def slice_of(
    tree: CloudTree,
    start: np.ndarray,
    end: np.ndarray,
    half_m: float,
    water: FlatWater | None = None,
    reference: LocalReference | None = None,
) -> Slice:
    """The slice between two points (3,) [m], local, that differ in plan."""
    length = float(np.linalg.norm((end - start)[:2]))
    direction = (end - start)[:2] / length
    rows, distance = _corridor(tree, start[:2], direction, length, half_m)
    along = np.linspace(0.0, length, _PLACES)
    plan = start[:2] + along[:, None] * direction
    height = tree.points[rows, 2]
    places = np.column_stack([plan, _heights_near(along, distance, height)])
    unknown = np.full(_PLACES, np.nan)
    return Slice(
        rows,
        distance,
        height,
        along,
        unknown if water is None else water.height(*plan.T) + np.zeros(_PLACES),
        unknown if reference is None else reference.heights(places),
        half_m,
    )


def _corridor(
    tree: CloudTree, start: np.ndarray, direction: np.ndarray, length: float, half_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points near a line in plan, and their distances along it [m]."""
    across = np.array([-direction[1], direction[0]])
    middle = tree.low[:, :2] + 0.5 * tree.side[:, None] - start
    reach = np.sqrt(0.5) * tree.side + half_m
    t, off = middle @ direction, middle @ across
    nodes = np.flatnonzero((np.abs(off) <= reach) & (t >= -reach) & (t <= length + reach))
    rows = np.concatenate([tree.rows(node) for node in nodes.tolist()]) if len(nodes) else np.empty(0, dtype=np.int64)
    offset = tree.points[rows, :2] - start
    t, off = offset @ direction, offset @ across
    near = (np.abs(off) <= half_m) & (t >= 0.0) & (t <= length)
    return rows[near], t[near]


def _heights_near(along: np.ndarray, distance: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Heights of the cloud (P,) [m] along the line, to choose among several surfaces of a reference there."""
    if not len(distance):
        return np.zeros(len(along))
    order = np.argsort(distance)
    return np.interp(along, distance[order], height[order])


def picture_of(found: Slice, base_m: float, colours: np.ndarray) -> np.ndarray:
    """Plot (rows, columns, 3) uint8 of the slice, local z = 0 at `base_m`, its points in colours (K, 3) uint8."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from survey.display.palette import INK, RED, WATER_LINE

    figure = Figure(figsize=_SIZE_IN, dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    some = slice(None, None, len(found.rows) // _MOST + 1)
    axes.scatter(
        found.distance[some], found.height[some] + base_m, s=4.0, zorder=3, c=colours[some] / 255.0, linewidths=0
    )
    for heights, colour, label in ((found.water, WATER_LINE, "water"), (found.reference, RED, "reference")):
        if np.isfinite(heights).any():
            axes.plot(found.along, heights + base_m, color=colour, lw=1.2, label=label)
            axes.legend(loc="best", frameon=False)
    axes.set(xlabel="distance along the line [m]", ylabel="height [m]", xlim=(0.0, found.along[-1]))
    axes.tick_params(colors=INK)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
