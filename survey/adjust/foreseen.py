"""What a flight can tell, from its poses alone: the covariance of an adjustment whose photographs nobody has measured.

Points are put on a rough bed at some depth, as many as an adjustment takes, seen by the views whose frames they are in,
and good to what is assumed. No pixel is read; it takes seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from fields.sweep.views import coverage
from survey.adjust.bundle import Problem, covariance_at
from survey.adjust.observed import KINDS, WINDOW
from survey.adjust.prediction import linearise, predict, relief_sides
from survey.adjust.priors import known_of, priors_for
from survey.adjust.state import RELIEF, WATER
from survey.adjust.thinning import CELLS, PER_CELL
from survey.adjust.verdicts import MOST_STD_FOCAL, MOST_STD_INDEX, MOST_STD_LEVEL_M
from survey.folder.survey import Survey
from survey.photos.tie_points import MIN_TRACK, TiePoints
from survey.plan.area import local_area, within
from survey.plan.check import Section
from survey.plan.ground import ground_height
from survey.plan.plan import make_plan

# What is assumed [px] of the windows of an adjustment and of the pixels of the cloud, in clear and still water: on
# drawn surveys level and index are then found up to twice as well as foreseen (docs/adjustment.md).
TIE_STD_PX, MATCH_STD_PX = 0.1, 0.15
# Under the water, where nothing tells the depth [m].
DEPTH_M = 2.0
# By how much of its depth the bed goes up and down about it.
RELIEF_SHARE, _SEED = 0.3, 20_261_122
# A place of the bed is in so many frames, at most, that count for its height.
_MOST_VIEWS = 12
# Views of a block that are adjusted: its middle is then as stiff as that of a larger one, and it takes seconds.
_MOST_IN_BLOCK = 100


@dataclass(frozen=True)
class Foreseen:
    """What poses alone promise.

    Attributes
    ----------
    views_of_place : (low, median)
        Frames that a place of the area is in: of the lowest tenth, and the median.
    angle_deg : [deg]
        Median over the places of the widest angle between two rays in air.
    level_std_m, index_std, focal_std : [m], [-], [share of it]
        One sigma of what the photographs would tell if nothing were known of the water; NaN for a dry survey.
    point_std_m : [m]
        Median over the places: height of a point by the noise of matching.
    common_std_m : [m]
        Median over the places: height by what is uncertain of water, lens and poses, all known as survey.toml says.
    """

    views_of_place: tuple[float, float]
    angle_deg: float
    level_std_m: float
    index_std: float
    focal_std: float
    point_std_m: float
    common_std_m: float


def foreseen_section(survey: Survey) -> Section | None:
    """What is foreseen, for `check`; None where too few views overlap."""
    found = foresee(survey)
    return None if found is None else Section("Foreseen from the poses", rows_of(found))


def foresee(survey: Survey, *, depth_m: float = DEPTH_M) -> Foreseen | None:
    """What the poses of a survey promise for a level bed; None where too few views overlap.

    Parameters
    ----------
    survey : Survey
        Of a large one, the views in its middle count.
    depth_m : [m]
        Of the bed under the water.
    """
    survey = _in_the_middle(survey)
    gsd = make_plan(survey).gsd_m
    places = _places(survey, depth_m)
    if places is None:
        return None
    seen, cells = places
    point, view = np.nonzero(seen.T)
    # Their pixels are filled in by `_covariance`.
    ties = TiePoints(cells, point, view, np.zeros((len(point), 2)))
    free, given = (_covariance(survey, gsd, ties, free=free) for free in (True, False))
    at_level, at_index, at_focal = 0, WATER - 1, WATER + RELIEF
    std = np.sqrt(np.diag(free.covariance))
    is_wet = survey.water is not None
    focal = survey.views[0].camera.fx
    heights = _heights(given)
    return Foreseen(
        views_of_place=(float(np.quantile(seen.sum(axis=0), 0.1)), float(np.median(seen.sum(axis=0)))),
        angle_deg=float(np.median(_angles(survey, seen, cells))),
        level_std_m=float(std[at_level]) if is_wet else math.nan,
        index_std=float(std[at_index]) if is_wet else math.nan,
        focal_std=float(std[at_focal]) / focal,
        point_std_m=float(np.median(heights.of_point)) * MATCH_STD_PX / TIE_STD_PX,
        common_std_m=float(np.median(heights.common)),
    )


def rows_of(found: Foreseen, *, depth_m: float = DEPTH_M) -> tuple[tuple[str, str], ...]:
    """What is foreseen, as labelled sentences."""
    low, median = found.views_of_place
    place = f"a rough bed {depth_m:g} m under the water" if math.isfinite(found.level_std_m) else "rough ground"
    rows = [
        ("overlap", f"a place is in {median:.0f} photographs (median), the worst tenth in {low:.0f} or fewer"),
        ("angles", f"rays to a place differ by up to {found.angle_deg:.0f} degrees (median)"),
    ]
    if math.isfinite(found.level_std_m):
        rows += [
            ("level", _use(f"to {100.0 * found.level_std_m:.1f} cm", found.level_std_m, MOST_STD_LEVEL_M)),
            ("index", _use(f"to {found.index_std:.4f}", found.index_std, MOST_STD_INDEX)),
        ]
    rows += [
        ("focal length", _use(f"to {100.0 * found.focal_std:.2f} %", found.focal_std, MOST_STD_FOCAL)),
        ("heights", f"of points {1000.0 * found.point_std_m:.0f} mm by matching, of all together "
                    f"{1000.0 * found.common_std_m:.0f} mm by water, lens and poses (one sigma, medians)"),
        ("assumed", f"{place}, tie points good to {TIE_STD_PX:g} px, matches to "
                    f"{MATCH_STD_PX:g} px"),
    ]  # fmt: skip
    return tuple(rows)


def _use(words: str, std: float, limit: float) -> str:
    if std <= limit:
        return f"the photographs can tell it {words}"
    return f"not observable by this flight: {words}; it has to be given"


def _in_the_middle(survey: Survey) -> Survey:
    """The survey with its innermost views alone, where it has many: far ones add nothing there."""
    centres = np.array([view.camera.centre[:2] for view in survey.views])
    away = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    nearest = np.sort(np.argsort(away, kind="stable")[:_MOST_IN_BLOCK])
    return replace(survey, views=tuple(survey.views[number] for number in nearest))


def _places(survey: Survey, depth_m: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Which views have places of the bed in their frame (V, M), and the places (M, 3) [m], local."""
    cameras = [view.camera for view in survey.views]
    if survey.water is None:
        height = ground_height(cameras)
    else:
        x, y = np.mean([camera.centre for camera in cameras], axis=0)[:2]
        height = float(survey.water.height(x, y)) - depth_m
    try:
        seen, cells = coverage(cameras, survey.water, height)
    except ValueError:
        return None
    use = seen.sum(axis=0) >= MIN_TRACK
    area = local_area(survey)
    if area is not None:
        use &= within(cells, area)
    if not use.any():
        return None
    # As many observations in a photograph as the thinning of an adjustment leaves.
    seen, cells = seen[:, use], cells[use]
    wanted = CELLS**2 * PER_CELL * len(cameras) / seen.sum(axis=0).mean()
    some = np.unique(np.linspace(0, len(cells) - 1, min(round(wanted), len(cells))).round().astype(np.int64))
    seen, cells = seen[:, some], cells[some].copy()
    # On one level, level and index could not be told apart at all.
    cells[:, 2] += RELIEF_SHARE * depth_m * np.random.default_rng(_SEED).uniform(-1.0, 1.0, len(cells))
    return seen, cells


