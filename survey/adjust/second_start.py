"""A second start for two photographs, which may fit their matches by two solutions.

Two photographs of ground that is nearly plane have two relative orientations (H. C. Longuet-Higgins, The reconstruction
of a plane surface from two perspective projections, Proc. R. Soc. B 227, 1986), and control on a small part of it does
not decide between them. Photographs of an aircraft look about straight down; where the first start is tilted, the block
is adjusted from a level one, too, and that which fits better is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from survey.adjust.block.observed import KINDS, MARK
from survey.adjust.block.priors import PriorKnowledge
from survey.adjust.result.adjustment import Adjustment
from survey.errors import SurveyError
from survey.folder.survey import Survey

# A start tilted by less than this counts as level itself.
_TILTED_DEG = 5.0
# Solutions whose photographs are turned by less than so many standard deviations are one.
_APART = 3.0
# -2 ln of the likelihood of one is lower by so much: very strong evidence (Kass and Raftery, JASA 90, 1995).
_SURE = 10.0
# Residual, in standard deviations, at which an observation is rejected.
_REJECTED = 3.0


def of_two_starts(
    survey: Survey, known: PriorKnowledge, first: Adjustment, adjusted: Callable[[Survey, PriorKnowledge], Adjustment]
) -> Adjustment:
    """The adjustment as it is; of two photographs placed by control, the better of that and one from a level start.

    Parameters
    ----------
    first : Adjustment
        From the start as it is.
    adjusted : callable
        Adjusts a survey from what is known.
    """
    turn = None if not _is_asked(survey) else _to_level(known)
    if turn is None:
        return first
    ties = survey.observations.ties
    assert ties is not None
    middle = np.median(ties.start, axis=0)
    centres = middle + (known.state.centres - middle) @ turn.T
    rotations = known.state.rotations @ turn.T
    lenses = [view.lens for view in survey.views]
    cameras = [lens.camera(*pose) for lens, *pose in zip(lenses, centres, rotations, strict=True)]
    level = replace(
        survey,
        views=tuple(replace(view, camera=camera) for view, camera in zip(survey.views, cameras, strict=True)),
        observations=replace(survey.observations, ties=replace(ties, start=middle + (ties.start - middle) @ turn.T)),
    )
    start = replace(known, state=replace(known.state, centres=centres, rotations=rotations))
    mean = replace(known.mean, rotations=known.mean.rotations @ turn.T)
    try:
        second = adjusted(level, replace(start, mean=mean))
    except SurveyError:
        # What contradicts the level start is no error of the block.
        return first
    if not _are_apart(first, second):
        return first
    gain = _misfit(survey, first, second) - _misfit(survey, second, first)
    best, other = (second, first) if gain > 0.0 else (first, second)
    if abs(gain) > _SURE:
        return best
    apart = float(np.abs(np.median(first.points[:, 2]) - np.median(second.points[:, 2])))
    return replace(
        best,
        warnings=(
            *best.warnings,
            f"two photographs are fitted about as well by another solution, whose cameras lie "
            f"{np.linalg.norm(best.poses.centres - other.poses.centres, axis=1).max():.2f} m and whose heights "
            f"{apart:.2f} m (median) off; give control farther apart, [cameras] position_std_m, or attitudes",
        ),
    )


def _is_asked(survey: Survey) -> bool:
    """Whether control alone decides: known attitudes would, and the start has them."""
    seen = survey.observations
    if len(survey.views) != 2 or seen.ties is None or seen.control is None:
        return False
    has_attitudes = any(each.rotation_std_deg is not None or each.attitude is not None for each in seen.priors.values())
    return not has_attitudes and any(not point.is_check for point in seen.control.points)


def _to_level(known: PriorKnowledge) -> np.ndarray | None:
    """The turn (3, 3) of local after which the photographs look straight down in the mean; None where they do."""
    axis = known.state.rotations[:, 2].mean(axis=0)
    axis /= np.linalg.norm(axis)
    across = np.cross(axis, (0.0, 0.0, -1.0))
    angle = math.atan2(float(np.linalg.norm(across)), -float(axis[2]))
    if angle < math.radians(_TILTED_DEG):
        return None
    return Rotation.from_rotvec(angle * across / np.linalg.norm(across)).as_matrix()


def _are_apart(one: Adjustment, other: Adjustment) -> bool:
    turns = Rotation.from_matrix(one.poses.rotations @ other.poses.rotations.transpose(0, 2, 1)).as_rotvec(degrees=True)
    std = np.hypot(one.poses.rotation_std_deg, other.poses.rotation_std_deg)
    return bool((np.abs(turns) > _APART * std).any())


def _misfit(survey: Survey, found: Adjustment, other: Adjustment) -> float:
    """-2 ln of the likelihood up to what both share: a point of two photographs has one residual.

    Observations that only the other solution has count as rejected.
    """
    control = survey.observations.control
    assert control is not None
    value = 0.0
    for kind, std in found.statistics.std_px.items():
        if kind != KINDS[MARK]:
            own, others = (each.statistics.num_observations.get(kind, 0) for each in (found, other))
            value += 0.5 * (own + others) * math.log(std) + 0.5 * _REJECTED**2 * max(others - own, 0)
    for view, centre in zip(survey.views, found.poses.centres, strict=True):
        prior = survey.observations.priors.get(view.name)
        if prior is not None and prior.position is not None and prior.position_std is not None:
            value += float(np.sum(((centre - prior.position) / prior.position_std) ** 2))
    std_of = {point.name: np.asarray(point.std) for point in control.points}
    for row in found.control:
        value += 2.0 * row.num_marks * (row.rms_px / control.marks_std_px) ** 2
        if not row.is_check:
            value += float(np.sum(np.square(np.asarray(row.residual_m) / std_of[row.name])))
    return value
