"""Data of the viewer: points with values and colours, cameras, water, a trained field, in the frame of the scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from geo import Mesh, read_reference, require_same_crs, require_same_place
from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.shapes import ground_of, in_height_unit, vertices_of
from refract import FlatWater, PinholeCamera
from survey.display.quantities import number
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun, flight_of
from survey.photos.cameras import View
from survey.progress import current
from survey.run.edits import DELETED, Edits
from survey.run.flight import Flight
from survey.viewer.tree import CloudTree, build_tree

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

    from fields.image_based import NovelView

# Rows of a rendered picture, which then takes a second or two of one core.
_ROWS, _PAPER = 200, 255
# Renders a field for a camera, with the water or (True) without it.
Render = Callable[[PinholeCamera, bool], "NovelView"]
# Points that suffice to find the extent of a cloud, or the range of its values.
_SOME = 200_000
_FIELD = "field"
_COLUMNS = ("xyz", "rgb", "std", "std_common", "num_views", "depth")
# Colour of unknown values.
UNKNOWN = "#808080"
# Of the marked points, and by class: a column, and the colour of each class of LAS.
MARKED, CLASS = (255, 0, 200), "class"
_CLASS_COLOURS = {2: (166, 118, 72), 7: (230, 40, 40), 40: (40, 110, 190), 41: (90, 210, 230)}
# Quantiles of the values at the two ends of the colours, and of the absolute distances to a reference.
_SHARES, _OF_ERRORS = (0.02, 0.98), 0.9


class TrainedField:
    """A trained field, loaded when it is first rendered, with the notes for the user from loading.

    ``load`` returns its render function; it is called with a function that takes notes.
    """

    def __init__(self, name: str, load: Callable[[Callable[[str], None]], Render]):
        self.name, self.notes, self._load = name, list[str](), load
        self._render: Render | None = None
        # Every click has a thread of its own.
        self._lock = Lock()

    def picture(self, camera: PinholeCamera, *, dry: bool) -> np.ndarray:
        """Rendering (rows, columns, 3) uint8 of a screen, white beside the bed; ``dry``: along straight rays."""
        with self._lock:
            self._render = self._render or self._load(self.notes.append)
            seen = self._render(camera.scaled(_ROWS / camera.height), dry)
        return np.where(seen.coloured[..., None], seen.rgb, np.uint8(_PAPER))


def field_of_run(folder: Path, water: FlatWater | None) -> TrainedField:
    """The field that `process --field` left in the folder of its stage."""
    from survey.run.trained_field import load_layer_field

    return TrainedField("field", lambda _note: load_layer_field(folder, water, "auto").view)


def field_of_volume(folder: Path, run: LoadedRun) -> TrainedField:
    """The field that `bathynerf field` left in a folder; see `survey.volume.submodules.StoredVolume`."""
    # It takes torch.
    from survey.volume.submodules import StoredVolume

    stored = StoredVolume.of_run(folder, run)
    return TrainedField(stored.recipe.model, lambda note: stored.load(note=note))


@dataclass(frozen=True)
class LocalReference:
    """A reference, mesh or cloud, in the local frame of a run."""

    path: Path
    points: np.ndarray  # (V, 3) float64 [m], local: vertices, or points
    faces: np.ndarray | None  # (F, 3) int; None of a cloud

    def errors(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (N,) [m] of points (N, 3), local, to a mesh (C2M), or heights over the surface of a cloud.

        As `bathynerf compare` measures them; nothing is aligned.
        """
        # Imported where they are needed: they take a second, and most runs are shown without a reference.
        from evaluation import distance_to_mesh, local_surface

        if self.faces is not None:
            return distance_to_mesh(points, self.points, self.faces).signed
        return points[:, 2] - local_surface(self.points, points[:, :2]).height


def load_reference(path: Path, frame: LocalFrame, cloud_crs: np.ndarray) -> LocalReference:
    """The reference in a file, which has to lie near some points (N, 3) of the run, in crs."""
    from evaluation import weld

    shape = read_reference(path)
    require_same_crs(frame.crs, shape.crs, "the run", str(path))
    shape = in_height_unit(shape, height_unit_m(frame.crs))
    require_same_place(cloud_crs, vertices_of(shape), "the run", str(path))
    if isinstance(shape, Mesh):
        vertices, faces = weld(shape.vertices, shape.faces)
        return LocalReference(path, frame.local_from_crs(vertices), faces)
    return LocalReference(path, frame.local_from_crs(ground_of(shape, path)[0].points), None)


@dataclass(frozen=True)
class Style:
    """How points are drawn: colours, size, visibility."""

    kind: str = "colour"  # A column of `Shown`, or ``colour``
    limits: tuple[float, float] | None = None  # (low, high): values of the first and the last colour
    size: float = 1.0  # [-]: factor of the sizes that leave no gap
    is_shown: bool = True


