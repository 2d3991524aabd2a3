"""The figures of a comparison, its result, and its plain values for ``compare --json`` and report.json."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from evaluation import AsprsAccuracy, Band, DepthParts, DistanceStatistics, IhoS44, ReachedBand, Scores
from evaluation.standards import TvuOrder
from survey.compare.inputs import Inputs
from survey.files.json_values import plain


@dataclass(frozen=True)
class Parts:
    """Bias and spread of the parts of a cloud; what the cloud lacks is None or empty."""

    depth: DepthParts | None = None
    # incidence, views: By incidence at the water [deg] and by the number of views that agree
    incidence: tuple[Band, ...] = ()
    views: tuple[Band, ...] = ()
    slope: tuple[Band, ...] = ()  # By the slope of the reference [deg]; empty where that is a cloud

    @property
    def banded(self) -> list[tuple[str, str, str, tuple[Band, ...]]]:
        """Bands that are known: their key, what they are of, the unit of their limits."""
        kinds = (
            ("depth", "depth", "m", () if self.depth is None else self.depth.bands),
            ("incidence", "incidence", "deg", self.incidence),
            ("views", "views that agree", "views", self.views),
            ("slope", "slope of the reference", "deg", self.slope),
        )
        return [kind for kind in kinds if kind[-1]]


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
class CheckpointFigures:
    """A cloud at surveyed places."""

    accuracy: AsprsAccuracy
    places: np.ndarray  # (K, 3), in crs
    # (K,) [m]: height of the cloud minus height of the check point; NaN where the cloud does not surround it
    residuals: np.ndarray


@dataclass(frozen=True)
class M3C2:
    """M3C2 distances at some places of the reference."""

    distances: DistanceStatistics
    radius_m: float  # [m]: of the cylinders
    detection_median_m: float  # [m]: median level of detection at 95 %
    significant_share: float  # [-]: share of the distances beyond their level of detection


@dataclass(frozen=True)
class Figures:
    """All figures of a comparison; what was not requested or is unknown is None."""

    n_cropped: int  # Points that were cropped before the comparison
    distances: DistanceStatistics  # Of all compared points
    tolerances: tuple[Scores, ...]  # At each tolerance
    parts: Parts
    # Completeness by the slope of the reference, of what cameras see where that is known; empty where it is a cloud
    reached: tuple[ReachedBand, ...]
    # Files, CRS, bounds, options, block bootstrap (`evaluation.Blocks`), and "notes", sentences for the reader
    circumstances: dict[str, Any]
    # vertical, vertical_depth: Vertical differences to a mesh; points with no surface straight above or below them are
    # in ``n_nan``
    vertical: DistanceStatistics | None = None
    vertical_depth: DepthParts | None = None
    uncertainty: VerticalUncertainty | None = None  # Where depths are known
    checkpoints: CheckpointFigures | None = None
    # "to_reference", "to_cloud": distances without sign to the samples of the reference, and from those to the cloud
    c2c: dict[str, DistanceStatistics] | None = None
    m3c2: M3C2 | None = None
    reference_surface: ReferenceSurface | None = None  # Where the reference is a cloud


@dataclass(frozen=True)
class Comparison:
    figures: Figures
    points: np.ndarray  # (N, 3), in crs: the compared points
    distances: np.ndarray  # (N,) [m]: Theirs, signed; NaN where a reference of points does not surround them
    # (N, 3) [m], local: the nearest points of the reference, or those of its surface straight above or below
    nearest: np.ndarray
    targets: np.ndarray  # (M, 3), in crs: what should be reached: the visible points, else samples of the reference
    is_reached: np.ndarray  # (M,) bool: at the first tolerance
    inputs: Inputs

    def reference_heights(self, rows: np.ndarray) -> np.ndarray:
        """Height (K,) in crs of the reference nearest to points of the file (K,); NaN where none was compared."""
        heights, is_compared = np.full(len(rows), np.nan), self.inputs.inside[rows]
        nearest = self.nearest[np.cumsum(self.inputs.inside)[rows[is_compared]] - 1]
        heights[is_compared] = self.inputs.frame.crs_from_local(nearest)[:, 2]
        return heights


def numbers_of(figures: Figures) -> dict:
    """The figures as dicts, lists, numbers and texts.

    At the top `evaluation.DistanceStatistics` and `evaluation.Scores` over all points (the latter at the first
    tolerance), ``n_cropped``, ``wet``, ``dry``, the bands, ``completeness_by_slope`` (one share for each tolerance) and
    the circumstances; below it ``tolerances``, ``vertical``, ``iho_s44``, ``reference_surface``, ``asprs``, ``c2c`` and
    ``m3c2``. What was not requested is missing; a value that does not exist is None.
    """
    statistics = _known(figures.distances)
    numbers = {"n_points": statistics.pop("n_points"), "n_cropped": figures.n_cropped} | statistics
    numbers |= _known(figures.tolerances[0]) | {"tolerances": [_known(scores) for scores in figures.tolerances]}
    numbers |= _depth_parts(figures.parts.depth)
    numbers |= {f"{key}_bands": _bands(bands, unit) for key, _, unit, bands in figures.parts.banded}
    if figures.reached:
        numbers["completeness_by_slope"] = [
            _limits(band.low, band.high, "deg") | {"n_samples": band.n_samples, "completeness": list(band.completeness)}
            for band in figures.reached
        ]
    if (vertical := figures.vertical) is not None:
        numbers["vertical"] = {**_known(vertical), "n_holes": vertical.n_nan, **_depth_parts(figures.vertical_depth)}
    if figures.uncertainty is not None:
        iho = figures.uncertainty.iho
        numbers["iho_s44"] = {
            "points": iho.n_points,
            "error_95_m": iho.error_95_m,
            "orders": [_order(order) for order in iho.orders],
            "note": iho.note,
            "error": figures.uncertainty.error,
        }
    if figures.reference_surface is not None:
        numbers["reference_surface"] = asdict(figures.reference_surface)
    if (checkpoints := figures.checkpoints) is not None:
        rows = np.column_stack([checkpoints.places, checkpoints.residuals]).tolist()
        names = ("easting", "northing", "height", "residual_m")
        residuals = [dict(zip(names, row, strict=True)) for row in rows]
        numbers["asprs"] = asdict(checkpoints.accuracy) | {"residuals": residuals}
    if figures.c2c is not None:
        numbers["c2c"] = {name: _known(distances) for name, distances in figures.c2c.items()}
    if figures.m3c2 is not None:
        numbers["m3c2"] = _known(figures.m3c2.distances) | asdict(figures.m3c2)
        del numbers["m3c2"]["distances"]
    return plain(numbers | figures.circumstances)


def _known(record: DistanceStatistics | Scores) -> dict:
    """Figures of a record, without those that are None."""
    return {name: value for name, value in asdict(record).items() if value is not None}


def _depth_parts(parts: DepthParts | None) -> dict:
    if parts is None:
        return {}
    split = {"wet": parts.wet, "dry": parts.dry}
    numbers = {name: _known(part) for name, part in split.items() if part is not None}
    return numbers | {"depth_bands": _bands(parts.bands, "m")}


def _bands(bands: tuple[Band, ...], unit: str) -> list[dict]:
    return [_limits(band.low, band.high, unit) | _known(band.distances) for band in bands]


def _limits(low: float, high: float, unit: str) -> dict:
    return {f"from_{unit}": low, f"to_{unit}": None if math.isinf(high) else high}


def _order(order: TvuOrder) -> dict:
    return {
        "order": order.name,
        "tvu_at_median_depth_m": order.tvu_at_median_depth_m,
        "share_within": order.share_within,
        "meets_tvu": order.meets_tvu,
        "meets_tvu_at_all_depths": order.meets_tvu_at_all_depths,
        "undecided": order.is_undecided,
        "depth_bands": [
            _limits(band.low_m, band.high_m, "m") | {"n_points": band.n_points, "share_within": band.share_within}
            for band in order.bands
        ],
    }
