"""What is shown of a run: its points with their values, its cameras and its water, in the local frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from geo.crs import height_unit_m
from refract import FlatWater
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.export.photographs import flight_of
from survey.photos.cameras import View
from survey.progress import current
from survey.run.flight import Flight
from survey.viewer.colours import SCALES
from survey.viewer.tree import CloudTree, build_tree

_COLUMNS = ("xyz", "rgb", "std", "std_common", "num_views", "depth")


@dataclass
class Shown:
    """A run as the viewer has it.

    Attributes
    ----------
    folder : Path
    name : str
        Of the survey.
    tree : CloudTree
    rgb : (N, 3) uint8
    columns : dict
        Values (N,) by the names of `survey.viewer.colours.SCALES`; one that is not known of the cloud is not there.
    flight : Flight
    has_photographs : bool
        Whether the files of the photographs are where the run found them.
    gsd_m : [m]
        Ground sampling distance, about that of the points.
    """

    folder: Path
    name: str
    tree: CloudTree
    rgb: np.ndarray
    columns: dict[str, np.ndarray]
    flight: Flight
    has_photographs: bool
    gsd_m: float
    low: np.ndarray = field(init=False)
    high: np.ndarray = field(init=False)

    def __post_init__(self):
        # Some stray points do not count for what the camera looks at first.
        some = self.tree.points[:: len(self.tree.points) // 200_000 + 1]
        self.low, self.high = np.quantile(some, [0.005, 0.995], axis=0)

    @property
    def views(self) -> tuple[View, ...]:
        """The photographs with their cameras."""
        return self.flight.views

    @property
    def water(self) -> FlatWater | None:
        """None for a dry survey."""
        return self.flight.water

    @property
    def middle(self) -> np.ndarray:
        """Of the cloud (3,) [m], local."""
        return 0.5 * (self.low + self.high)

    @property
    def extent_m(self) -> float:
        """Of the cloud in plan [m]."""
        return float(np.linalg.norm((self.high - self.low)[:2]))

    def colours(self, kind: str, rows: np.ndarray, limits: tuple[float, float] | None) -> np.ndarray:
        """Colours (K, 3) uint8 of some points by a column, or of the photographs: ``colour``."""
        if kind not in self.columns or limits is None:
            return self.rgb[rows]
        return SCALES[kind].colours(self.columns[kind][rows], limits)

    def limits(self, kind: str) -> tuple[float, float] | None:
        """Values of the first and the last colour; None where colours are those of the photographs."""
        return SCALES[kind].limits(self.columns[kind]) if kind in self.columns else None

    def water_corners(self) -> np.ndarray | None:
        """The water over the cloud as four corners (4, 3) [m], local, counter-clockwise from above; None without."""
        if self.water is None:
            return None
        (west, south), (east, north) = self.low[:2], self.high[:2]
        x, y = np.array([west, east, east, west]), np.array([south, south, north, north])
        return np.column_stack([x, y, self.water.height(x, y) + np.zeros(4)])


def load_shown(run: LoadedRun, survey: str | None) -> Shown:
    """What is shown of a run; ``survey`` is the folder of the survey, if it was moved since.

    Raises
    ------
    SurveyError
        If the run has no cloud, or was made before runs kept their cameras.
    """
    arrays = run.columns(*_COLUMNS)
    points, rgb = arrays.pop("xyz"), arrays.pop("rgb")
    if not len(points):
        raise SurveyError(f"the cloud of the run {run.folder.path} has no points; its report says why")
    flight, has_photographs = _flight(run, survey)
    # The axis of local points up where the survey is; over some hundred metres heights differ from it by millimetres.
    base = flight.frame.origin[2] * height_unit_m(flight.frame.crs)
    columns = {"height": (points[:, 2] + base).astype(np.float32)}
    columns |= {name: values for name, values in arrays.items() if np.isfinite(values).any()}
    return Shown(
        run.folder.path, run.place.name, build_tree(points), rgb, columns, flight, has_photographs, run.place.gsd_m
    )


def _flight(run: LoadedRun, survey: str | None) -> tuple[Flight, bool]:
    flight = run.flight
    try:
        return flight_of(run, survey), True
    except SurveyError as error:
        if survey is not None:
            raise
        current().warn(f"cameras are shown without their photographs: {error}")
        return flight, False
