"""Other starts of an adjustment: a second solution of two photographs, and poses that are too inaccurate for windows.

Two photographs of ground that is nearly plane have two relative orientations (H. C. Longuet-Higgins, The reconstruction
of a plane surface from two perspective projections, Proc. R. Soc. B 227, 1986), and control on a small part of it does
not decide between them. Photographs of an aircraft look about straight down; where the first start is tilted, the block
is adjusted from a level one, too, and that which fits better is used.

Windows are matched within a few pixels of where the poses expect them. Poses that are off by more leave most
photographs without any. Features are matched wherever they lie; the block that they make is turned, scaled and shifted
to where the poses say that it is, and the adjustment starts from there. What is known of the poses stays what the file
and survey.toml say.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geo.frames import Similarity
from survey.adjust.assembling import FEW_MATCHES
from survey.adjust.block.observed import KINDS, MARK
from survey.adjust.block.priors import PriorKnowledge
from survey.adjust.result.adjustment import Adjustment
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints

# A start tilted by less than this counts as level itself.
_TILTED_DEG = 5.0
# Solutions whose photographs are turned by less than so many standard deviations are one.
_APART = 3.0
# -2 ln of the likelihood of one is lower by so much: very strong evidence (Kass and Raftery, JASA 90, 1995).
_SURE = 10.0
# Residual, in standard deviations, at which an observation is rejected.
_REJECTED = 3.0


def better_of_two_starts(
    survey: Survey, prior: PriorKnowledge, first: Adjustment, adjusted: Callable[[Survey, PriorKnowledge], Adjustment]
) -> Adjustment:
    """The adjustment as it is; of two photographs placed by control, the better of that and one from a level start."""
    turn = _turn_to_level(prior) if _needs_second_start(survey) else None
    ties = survey.observations.ties
    if turn is None or ties is None:
        return first
    middle = np.median(ties.start, axis=0)
    centres = middle + (prior.state.centres - middle) @ turn.T
    rotations = prior.state.rotations @ turn.T
    views = tuple(
        replace(view, camera=view.lens.camera(*pose))
        for view, *pose in zip(survey.views, centres, rotations, strict=True)
    )
    ties = replace(ties, start=middle + (ties.start - middle) @ turn.T)
    level = replace(survey, views=views, observations=replace(survey.observations, ties=ties))
    state = replace(prior.state, centres=centres, rotations=rotations)
    mean = replace(prior.mean, rotations=prior.mean.rotations @ turn.T)
    try:
        second = adjusted(level, replace(prior, state=state, mean=mean))
    except SurveyError:
        # What contradicts the level start is not an error of the block.
        return first
    turns = first.poses.rotations @ second.poses.rotations.transpose(0, 2, 1)
    apart = np.abs(Rotation.from_matrix(turns).as_rotvec(degrees=True))
    if not (apart > _APART * np.hypot(first.poses.rotation_std_deg, second.poses.rotation_std_deg)).any():
        return first
    gain = _misfit(survey, first, second) - _misfit(survey, second, first)
    best, other = (second, first) if gain > 0.0 else (first, second)
    if abs(gain) > _SURE:
        return best
    difference = float(np.abs(np.median(first.points[:, 2]) - np.median(second.points[:, 2])))
    warning = (
        f"two photographs are fitted about as well by another solution, whose cameras lie "
        f"{np.linalg.norm(best.poses.centres - other.poses.centres, axis=1).max():.2f} m and whose heights "
        f"{difference:.2f} m (median) off; give control farther apart, [cameras] position_std_m, or attitudes"
    )
    return replace(best, warnings=(*best.warnings, warning))


def _needs_second_start(survey: Survey) -> bool:
    """Whether control alone decides: known attitudes would, and the start has them."""
    seen = survey.observations
    if len(survey.views) != 2 or seen.ties is None or seen.control is None:
        return False
    has_attitudes = any(each.rotation_std_deg is not None or each.attitude is not None for each in seen.priors.values())
    return not has_attitudes and any(not point.is_check for point in seen.control.points)


def _turn_to_level(prior: PriorKnowledge) -> np.ndarray | None:
    """The turn (3, 3) of local after which the photographs look straight down in the mean; None where they do."""
    axis = prior.state.rotations[:, 2].mean(axis=0)
    axis /= np.linalg.norm(axis)
    across = np.cross(axis, (0.0, 0.0, -1.0))
    angle = math.atan2(float(np.linalg.norm(across)), -float(axis[2]))
    if angle < math.radians(_TILTED_DEG):
        return None
    return Rotation.from_rotvec(angle * across / np.linalg.norm(across)).as_matrix()


def _misfit(survey: Survey, found: Adjustment, other: Adjustment) -> float:
    """-2 ln of the likelihood, up to a common constant; a point of two photographs has one residual.

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


