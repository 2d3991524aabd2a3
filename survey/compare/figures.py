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
    """Bias and spread of the parts of a cloud; what the cloud lacks is None or empty.

    Attributes
    ----------
    depth : DepthParts or None
    incidence, views : tuple of Band
        By incidence at the water [deg] and by the number of views that agree.
    slope : tuple of Band
        By the slope of the reference [deg]; empty where that is a cloud.
    """

    depth: DepthParts | None = None
    incidence: tuple[Band, ...] = ()
    views: tuple[Band, ...] = ()
    slope: tuple[Band, ...] = ()


@dataclass(frozen=True)
class Vertical:
    """Vertical differences to a mesh.

    Attributes
    ----------
    distances : DistanceStatistics
        Points with no surface straight above or below them have no difference: they are in ``n_nan``.
    depth : DepthParts or None
    """

    distances: DistanceStatistics
    depth: DepthParts | None


@dataclass(frozen=True)
class ReferenceSurface:
    """The surface through a reference of points, at the places compared.

    Attributes
    ----------
    spacing_m : [m]
        Between its points.
    std_median_m, std_95_m : [m]
        Standard deviation of its heights between them; 95 % are below the second.
    """

    spacing_m: float
    std_median_m: float
    std_95_m: float


@dataclass(frozen=True)
class VerticalUncertainty:
    """Vertical errors against IHO S-44.

    Attributes
    ----------
    iho : IhoS44
    error : str
        Which error was judged.
    """

    iho: IhoS44
    error: str


@dataclass(frozen=True)
class Checkpoints:
    """A cloud at surveyed places.

    Attributes
    ----------
    accuracy : AsprsAccuracy
    places : (K, 3), in crs
    residuals : (K,) [m]
        Height of the cloud minus height of the check point; NaN where the cloud does not surround it.
    """

    accuracy: AsprsAccuracy
    places: np.ndarray
    residuals: np.ndarray


@dataclass(frozen=True)
class CloudToCloud:
    """Distances without sign from the cloud to the samples of the reference, and from those to the cloud."""

    to_reference: DistanceStatistics
    to_cloud: DistanceStatistics


@dataclass(frozen=True)
class M3C2:
    """M3C2 distances at some places of the reference.

    Attributes
    ----------
    distances : DistanceStatistics
    radius_m : [m]
        Of the cylinders.
    detection_median_m : [m]
        Median level of detection at 95 %.
    significant_share : [-]
        Share of the distances beyond their level of detection.
    """

    distances: DistanceStatistics
    radius_m: float
    detection_median_m: float
    significant_share: float


@dataclass(frozen=True)
class Circumstances:
    """Circumstances of the figures: files, CRS, bounds, options.

    Attributes
    ----------
    outliers : str or None
        The filter, as the option.
    block_m, correlation_length_m, widening : [m], [m], [-]
        Of the block bootstrap, see `evaluation.Blocks`.
    water_level : float or None, in crs
    method : str
    sign : {"up", "winding"}
    crs : str or None
        Name of the coordinate reference system.
    bounds : (E0, N0, E1, N1) or None, in crs
    cloud, reference : str
        Paths.
    visible : str or None
        Path.
    n_samples : int
        Of the reference.
    seed : int or None
        Of the samples; None where the reference is a cloud.
    notes : tuple of str
        Sentences for the reader.
    """

    outliers: str | None
    block_m: float
    correlation_length_m: float
    widening: float
    water_level: float | None
    method: str
    sign: Sign
    crs: str | None
    bounds: Bounds | None
    cloud: str
    reference: str
    visible: str | None
    n_samples: int
    seed: int | None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Figures:
    """All figures of a comparison; what was not requested or is unknown is None.

    Attributes
    ----------
    summary : Summary
        Over all compared points, at the first tolerance.
    tolerances : tuple of Scores
        At each tolerance.
    parts : Parts
    reached : tuple of ReachedBand
        Completeness by the slope of the reference, of what cameras see where that is known; empty where it is a cloud.
    circumstances : Circumstances
    vertical : Vertical or None
        Where the reference is a mesh.
    uncertainty : VerticalUncertainty or None
        Where depths are known.
    checkpoints : Checkpoints or None
    c2c : CloudToCloud or None
    m3c2 : M3C2 or None
    reference_surface : ReferenceSurface or None
        Where the reference is a cloud.
    """

    summary: Summary
    tolerances: tuple[Scores, ...]
    parts: Parts
    reached: tuple[ReachedBand, ...]
    circumstances: Circumstances
    vertical: Vertical | None = None
    uncertainty: VerticalUncertainty | None = None
    checkpoints: Checkpoints | None = None
    c2c: CloudToCloud | None = None
    m3c2: M3C2 | None = None
    reference_surface: ReferenceSurface | None = None

    @property
    def wet(self) -> DistanceStatistics | None:
        """Vertical differences of the points under water."""
        depth = self.parts.depth if self.vertical is None else self.vertical.depth
        return None if depth is None else depth.wet


@dataclass(frozen=True)
class Comparison:
    """A finished comparison.

    Attributes
    ----------
    figures : Figures
    points : (N, 3), in crs
        The compared points.
    distances : (N,) [m]
        Theirs, signed; NaN where a reference of points does not surround them.
    nearest : (N, 3) [m], local
        The nearest points of the reference, or those of its surface straight above or below.
    depth : (N,) [m] or None
        Of the reference below the water at those, where it is known.
    targets : (M, 3), in crs
        What should be reached: the visible points, else samples of the reference.
    is_reached : (M,) bool
        At the first tolerance.
    inputs : Inputs
    """

    figures: Figures
    points: np.ndarray
    distances: np.ndarray
    nearest: np.ndarray
    depth: np.ndarray | None
    targets: np.ndarray
    is_reached: np.ndarray
    inputs: Inputs

    @property
    def distances_of_cloud(self) -> np.ndarray:
        """Distances of all points of the file [m], in its order, NaN outside the bounds."""
        distances = np.full(len(self.inputs.inside), np.nan)
        distances[self.inputs.inside] = self.distances
        return distances
