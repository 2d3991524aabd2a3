"""What the parts of a run take on one core with AVX-512, and a whole run on several.

From runs of data/quick, river and wreck_water in draft and standard quality and of a drawn survey of 8 small
photographs: 5.7 to 107 s on two idle cores, which `run_s` meets within a tenth (docs/notes/performance.md).
"""

from __future__ import annotations

from dataclasses import dataclass

from fields.sweep.passes import PASSES, before_solver

# The first pass of the sweep tries as many heights as its bound holds.
FIRST_RUNGS = 25
# Pixels times heights times neighbours of the sweep that one core compares in a second, by Dr.Jit on LLVM, with the
# search beside steps.
STEPS_PER_CORE_S = 55e6
# Share of the pixels that passes of points alone take, with the halos of their tiles: a seventh of data/river, a fifth
# of data/wreck_water, half of data/quick, whose 21 photographs see little ground.
_POINTS = 0.25
# Imports, hashes, report: of any run; kernels, which are made by all cores.
_START_S, _KERNELS_S = 4.5, 2.0
# Check of the poses of so many photographs, and adjustment of all, at no more than so many megapixels each: once, and
# per megapixel.
_CHECKED, _MOST_MPX = 10, 6.0
_CHECK_S, _ADJUST_S = (2.5, 0.1), (2.0, 2.0)
# Decoding a megapixel; bed and report, per point.
_DECODING_S, _POINT_S = 0.02, 3e-6
# The range of heights, of photographs as large as its thumbnails or larger.
_RANGE_S, _THUMBNAIL_PX = 2.0, 512 * 384
# Of the solver: once, and per pixel of a height map.
_SOLVER_S = (1.4, 1.2e-6)
_FIELD_S_PER_CELL = 2.3e-4


@dataclass(frozen=True)
class Amounts:
    """How much of what there is in a run.

    Attributes
    ----------
    num_views : int
    photographs_mpx : float
        Of all of them [Mpx].
    largest_px : float
        Of one photograph at the size that is worked on [px].
    map_px : float
        Of the views that get a height map [px].
    points : float
        One for each ground sampling distance squared that two views see.
    field_cells : float
        Of a trained field; 0 without.
    poses : "check", "refine" or "fixed"
        What is done with them first.
    solves : bool
    """

    num_views: int
    photographs_mpx: float
    largest_px: float
    map_px: float
    points: float
    field_cells: float
    poses: str
    solves: bool


def run_s(amounts: Amounts, num_cores: int) -> float:
    """A whole run on idle cores [s]: what one thread does, and what all cores share."""
    one = _START_S + poses_s(amounts.poses, amounts.photographs_mpx, amounts.num_views)
    one += _RANGE_S * min(amounts.largest_px / _THUMBNAIL_PX, 1.0)
    one += _DECODING_S * amounts.photographs_mpx + _POINT_S * amounts.points
    samples = amounts.map_px * sum(
        p.scale**2 * (p.hypotheses or FIRST_RUNGS) * p.neighbours * (_POINTS if p.points_only else 1.0)
        for p in (before_solver(PASSES) if amounts.solves else PASSES)
    )
    shared = _KERNELS_S + samples / STEPS_PER_CORE_S + _FIELD_S_PER_CELL * amounts.field_cells
    if amounts.solves:
        shared += _SOLVER_S[0] + _SOLVER_S[1] * amounts.map_px
    return one + shared / num_cores


def poses_s(poses: str, photographs_mpx: float, num_views: int) -> float:
    """Of the check or the adjustment of the poses, whichever it is, or neither [s]."""
    adjusted = min(photographs_mpx, num_views * _MOST_MPX)
    if poses == "check":
        return _CHECK_S[0] + _CHECK_S[1] * adjusted * min(_CHECKED / num_views, 1.0)
    return _ADJUST_S[0] + _ADJUST_S[1] * adjusted if poses == "refine" else 0.0
