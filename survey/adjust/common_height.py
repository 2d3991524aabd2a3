"""Common height offset of positions, observable only through the water level, as of barometric heights.

A block is adjusted where its positions put it, and its photographs determine the height L of the water: by the
refraction of rays, and by the waterline. The level that is known, of standard deviation s, determines the error b that
heights share, of standard deviation p, ``b = k (L - level)`` with ``k = p^2 / (p^2 + s^2)``, to a variance of ``k s^2``
beside that of L; and the block is lowered by it. Water and cameras of the block have the covariance C before, and
``T C T' + k s^2 u u'`` after, with ``T = 1 - k u l'``: u has ones at heights, l one at that of the water.
"""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from refract import FlatWater
from survey.adjust.block.bundle import NotConvergedError, Solution, cost, solve
from survey.adjust.block.observed import Observed
from survey.adjust.block.priors import PriorKnowledge, shared_height_std
from survey.adjust.block.problem import Problem
from survey.adjust.block.state import NUM_POSE
from survey.adjust.result.adjustment import MOST_SIGMAS, MOST_STD_LEVEL_M, Adjustment
from survey.adjust.result.parts import common_error
from survey.adjust.rounds import RobustSolution
from survey.folder.local_frame import over_points
from survey.folder.survey import Survey
from survey.sfm.gps import WELL_KNOWN_M

# A position by GPS without corrections is off by less.
_GPS_WITHIN_M = 10.0


@dataclass(frozen=True)
class CommonHeight:
    """Common error of the heights of all positions, estimated from the level of the water."""

    # error, std [m]: by how much they are too high
    error: float
    std: float
    level_std: float  # [m]: of the height of the water over the block, by photographs


def water_start(prior: PriorKnowledge, seen: Observed) -> tuple[PriorKnowledge, np.ndarray]:
    """Initial state of a block whose positions do not determine its height over the water, and its points (M, 3) [m].

    The cost may have one minimum with all points under water and another with some of them: the adjustment is started
    from several levels, and the best is taken. Where none converges, both are returned as they are.
    """
    found: list[tuple[Problem, Solution]] = []
    points = seen.ties.start
    given, over = float(prior.state.water_parameters()[0]), over_points(points, prior.state.centres)
    # As positions have it; with most points under water; with half of them.
    for level in (given, over, float(np.median(points[:, 2]))):
        state = replace(prior.state, points=points).with_level(level)
        with suppress(NotConvergedError):
            problem = seen.problem(prior, state)
            found.append((problem, solve(problem, state)))
    if not found:
        return prior, points
    std_px = found[0][1].std_px
    least = min((solution for _, solution in found), key=lambda each: cost(found[0][0], each.state, std_px))
    return replace(prior, state=least.state.without_points()), least.state.points


def height_warnings(survey: Survey, done: RobustSolution) -> list[str]:
    """Warning where positions alone determine the heights, and may share an error."""
    std = shared_height_std(survey)
    if std == 0.0 or done.prior.common_up_std > 0.0 or _is_corrected(done):
        return []
    level, measured = (
        ("", "") if survey.water is None else (" and the level of the water", "a level that was measured, ")
    )
    return [
        f"all heights{level} depend on the heights of the camera positions, which may have a common error of {std:g} "
        f"m; give {measured}control points, or [cameras] position_std_m where positions have corrections"
    ]


def _is_corrected(done: RobustSolution) -> bool:
    """Whether positions of unknown accuracy scatter in plan as little as those of a receiver with corrections."""
    std = done.prior.pose_std[:, :2]
    # Photographs without a position, and positions that are blunders, tell nothing of the others.
    scatter = std[done.prior.unknown_positions & np.isfinite(std).all(axis=1)]
    return len(scatter) > 0 and bool(np.median(scatter) <= WELL_KNOWN_M)


def drop_common_height(prior: PriorKnowledge, done: RobustSolution) -> PriorKnowledge | None:
    """Priors without a common height error, where the positions prove to be those of a receiver with corrections.

    None where they do not: single positions, in plan, show its accuracy, and the level of the water agrees with them.
    """
    placed, common = apply_level_datum(done)
    if common is None or not _is_corrected(done) or abs(common.error) > MOST_SIGMAS * common.std:
        return None
    state = done.solution.state.without_points()
    std = prior.std.copy()
    std[0] = placed.prior.std[0]
    return replace(prior, state=state, std=std, common_up_std=0.0)


def apply_level_datum(done: RobustSolution) -> tuple[RobustSolution, CommonHeight | None]:
    """The block shifted in height to the level of its water, where its positions share an error."""
    prior, covariance = done.prior, done.solution.covariance
    if prior.common_up_std == 0.0:
        return done, None
    of_level = prior.std[0] ** 2 - prior.common_up_std**2
    share = prior.common_up_std**2 / prior.std[0] ** 2
    too_high = share * float(done.solution.state.water_parameters()[0] - prior.mean.water_parameters()[0])
    heights = np.zeros(len(prior.layout))
    heights[0], heights[prior.layout.first_pose + 2 :: NUM_POSE] = 1.0, 1.0
    follow = covariance - share * np.outer(heights, covariance[0])
    follow = follow - share * np.outer(follow[:, 0], heights)
    follow = follow + share * of_level * np.outer(heights, heights)
    before, down = done.solution.state, np.array([0.0, 0.0, too_high])
    level = before.require_water().point[2] - too_high
    state = replace(before, centres=before.centres - down, points=before.points - down).with_level(level)
    std = prior.std.copy()
    std[0] = np.sqrt(of_level)
    mean = replace(prior.mean, centres=prior.mean.centres - (0.0, 0.0, too_high))
    level_std = float(np.sqrt(covariance[0, 0]))
    common = CommonHeight(too_high, float(np.sqrt(share * of_level + (share * level_std) ** 2)), level_std)
    solution = replace(done.solution, state=state, covariance=follow)
    return replace(done, prior=replace(prior, std=std, mean=mean, common_up_std=0.0), solution=solution), common


def with_common(found: Adjustment, common: CommonHeight, water: FlatWater | None) -> Adjustment:
    """The result with a note on the common height error under local water, and warnings where it is more than that."""
    warnings: list[str] = []
    side = "low" if common.error < 0.0 else "high"
    message = (
        f"the level of the water places the block: heights of positions are {abs(common.error):.2f} m too {side} "
        f"(+- {common.std:.2g} m), the same for all of them"
    )
    if abs(common.error) > _GPS_WITHIN_M:
        warnings.append(
            f"{message}; a barometer may be off by so much, GPS is not: otherwise level_m or its vertical datum is "
            "wrong"
        )
    else:
        found = replace(found, notes=(*found.notes, message))
    found = replace(found, common_up_m=(common.error, common.std))
    heights = common_error(found, water)
    if heights is not None and heights.mean > MOST_STD_LEVEL_M:
        warnings.append(
            f"all heights together are known to {heights.mean:.2g} m only: positions may have any common error in "
            f"height, and the photographs determine the depth of the water to {common.level_std:.2g} m; give control "
            "points, oblique photographs or some of the bank, or [cameras] position_std_m where positions have "
            "corrections"
        )
    return replace(found, warnings=(*found.warnings, *warnings))
