"""The figures of a comparison, and its result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evaluation import AsprsAccuracy, Band, DepthParts, DistanceStatistics, IhoS44, ReachedBand, Scores, Summary
from evaluation.c2m import Sign
from survey.compare.area import Bounds
from survey.compare.inputs import Inputs


@dataclass(frozen=True)
class Parts:
    """Bias and spread of the parts of a cloud; what the cloud lacks is None or empty."""

    depth: DepthParts | None = None
    # incidence, views: By incidence at the water [deg] and by the number of views that agree
    incidence: tuple[Band, ...] = ()
    views: tuple[Band, ...] = ()
    slope: tuple[Band, ...] = ()  # By the slope of the reference [deg]; empty where that is a cloud


@dataclass(frozen=True)
class Vertical:
    """Vertical differences to a mesh."""

    # Points with no surface straight above or below them have no difference: they are in ``n_nan``
    distances: DistanceStatistics
    depth: DepthParts | None


@dataclass(frozen=True)
class ReferenceSurface:
    """The surface through a reference of points, at the places compared."""

    spacing_m: float  # [m]: between its points
    # std_median_m, std_95_m [m]: standard deviation of its heights between them; 95 % are below the second
    std_median_m: float
    std_95_m: float


@dataclass(frozen=True)
class VerticalUncertainty:
    """Vertical errors against IHO S-44."""

    iho: IhoS44
    error: str  # Which error was judged


@dataclass(frozen=True)
class Checkpoints:
    """A cloud at surveyed places."""

    accuracy: AsprsAccuracy
    places: np.ndarray  # (K, 3), in crs
    # (K,) [m]: height of the cloud minus height of the check point; NaN where the cloud does not surround it
    residuals: np.ndarray


@dataclass(frozen=True)
class CloudToCloud:
    """Distances without sign from the cloud to the samples of the reference, and from those to the cloud."""

    to_reference: DistanceStatistics
    to_cloud: DistanceStatistics


@dataclass(frozen=True)
class M3C2:
    """M3C2 distances at some places of the reference."""

    distances: DistanceStatistics
    radius_m: float  # [m]: of the cylinders
    detection_median_m: float  # [m]: median level of detection at 95 %
    significant_share: float  # [-]: share of the distances beyond their level of detection


@dataclass(frozen=True)
class Circumstances:
    """Circumstances of the figures: files, CRS, bounds, options."""

    outliers: str | None  # The filter, as the option
    # block_m, correlation_length_m, widening [m], [m], [-]: of the block bootstrap, see `evaluation.Blocks`
    block_m: float
    correlation_length_m: float
    widening: float
    water_level: float | None  # in crs
    method: str
    sign: Sign  # {"up", "winding"}
    crs: str | None  # Name of the coordinate reference system
    bounds: Bounds | None  # (E0, N0, E1, N1) or None, in crs
    # cloud, reference: Paths
    cloud: str
    reference: str
    visible: str | None  # Path
    n_samples: int  # Of the reference
    seed: int | None  # Of the samples; None where the reference is a cloud
    notes: tuple[str, ...] = ()  # Sentences for the reader


@dataclass(frozen=True)
class Figures:
    """All figures of a comparison; what was not requested or is unknown is None."""

    summary: Summary  # Over all compared points, at the first tolerance
    tolerances: tuple[Scores, ...]  # At each tolerance
    parts: Parts
    # Completeness by the slope of the reference, of what cameras see where that is known; empty where it is a cloud
    reached: tuple[ReachedBand, ...]
    circumstances: Circumstances
    vertical: Vertical | None = None  # Where the reference is a mesh
    uncertainty: VerticalUncertainty | None = None  # Where depths are known
    checkpoints: Checkpoints | None = None
    c2c: CloudToCloud | None = None
    m3c2: M3C2 | None = None
    reference_surface: ReferenceSurface | None = None  # Where the reference is a cloud

    @property
    def wet(self) -> DistanceStatistics | None:
        """Vertical differences of the points under water."""
        depth = self.parts.depth if self.vertical is None else self.vertical.depth
        return None if depth is None else depth.wet


@dataclass(frozen=True)
class Comparison:
    """A finished comparison."""

    figures: Figures
    points: np.ndarray  # (N, 3), in crs: the compared points
    distances: np.ndarray  # (N,) [m]: Theirs, signed; NaN where a reference of points does not surround them
    # (N, 3) [m], local: the nearest points of the reference, or those of its surface straight above or below
    nearest: np.ndarray
    depth: np.ndarray | None  # (N,) [m] or None: of the reference below the water at those, where it is known
    targets: np.ndarray  # (M, 3), in crs: what should be reached: the visible points, else samples of the reference
    is_reached: np.ndarray  # (M,) bool: at the first tolerance
    inputs: Inputs

    @property
    def distances_of_cloud(self) -> np.ndarray:
        """Distances of all points of the file [m], in its order, NaN outside the bounds."""
        distances = np.full(len(self.inputs.inside), np.nan)
        distances[self.inputs.inside] = self.distances
        return distances
