"""Times of the parts of a run, by rates on one core with AVX-512 and the speed-up on several.

From runs of data/quick, river and wreck_water in draft and standard quality and of a drawn survey of 8 small
photographs: 5.7 to 107 s on two idle cores, which the sum meets within a tenth (docs/performance.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fields.models import IN_LAYER
from fields.occluded.holes import SIDE_GSD
from fields.sweep.passes import PASSES, POINTS_SHARE, Pass, before_solver

# Imports and hashes of any run.
START_S = 2.5
# Samples of the sweep (pixels x hypotheses x neighbours) per core and second, by Dr.Jit on LLVM, including the search
# beside steps; usual number of hypotheses of its first pass.
_SAMPLES_PER_CORE_S, _FIRST_HYPOTHESES = 55e6, 25
# Compilation of kernels, on all cores; the range of heights.
_KERNELS_S, _RANGE_S = 2.0, 2.0
# Check of poses with this many photographs, and adjustment with all, at most at this size [Mpx]; times once, and per
# megapixel.
_CHECKED, _MOST_MPX = 10, 6.0
_CHECK_S, _ADJUST_S = (2.5, 0.1), (2.0, 2.0)
# Structure from motion: features per megapixel and matching per pair, on all cores; mapping per photograph, on one.
_FEATURES_S, _PAIR_S, _PLACING_S = 0.6, 0.1, 0.1
SFM_PARTS = ("Features", "Matches", "Structure from motion")
# Decoding a megapixel; the report, once; bed and report, per point.
_DECODING_S, _REPORT_S, _POINT_S = 0.02, 2.0, 3e-6
# Of the solver: once, and per pixel of a height map. Of a trained field, per cell of one ground sampling distance.
_SOLVER_S, _FIELD_S_PER_CELL = (1.4, 1.2e-6), 2.3e-4
# Of boxes beside edges: one of a sample of so many, by two cores. Whether the others are searched shows there.
_BOX_S, _MOST_BOXES, _BOX_CORES = 0.4, 32, 2


@dataclass(frozen=True)
class Amounts:
    """Amounts of work of a run on V photographs, of which M get a height map."""

    photographs_px: np.ndarray  # (V,): pixels of each, as it is
    view_px: np.ndarray  # (V,): at the scale of the run
    map_px: np.ndarray  # (M,)
    points: float  # Of the bed, one for each ground sampling distance squared, at most
    poses: str  # "check", "refine" or "fixed": what is done with them first
    field: str  # "solver", "off" or a model of `fields.models.IN_LAYER`
    has_boxes: bool = False
    # Whether these are upper bounds: poses are not known yet, or there are too many views to choose from
    is_bound: bool = False


def parts_s(amounts: Amounts, num_cores: int) -> dict[str, float]:
    """Times [s] of the parts of a run on idle cores, by the names of their stages, in order."""
    num_views, whole_mpx, map_px = len(amounts.view_px), amounts.photographs_px.sum() / 1e6, float(amounts.map_px.sum())
    parts = {"Images": _DECODING_S * whole_mpx}
    solves, mpx = amounts.field != "off", min(whole_mpx, num_views * _MOST_MPX)
    if amounts.poses == "check":
        parts["Poses"] = _CHECK_S[0] + _CHECK_S[1] * mpx * min(_CHECKED / num_views, 1.0)
    elif amounts.poses == "refine":
        parts = {"Adjustment": _ADJUST_S[0] + _ADJUST_S[1] * mpx} | parts
    samples = _samples(map_px, before_solver(PASSES) if solves else PASSES)
    parts["Sweep"] = _RANGE_S + (_KERNELS_S + samples / _SAMPLES_PER_CORE_S) / num_cores
    if solves:
        parts["Solver"] = (_SOLVER_S[0] + _SOLVER_S[1] * map_px) / num_cores
    if amounts.field in IN_LAYER:
        parts["Field"] = _FIELD_S_PER_CELL * amounts.points / num_cores
    parts["Points"] = 0.5 * _POINT_S * amounts.points
    if amounts.has_boxes:
        sample = min(amounts.points / SIDE_GSD**2, _MOST_BOXES)
        parts["Boxes beside edges"] = _BOX_S * sample / min(num_cores, _BOX_CORES)
    return parts | {"Report": _REPORT_S + 0.5 * _POINT_S * amounts.points}


def sfm_s(features_mpx: float, num_views: int, num_pairs: int, num_cores: int) -> dict[str, float]:
    """Times [s] of the parts of structure from motion, by the names of their stages, in order.

    ``features_mpx`` [Mpx] are those of the photographs at the size at which features are looked for.
    """
    seconds = (
        _FEATURES_S * features_mpx / num_cores,
        _PAIR_S * num_pairs / num_cores,
        _PLACING_S * num_views,
    )
    return dict(zip(SFM_PARTS, seconds, strict=True))


def _samples(map_px: float, passes: tuple[Pass, ...]) -> float:
    def of(p: Pass) -> float:
        tried = (p.hypotheses or _FIRST_HYPOTHESES) * p.neighbours
        return p.scale**2 * tried * (POINTS_SHARE if p.points_only else 1.0)

    return map_px * sum(of(p) for p in passes)