@dataclass(frozen=True)
class _Adjusted:
    covariance: np.ndarray
    problem: Problem
    by_point: np.ndarray
    by_parameters: csr_array


def _covariance(survey: Survey, gsd: float, ties: TiePoints, *, free: bool) -> _Adjusted:
    """Of the parameters, if every place were measured in every view that has it in its frame."""
    # Poses of which nothing is stated count as those of an adjusted block.
    known = known_of(survey, gsd, free_water=survey.water is not None)
    if not free:
        std = known.std.copy()
        std[:WATER] = known_of(survey, gsd).std[:WATER]
        known = replace(known, std=std)
    state = replace(known.mean, points=ties.start)
    sides = relief_sides(state, ties)
    # Pixels of cameras that stand still tell the rows at which those that fly on take them.
    ties = replace(ties, pixel=predict(replace(known.layout, flow=None), state, ties, sides))
    ties = replace(ties, pixel=predict(known.layout, state, ties, sides))
    std_px = np.full(len(KINDS), TIE_STD_PX)
    kind = np.full(len(ties.view), WINDOW)
    problem = Problem(known.layout, ties, kind, priors_for(known, ties), std_px, sides)
    linear = linearise(known.layout, state, ties, sides)
    return _Adjusted(covariance_at(problem, state, std_px), problem, linear.by_point, linear.by_parameters)


@dataclass(frozen=True)
class _Heights:
    of_point: np.ndarray
    common: np.ndarray


def _heights(found: _Adjusted) -> _Heights:
    """Standard deviations (M,) [m] of the heights of the places: by their own pixels, and by the parameters."""
    ties, num_places = found.problem.ties, len(found.problem.ties)
    first = np.searchsorted(ties.point, np.arange(num_places + 1))
    of_point, common = np.empty(num_places), np.empty(num_places)
    for number in range(num_places):
        mine = np.arange(first[number], first[number + 1])
        mine = mine[np.linspace(0, len(mine) - 1, min(len(mine), _MOST_VIEWS)).round().astype(np.int64)]
        design = found.by_point[mine].reshape(-1, 3)
        inverse = np.linalg.pinv(design)
        of_point[number] = TIE_STD_PX * math.sqrt(float(np.sum(inverse[2] ** 2)))
        move = -inverse[2] @ found.by_parameters[np.column_stack([2 * mine, 2 * mine + 1]).ravel()].toarray()
        common[number] = math.sqrt(max(float(move @ found.covariance @ move), 0.0))
    return _Heights(of_point, common)


def _angles(survey: Survey, seen: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The widest angle (M,) [deg] between two rays from each place, as if there were no water."""
    centres = np.array([view.camera.centre for view in survey.views])
    found = np.empty(len(cells))
    for number, (cell, mine) in enumerate(zip(cells, seen.T, strict=True)):
        rays = centres[mine] - cell
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        found[number] = math.degrees(math.acos(float(np.clip((rays @ rays.T).min(), -1.0, 1.0))))
    return found
