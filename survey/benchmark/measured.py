"""Accuracy of a cloud against the truth of its survey, in the figures of a benchmark.

The methods that are compared: the whole chain, parts of it, and what there was before it.

Baselines get the same photographs, poses and sweep as the whole chain; only the refraction is taken away, by a survey
without water, and put back afterwards as the literature does.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evaluation import Coverage, slope_below, vertical_difference
from evaluation.coverage import WALL_DEG
from geo import Mesh
from survey.benchmark.cases import Case
from survey.benchmark.records import Errors
from survey.compare.area import to_local
from survey.compare.comparison import CompareOptions, compare_surfaces
from survey.compare.figures import Comparison

TOLERANCES_M = (0.05, 0.1, 0.2)
_INNER = 0.9
# Blocks along the longer side of the area: enough of them to resample, each many points wide.
_BLOCKS = 16
_STD, _STD_COMMON = "std", "std_common"


def errors_of(cloud: Path, case: Case) -> Errors:
    """The errors of a cloud.

    Raises
    ------
    GeoError, SurveyError
        As `survey.compare.comparison.compare_surfaces`.
    """
    found = compare_surfaces(
        cloud, case.reference, CompareOptions(TOLERANCES_M, visible=case.visible, bounds=case.bounds)
    )
    whole, distances = found.figures.summary.distances, found.distances
    shares = {
        f"{scores.tolerance_m:g}": scores.completeness if case.visible is None else scores.completeness_visible
        for scores in found.figures.tolerances
    }
    stated = _stated(found)
    inner = np.abs(distances) <= np.nanquantile(np.abs(distances), _INNER)
    return Errors(
        n_points=whole.n_points,
        mean_m=whole.mean_inner90_m,
        std_m=whole.std_inner90_m,
        rms_m=whole.rms_m,
        completeness={tolerance: float(share) for tolerance, share in shares.items() if share is not None},
        coverage=stated.coverage,
        median_m=stated.median_m,
        common_m=stated.common_m,
        blocks=_blocks(found.points[inner, :2], distances[inner], case),
    )


@dataclass(frozen=True)
class _Stated:
    """Stated std of the points against their errors: see `survey.benchmark.records.Errors`."""

    coverage: float | None = None
    median_m: float | None = None
    common_m: float | None = None


def _stated(found: Comparison) -> _Stated:
    """Stated std against the errors of points with a std, over a mesh, where that is no wall."""
    reference, extra = found.inputs.reference, found.inputs.cloud.extra
    if _STD not in extra or not isinstance(reference, Mesh):
        return _Stated()
    paths = found.inputs.paths
    points = to_local(found.inputs.frame, found.points, paths.cloud)
    vertices = to_local(found.inputs.frame, reference.vertices, paths.reference)
    error = vertical_difference(points, vertices, reference.faces)
    known = np.isfinite(error) & (slope_below(points, vertices, reference.faces) < WALL_DEG)
    if not known.any():
        return _Stated()
    std = {name: extra[name][found.inputs.inside][known] for name in (_STD, _STD_COMMON) if name in extra}
    error, median = error[known], float(np.median(error[known]))
    common = std.get(_STD_COMMON, np.empty(0))
    common = common[np.isfinite(common)]
    covered = Coverage.of(error - median, std[_STD], np.isfinite(std[_STD]))
    return _Stated(covered.share, median, float(np.median(common)) if len(common) else None)


def _blocks(plan: np.ndarray, distances: np.ndarray, case: Case) -> dict[str, list[float]]:
    """Number, sum and sum of squares of distances by block; its name is "column,row" from the corner of the bounds."""
    low = plan.min(axis=0) if case.bounds is None else np.array(case.bounds[:2])
    high = plan.max(axis=0) if case.bounds is None else np.array(case.bounds[2:])
    cell = np.floor((plan - low) / (float((high - low).max()) / _BLOCKS)).astype(np.int64)
    cells, number = np.unique(cell, axis=0, return_inverse=True)
    sums = [
        np.bincount(number.ravel(), weights=values) for values in (np.ones_like(distances), distances, distances**2)
    ]
    # Six digits: far less than an interval of their ratios has.
    return {f"{x},{y}": [float(f"{v:.6g}") for v in row] for (x, y), row in zip(cells, np.transpose(sums), strict=True)}


@dataclass(frozen=True)
class Method:
    """Method: a way from photographs to a cloud."""

    name: str
    words: str  # For tables and pictures
    field: str = "auto"  # The option of `process`
    is_refracted: bool = True  # False: the survey is processed as if it were dry
    # "", "times_index" or "per_camera": what is done to the depths of the cloud afterwards, see
    # `survey.benchmark.corrected`
    correction: str = ""


METHODS = {
    method.name: method
    for method in (
        Method("full", "whole chain"),
        Method("sweep", "sweep alone", field="off"),
        Method("slab", "trained field", field="slab"),
        Method("straight", "straight rays", is_refracted=False),
        Method("times_index", "straight rays, depth times n", is_refracted=False, correction="times_index"),
        Method("per_camera", "straight rays, corrected per camera", is_refracted=False, correction="per_camera"),
    )
}