@dataclass(frozen=True)
class Scale:
    """Colour scale of the values of a quantity."""

    label: str
    unit: str
    colormap: str  # A name of `survey.display.palette`, or of matplotlib
    is_signed: bool = False  # Zero has the middle colour

    def limits(self, values: np.ndarray) -> tuple[float, float]:
        """Values (low, high) of the first and the last colour, by the values (N,) of the cloud."""
        some = values[:: len(values) // _SOME + 1]
        some = some[np.isfinite(some)]
        if not len(some):
            return 0.0, 1.0
        if self.is_signed:
            most = max(float(np.quantile(np.abs(some), _OF_ERRORS)), 1e-6)
            return -most, most
        low, high = (float(v) for v in np.quantile(some, _SHARES))
        return low, max(high, low + 1e-6)

    def colours(self, values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
        """Colours (N, 3) uint8 of values (N,)."""
        share = (values - limits[0]) / (limits[1] - limits[0])
        return _colormap(self.colormap)(np.ma.masked_invalid(share), bytes=True)[..., :3]

    def legend(self, limits: tuple[float, float]) -> str:
        """The quantity with the values of the first and the last colour."""
        low, high = (number(value, 3 if self.unit else 0) for value in limits)
        return f"{self.label}: {low} to {high} {self.unit}".rstrip()

    def bar(self, width: int, height: int) -> np.ndarray:
        """The colours from low to high as a picture (height, width, 3) uint8."""
        return np.repeat(self.colours(np.linspace(0.0, 1.0, width), (0.0, 1.0))[None], height, axis=0)


@lru_cache
def _colormap(name: str) -> Colormap:
    """A colour map, of `UNKNOWN` where a value is."""
    from matplotlib import colormaps

    from survey.display import palette

    drawn = getattr(palette, name, None)
    colormap = drawn if callable(drawn) else colormaps[drawn or name]
    return colormap.with_extremes(bad=UNKNOWN)


# By the name of the column, in the order in which they are offered.
SCALES = {
    "height": Scale("height", "m", "HEIGHTS"),
    "depth": Scale("true depth", "m", "DEPTHS"),
    "std": Scale("std, random", "m", "SPREADS"),
    "std_common": Scale("std, shared", "m", "SPREADS"),
    "num_views": Scale("number of views", "", "COUNTS"),
    "error": Scale("distance to the reference", "m", "DIFFERENCES", is_signed=True),
}


@dataclass
class Shown:
    """The data of a run in the viewer."""

    folder: Path
    name: str  # Of the survey
    tree: CloudTree
    rgb: np.ndarray  # (N, 3) uint8
    # Values (N,) by the names of `SCALES`; one that is not known of the cloud is not there
    columns: dict[str, np.ndarray]
    flight: Flight
    has_photographs: bool  # Whether the files of the photographs are where the run found them
    gsd_m: float  # [m]: ground sampling distance, about that of the points
    reference: LocalReference | None = None  # What the cloud is compared with
    # Of the run's own stage, where it has one, and of a folder of `bathynerf field`
    fields: list[TrainedField] = field(default_factory=list)
    edits: Edits | None = None  # None where the points are not those of a run
    is_marked: np.ndarray = field(init=False)  # (N,) bool: drawn as `MARKED`
    # (M,) int: of the nodes, their points that are not deleted, and how often these have changed
    num_shown: np.ndarray = field(init=False)
    revision: np.ndarray = field(init=False)
    # (3,) [m], local: corners of a box about all points but strays
    low: np.ndarray = field(init=False)
    high: np.ndarray = field(init=False)

    def __post_init__(self):
        # Stray points do not affect the initial view.
        some = self.tree.points[:: len(self.tree.points) // _SOME + 1]
        self.low, self.high = np.quantile(some, [0.005, 0.995], axis=0)
        self.high = np.maximum(self.high, self.low + 1e-3)
        self.is_marked = np.zeros(len(self.tree.points), dtype=bool)
        self.num_shown, self.revision = self.tree.counts.copy(), np.zeros(len(self.tree), dtype=np.int64)
        if self.edits is not None:
            self.follow_edits(np.flatnonzero(self.edits.classes == DELETED))

    @property
    def views(self) -> tuple[View, ...]:
        """The photographs with their cameras."""
        return self.flight.views

    @property
    def water(self) -> FlatWater | None:
        """None for a dry survey."""
        return self.flight.water

    @property
    def base_m(self) -> float:
        """Height of local z = 0 [m]; over some hundred metres heights differ from this plus z by millimetres."""
        return self.flight.frame.origin[2] * height_unit_m(self.flight.frame.crs)

    def new_frame(self) -> LocalFrame:
        """The local frame for one thread: PROJ must not be shared between them."""
        return LocalFrame(self.flight.frame.crs, self.flight.frame.origin)

    @property
    def middle(self) -> np.ndarray:
        """Middle of the cloud (3,) [m], local."""
        return 0.5 * (self.low + self.high)

    @property
    def extent_m(self) -> float:
        """Extent of the cloud in plan [m]."""
        return float(np.linalg.norm((self.high - self.low)[:2]))

    def rows(self, node: int) -> np.ndarray:
        """Rows (K,) of the points of a node that are not deleted."""
        rows = self.tree.rows(node)
        return rows[np.isfinite(self.tree.points[rows, 0])]

    def mark(self, rows: np.ndarray) -> None:
        """Mark these points and no others."""
        before, self.is_marked = self.is_marked, np.zeros_like(self.is_marked)
        self.is_marked[rows] = True
        self._note_changed(np.flatnonzero(before != self.is_marked))

    def follow_edits(self, rows: np.ndarray) -> None:
        """Take over what edits say of these points by now; deleted ones have no place, so that nothing meets them."""
        if self.edits is not None:
            is_deleted = self.edits.classes[rows] == DELETED
            self.tree.points[rows] = np.where(is_deleted[:, None], np.nan, self.edits.places(rows))
            self._note_changed(rows)

    def _note_changed(self, rows: np.ndarray) -> None:
        for node in self.tree.nodes_of(rows).tolist():
            self.num_shown[node] = len(self.rows(node))
            self.revision[node] += 1

    def colours(self, kind: str, rows: np.ndarray, limits: tuple[float, float] | None) -> np.ndarray:
        """Colours (K, 3) uint8 of some points by a column, or of the photographs: ``colour``."""
        if kind == CLASS and self.edits is not None:
            table = np.full((256, 3), 128, dtype=np.uint8)
            table[list(_CLASS_COLOURS)] = list(_CLASS_COLOURS.values())
            colours = table[self.edits.classes[rows]]
        elif kind not in self.columns or limits is None:
            colours = self.rgb[rows]
        else:
            colours = SCALES[kind].colours(self.columns[kind][rows], limits)
        colours[self.is_marked[rows]] = MARKED
        return colours

    def limits(self, kind: str) -> tuple[float, float] | None:
        """Values of the first and the last colour; None where colours are those of the photographs."""
        return SCALES[kind].limits(self.columns[kind]) if kind in self.columns else None

    def measure_errors(self) -> None:
        """Fill the column ``error``, where there is a reference."""
        if self.reference is not None:
            errors = np.full(len(self.tree.points), np.nan, dtype=np.float32)
            shown = np.isfinite(self.tree.points[:, 0])
            errors[shown] = self.reference.errors(self.tree.points[shown])
            self.columns["error"] = errors

    def water_corners(self) -> np.ndarray | None:
        """The water over the cloud as four corners (4, 3) [m], local, counter-clockwise from above; None without."""
        if self.water is None:
            return None
        (west, south), (east, north) = self.low[:2], self.high[:2]
        x, y = np.array([west, east, east, west]), np.array([south, south, north, north])
        return np.column_stack([x, y, self.water.height(x, y) + np.zeros(4)])


def load_shown(run: LoadedRun, survey: str | None, reference: Path | None = None, volume: Path | None = None) -> Shown:
    """Data of a run, whose survey may have moved, beside a reference and with the field of a `bathynerf field`."""
    arrays = run.columns(*_COLUMNS)
    points, rgb = arrays.pop("xyz"), arrays.pop("rgb")
    if not len(points):
        raise SurveyError(f"the cloud of the run {run.folder.path} has no points; its report says why")
    flight, has_photographs = run.flight, True
    try:
        flight = flight_of(run, survey)
    except SurveyError as error:
        if survey is not None:
            raise
        current().warn(f"cameras are shown without their photographs: {error}")
        has_photographs = False
    columns = {name: values for name, values in arrays.items() if np.isfinite(values).any()}
    path, header = run.folder.path, run.bed_header
    shown = Shown(
        path, header.name, build_tree(points), rgb, columns, flight, has_photographs, header.gsd_m, edits=Edits(path)
    )
    if _FIELD in run.stages:
        shown.fields.append(field_of_run(run.folder.load_stage(_FIELD), flight.water))
    if volume is not None:
        shown.fields.append(field_of_volume(volume, run))
    columns["height"] = (points[:, 2] + shown.base_m).astype(np.float32)
    if reference is not None:
        some = flight.frame.crs_from_local(points[:: len(points) // _SOME + 1])
        shown.reference = load_reference(reference, flight.frame, some)
    return shown
