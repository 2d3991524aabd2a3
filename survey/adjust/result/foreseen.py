"""Expected covariance of an adjustment from the poses of a flight alone (pre-analysis of the network).

Points are put on a rough bed at some depth, as many as an adjustment takes, seen by the views whose frames they are in,
and good to what is assumed. No pixel is read; it takes seconds. Where the plan keeps the poses, the std of heights is
that of a run which keeps them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from evaluation.standards import TO_95, TVU
from survey.adjust.block.normal_equations import huber_system
from survey.adjust.block.normal_matrix import propagated_variance
from survey.adjust.block.observed import CELLS, KINDS, PER_CELL, WINDOW
from survey.adjust.block.prediction import apparent_rise_design, linearise_by_points, predict
from survey.adjust.block.priors import EXACT_STD_DEG, EXACT_STD_M, INDEX_STD, LEVEL_STD_M, prior_of, priors_for
from survey.adjust.block.problem import Problem
from survey.adjust.block.state import NUM_RELIEF, NUM_WATER, Layout, State
from survey.adjust.result.adjustment import MOST_STD_FOCAL, MOST_STD_INDEX, MOST_STD_LEVEL_M
from survey.adjust.result.std_common import place_jacobian_at, std_common
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints
from survey.plan.area import ASSUMED_DEPTH_M, in_the_middle, places_of
from survey.plan.check import CheckSection, Verdict, verdict_by_limits, verdict_text
from survey.plan.choices import USUAL, Choices
from survey.plan.plan import Plan, make_plan
from survey.water.level import ASSUMED_INDEX_STD

# What is assumed [px] of the windows of an adjustment and of the pixels of the cloud, in clear and still water: on
# drawn surveys level and index are then found up to twice as well as foreseen (docs/adjustment.md).
TIE_STD_PX, MATCH_STD_PX = 0.1, 0.2
# By how much of its depth the bed goes up and down about it.
RELIEF_SHARE, _SEED = 0.3, 20_261_122
# Depths that heights are foreseen for, over the main one; larger ones than that down to a share of the flying height.
DEPTH_SHARES, _DEEPEST_SHARE = (0.25, 0.5, 1.0, 2.0, 4.0), 0.5
# A place of the bed is in so many frames, at most, that count for its height.
_MOST_VIEWS = 12
# Good and fair: photographs that the worst tenth of the places is in; angles between rays to a place.
OVERLAP, ANGLES_DEG = (5.0, 3.0), (30.0, 15.0)
_ADJUSTED = "poses and lens adjusted"
_KEPT = (
    "for heights poses and lens kept, as good as those of an adjusted block "
    f"({100 * EXACT_STD_M:g} cm, {EXACT_STD_DEG:g} degrees) where nothing is said"
)


@dataclass(frozen=True)
class HeightStds:
    """Expected standard deviations of heights, medians over a bed."""

    depth_m: float  # [m]
    of_point_m: float  # [m]: one sigma of the height of a point by the noise of matching
    # [m]: of all heights together by water, lens and poses: by what an adjustment leaves uncertain of them, all known
    # before as survey.toml says; where the plan keeps the poses, as `std_common` has it without an adjustment
    of_all_m: float


@dataclass(frozen=True)
class Foreseen:
    """Expected accuracy from poses alone."""

    # (low, median): frames that a place of the area is in: of the lowest tenth, and the median
    views_of_place: tuple[float, float]
    angle_deg: float  # [deg]: median over the places of the widest angle between two rays in air
    # level_std_m, index_std, focal_std [m], [-], [share of it]: one sigma of what the photographs would tell if nothing
    # were known of the water; NaN for a dry survey
    level_std_m: float
    index_std: float
    focal_std: float
    heights: HeightStds
    is_adjusted: bool  # Whether the plan adjusts poses, lens and water, which is what the heights are foreseen for


def foresee(survey: Survey, *, depth_m: float = ASSUMED_DEPTH_M, chosen: Choices = USUAL) -> Foreseen | None:
    """Expected accuracy of a survey over a level bed under so much water; None where too few views overlap.

    Of a large survey the views in its middle count. Photographs that the quality of the run halves are matched to
    larger pixels, and its plan adjusts the poses or keeps them.
    """
    plan, survey = make_plan(survey, chosen), in_the_middle(survey)
    ties = _ties(survey, depth_m)
    if ties is None:
        return None
    covariance, layout, *_ = _covariance(survey, plan.gsd_m, ties, free=True)
    at_level, at_index, at_focal = 0, NUM_WATER - 1, layout.first_lens
    std = np.sqrt(np.diag(covariance))
    is_wet = survey.water is not None
    focal = survey.views[0].camera.fx
    views = np.bincount(ties.point)
    return Foreseen(
        views_of_place=(float(np.quantile(views, 0.1)), float(np.median(views))),
        angle_deg=float(np.median(_angles(survey, ties))),
        level_std_m=float(std[at_level]) if is_wet else math.nan,
        index_std=float(std[at_index]) if is_wet else math.nan,
        focal_std=float(std[at_focal]) / focal,
        heights=_stds_of_heights(survey, plan, ties, depth_m),
        is_adjusted=_is_adjusted(plan),
    )


def heights_by_depth(survey: Survey, depth_m: float = ASSUMED_DEPTH_M, *, chosen: Choices = USUAL) -> list[HeightStds]:
    """Expected standard deviations at a depth and several about it; none for a dry survey."""
    if survey.water is None:
        return []
    plan, survey = make_plan(survey, chosen), in_the_middle(survey)
    deepest = max(depth_m, _DEEPEST_SHARE * plan.height_m)
    found = []
    for depth in (depth_m * share for share in DEPTH_SHARES):
        ties = _ties(survey, depth) if depth <= deepest else None
        if ties is not None:
            found.append(_stds_of_heights(survey, plan, ties, depth))
    return found


def _is_adjusted(plan: Plan) -> bool:
    """Whether a plan adjusts for certain: it mostly keeps poses that it checks first."""
    return plan.pose_choice == "refine"


def _ties(survey: Survey, depth_m: float) -> TiePoints | None:
    """Places of a rough bed, seen by all views that have them in their frame; their pixels are not filled in yet."""
    places = places_of(survey, depth_m)
    if places is None:
        return None
    # As many observations in a photograph as the thinning of an adjustment leaves.
    num_places = CELLS**2 * PER_CELL * len(survey.views) / places.seen.sum(axis=0).mean()
    places = places.some(round(num_places))
    # On a level bed, level and index could not be separated at all.
    rough = np.random.default_rng(_SEED).uniform(-1.0, 1.0, len(places.cells))
    places.cells[:, 2] += RELIEF_SHARE * depth_m * rough
    point, view = np.nonzero(places.seen.T)
    return TiePoints(places.cells, point, view, np.zeros((len(point), 2)))


def _covariance(
    survey: Survey, gsd: float, ties: TiePoints, *, free: bool
) -> tuple[np.ndarray, Layout, State, TiePoints]:
    """Covariance (P, P) if each view measured all places in its frame; its layout, state and tie points."""
    # Poses of which nothing is stated count as those of an adjusted block.
    prior = prior_of(survey, gsd, free_water=survey.water is not None)
    if not free:
        std = prior.std.copy()
        std[:NUM_WATER] = prior_of(survey, gsd).std[:NUM_WATER]
        prior = replace(prior, std=std)
    state = replace(prior.mean, points=ties.start)
    rise_design = apparent_rise_design(state, ties)
    # Pixels of cameras that stand still tell the rows at which those that fly on take them.
    ties = replace(ties, pixel=predict(replace(prior.layout, velocity_per_row=None), state, ties, rise_design))
    ties = replace(ties, pixel=predict(prior.layout, state, ties, rise_design))
    std_px = np.full(len(KINDS), TIE_STD_PX)
    kind = np.full(len(ties.view), WINDOW)
    problem = Problem(prior.layout, ties, kind, priors_for(prior, ties), std_px, rise_design)
    return huber_system(problem, state, std_px).normal.inverse, prior.layout, state, ties


def _stds_of_heights(survey: Survey, plan: Plan, ties: TiePoints, depth_m: float) -> HeightStds:
    covariance, layout, state, ties = _covariance(survey, plan.gsd_m, ties, free=False)
    first = np.searchsorted(ties.point, np.arange(len(ties) + 1))
    of_points = [np.linspace(low, high - 1, min(high - low, _MOST_VIEWS)) for low, high in pairwise(first)]
    some = np.concatenate(of_points).round().astype(np.int64)
    ties = TiePoints(ties.start, ties.point[some], ties.view[some], ties.pixel[some])
    still, rows = np.zeros((len(some), NUM_RELIEF)), ties.pixel[:, 1]
    _, by_point = linearise_by_points(layout, state, ties, still, rows)
    normal = np.einsum("nai,naj->nij", by_point, by_point)
    normal = np.add.reduceat(normal, np.searchsorted(ties.point, np.arange(len(ties))), axis=0)
    std = np.sqrt(np.linalg.pinv(normal, hermitian=True)[:, 2, 2])
    of_point = float(np.median(std)) * MATCH_STD_PX / plan.image_scale
    if _is_adjusted(plan):
        kept = np.r_[:NUM_WATER, layout.first_lens : len(layout)]
        jacobian = place_jacobian_at(layout, state, ties, rows)[:, 2]
        common = np.sqrt(propagated_variance(jacobian, covariance[np.ix_(kept, kept)]))
    else:
        common = std_common(ties.start, np.full(len(ties), survey.water is not None), survey, None, plan.gsd_m)
    return HeightStds(depth_m, of_point, float(np.nanmedian(common)))


def _angles(survey: Survey, ties: TiePoints) -> np.ndarray:
    """The widest angle (M,) [deg] between two rays from each place, as if there were no water."""
    centres = np.array([view.camera.centre for view in survey.views])
    found = np.empty(len(ties))
    first = np.searchsorted(ties.point, np.arange(len(ties) + 1))
    for number, place in enumerate(ties.start):
        rays = centres[ties.view[first[number] : first[number + 1]]] - place
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        found[number] = math.degrees(math.acos(float(np.clip((rays @ rays.T).min(), -1.0, 1.0))))
    return found


def foreseen_section(
    survey: Survey, *, depth_m: float = ASSUMED_DEPTH_M, chosen: Choices = USUAL
) -> CheckSection | None:
    """Section of `check` with the expected accuracy; None where too few views overlap."""
    found = foresee(survey, depth_m=depth_m, chosen=chosen)
    if found is None:
        return None
    return CheckSection("Foreseen from the poses", rows_of(found, heights_by_depth(survey, depth_m, chosen=chosen)))


def rows_of(found: Foreseen, by_depth: Sequence[HeightStds]) -> tuple[tuple[str, str], ...]:
    """The expected accuracy as labelled sentences."""
    is_wet = math.isfinite(found.level_std_m)
    place = f"a rough bed {found.heights.depth_m:g} m under the water" if is_wet else "rough ground"
    assumed = (
        f"{place}, tie points good to {TIE_STD_PX:g} px, matches to {MATCH_STD_PX:g} px of the processed images, "
        f"{_ADJUSTED if found.is_adjusted else _KEPT}, level and index known to {LEVEL_STD_M:g} m and {INDEX_STD:g} "
        f"where nothing is said, an index that is not given to {ASSUMED_INDEX_STD:g}, still and clear water "
        "without glitter"
    )
    low, median = found.views_of_place
    overlap = verdict_text(
        verdict_by_limits(low, *OVERLAP),
        f"a point of the ground is seen in {median:.0f} photographs (median), the worst tenth in {low:.0f} or fewer",
        "fly with 80 % forward and 70 % side overlap, or a smaller area",
    )
    angles = verdict_text(
        verdict_by_limits(found.angle_deg, *ANGLES_DEG),
        f"rays to a point intersect at up to {found.angle_deg:.0f} degrees (median)",
        "add crossing views tilted by 25 to 35 degrees",
    )
    rows = [("overlap", overlap), ("angles", angles)]
    if is_wet:
        rows += [
            ("level", _use(f"to {100.0 * found.level_std_m:.1f} cm", found.level_std_m, MOST_STD_LEVEL_M)),
            ("index", _use(f"to {found.index_std:.4f}", found.index_std, MOST_STD_INDEX)),
        ]
    rows += [
        ("focal length", _use(f"to {100.0 * found.focal_std:.2f} %", found.focal_std, MOST_STD_FOCAL)),
        ("heights", _heights_text(found.heights, by_depth)),
        ("assumed", assumed),
    ]
    return tuple(rows)


def _use(words: str, std: float, limit: float) -> str:
    if std <= limit:
        return verdict_text(Verdict.good, f"the photographs determine it {words}", "")
    return verdict_text(
        Verdict.poor, f"not observable by this flight: {words}", "give it, or add crossing oblique views"
    )


def _heights_text(main: HeightStds, by_depth: Sequence[HeightStds]) -> str:
    """Standard deviations by depth, and the order of S-44 that those at the main depth meet."""
    each = [f"{_mm(std.of_point_m)} / {_mm(std.of_all_m)} mm at {std.depth_m:.2g} m of depth" for std in by_depth]
    values = ", ".join(each) or f"{_mm(main.of_point_m)} / {_mm(main.of_all_m)} mm"
    total = TO_95 * math.hypot(main.of_point_m, main.of_all_m)
    allowed = [(name, math.hypot(a, b * main.depth_m)) for name, a, b in TVU]
    orders = [name for name, most in allowed if total <= most]
    order = f"; enough for S-44 {orders[0]} at {main.depth_m:.2g} m" if orders and by_depth else ""
    return verdict_text(
        verdict_by_limits(total, allowed[0][1], allowed[1][1]),
        f"one sigma, of a point by matching / of all in common by water, lens and poses: {values}{order}",
        "fly lower, with more overlap and oblique views",
    )


def _mm(metres: float) -> str:
    return f"{1000.0 * metres:.0f}" if metres >= 0.001 else f"{1000.0 * metres:.1f}"