# With more than this share of the photographs without windows, poses are taken to be out of their reach: of drawn
# surveys whose poses are within it, hardly one has any (docs/adjustment.md).
_MOST_LOST = 0.1


@dataclass(frozen=True)
class RecoveredPoses:
    """A block by structure from motion, aligned with the given poses of its views."""

    ties: TiePoints
    # centres, rotations (V, 3) [m], local; (V, 3, 3) cam from local: of views that it does not have, as they came
    centres: np.ndarray
    rotations: np.ndarray
    warning: str = ""  # Why the poses were estimated again

    def start(self, prior: PriorKnowledge) -> PriorKnowledge:
        """The priors with these poses as initial values."""
        return replace(prior, state=replace(prior.state, centres=self.centres, rotations=self.rotations))


# Estimates the poses of a survey again.
PoseRecovery = Callable[[Survey], RecoveredPoses]


def windows_or_recovered_poses(
    survey: Survey, measure: Callable[[], TiePoints], search: PoseRecovery | None
) -> TiePoints | RecoveredPoses:
    """Windows of a survey with poses of a file, or its block by structure from motion where too few match.

    Without a search the windows are returned as they are.
    """
    if search is None:
        return measure()
    number, windows = len(survey.views), None
    try:
        windows = measure()
        lost = int((np.bincount(windows.view, minlength=number) < FEW_MATCHES).sum())
        message = f"with the given poses, windows match in {number - lost} of {number} photographs only"
    except SurveyError as error:
        lost, message = number, f"with the given poses, {error}"
    if windows is not None and lost <= _MOST_LOST * number:
        return windows
    try:
        found = search(survey)
    except SurveyError as error:
        if windows is not None and 2 * lost < number:
            return windows
        raise SurveyError(
            f"{message}, and structure from motion finds no better ones: {error}; correct the poses, or keep them as "
            "they are with --poses fixed"
        ) from error
    warning = (
        f"{message}: they are off by more than a few pixels. Structure from motion has estimated them again, and the "
        "given ones place the block"
    )
    return replace(found, warning=warning)


def recover_poses(survey: Survey, workspace: Path, report: Callable[[str], None]) -> RecoveredPoses:
    """Block of a survey by structure from motion, aligned with its given poses."""
    # Slow to import, and rarely needed.
    from survey.sfm.poses import blocks_of

    views = survey.views
    focals = {view.lens.focal[0] for view in views}
    images = {view.name: view.path for view in views}
    given = np.array([view.camera.centre for view in views])
    focal = focals.pop() if len(focals) == 1 else None
    positions = dict(zip(images, given, strict=True))
    blocks = blocks_of(images, positions, focal, workspace, report)
    num = sum(len(found.poses) for found in blocks)
    if 2 * num < len(views):
        raise SurveyError(f"structure from motion placed {num} of {len(views)} photographs")
    all_centres, all_rotations = given.copy(), np.array([view.camera.cam_from_local for view in views])
    parts = []
    for found in blocks:
        numbers = np.array([number for number, view in enumerate(views) if view.name in found.poses])
        centres, rotations = (np.array([found.poses[views[k].name][part] for k in numbers]) for part in range(2))
        onto = _align(centres, rotations, given[numbers], all_rotations[numbers])
        all_centres[numbers], all_rotations[numbers] = onto(centres), rotations @ onto.rotation.T
        parts.append(replace(found.ties, view=numbers[found.ties.view], start=onto(found.ties.start)))
    return RecoveredPoses(TiePoints.together(parts), all_centres, all_rotations)


def _align(centres: np.ndarray, rotations: np.ndarray, given: np.ndarray, turned: np.ndarray) -> Similarity:
    """Similarity transformation from poses (V, 3), (V, 3, 3) to given ones.

    Its rotation is the mean over the views, which a single strip determines too. Scale and shift are medians, robust
    against single wrong positions.
    """
    turn = Rotation.from_matrix(turned.transpose(0, 2, 1) @ rotations).mean().as_matrix()
    first, second = np.triu_indices(len(centres), 1)
    adjusted_m, given_m = (np.linalg.norm(places[first] - places[second], axis=1) for places in (centres, given))
    scale = float(np.sum(given_m) / np.sum(adjusted_m))
    shift = np.median(given - scale * centres @ turn.T, axis=0)
    return Similarity(scale, turn, shift)
