"""Poses of a file that are too inaccurate for windows: tie points by feature matching instead.

Windows are matched within a few pixels of where the poses expect them. Poses that are off by more leave most
photographs without any. Features are matched wherever they lie; the block that they make is turned, scaled and shifted
to where the poses say that it is, and the adjustment starts from there. What is known of the poses stays what the file
and survey.toml say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geo.similarity import Similarity
from survey.adjust.assembling import FEW_MATCHES
from survey.adjust.block.priors import PriorKnowledge
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints

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
    warning: str = ""  # Why it was sought

    def start(self, known: PriorKnowledge) -> PriorKnowledge:
        """The priors with these poses as initial values."""
        return replace(known, state=replace(known.state, centres=self.centres, rotations=self.rotations))


# Finds the poses of a survey anew.
PoseRecovery = Callable[[Survey], RecoveredPoses]


def windows_or_search(
    survey: Survey, measure: Callable[[], TiePoints], search: PoseRecovery | None
) -> TiePoints | RecoveredPoses:
    """Windows of a survey with poses of a file, or its block by structure from motion where too few match.

    Without a search the windows are returned as they are.

    Raises
    ------
    SurveyError
        If photographs do not match, or half of them have no windows, and structure from motion finds no poses either.
    """
    if search is None:
        return measure()
    number, windows = len(survey.views), None
    try:
        windows = measure()
        lost = without_windows(windows, number)
        said = f"with the given poses, windows match in {number - lost} of {number} photographs only"
    except SurveyError as error:
        lost, said = number, f"with the given poses, {error}"
    if windows is not None and lost <= _MOST_LOST * number:
        return windows
    try:
        found = search(survey)
    except SurveyError as error:
        if windows is not None and 2 * lost < number:
            return windows
        raise SurveyError(
            f"{said}, and structure from motion finds no better ones: {error}; correct the poses, or keep them as "
            "they are with --poses fixed"
        ) from error
    warning = (
        f"{said}: they are off by more than a few pixels. Structure from motion has estimated them again, and the "
        "given ones place the block"
    )
    return replace(found, warning=warning)


def without_windows(windows: TiePoints, num_views: int) -> int:
    """Number of views with too few windows to determine their rotation."""
    return int((np.bincount(windows.view, minlength=num_views) < FEW_MATCHES).sum())


def find_anew(survey: Survey, workspace: Path, say: Callable[[str], None]) -> RecoveredPoses:
    """Block of a survey by structure from motion, aligned with its given poses.

    Raises
    ------
    SurveyError
        If it places fewer than half of the views: the poses of the others would remain unchecked.
    """
    # Slow to import, and rarely needed.
    from survey.sfm.poses import blocks_of

    views = survey.views
    focals = {view.lens.focal[0] for view in views}
    images = {view.name: view.path for view in views}
    given = np.array([view.camera.centre for view in views])
    focal = focals.pop() if len(focals) == 1 else None
    blocks = blocks_of(images, dict(zip(images, given, strict=True)), focal, workspace, say)
    num = sum(len(found.poses) for found in blocks)
    if 2 * num < len(views):
        raise SurveyError(f"structure from motion placed {num} of {len(views)} photographs")
    all_centres, all_rotations = given.copy(), np.array([view.camera.cam_from_local for view in views])
    parts = []
    for found in blocks:
        numbers = np.array([number for number, view in enumerate(views) if view.name in found.poses])
        centres, rotations = (np.array([found.poses[views[k].name][part] for k in numbers]) for part in range(2))
        onto = _onto(centres, rotations, given[numbers], all_rotations[numbers])
        all_centres[numbers], all_rotations[numbers] = onto(centres), rotations @ onto.rotation.T
        ties = found.ties.renumbered(numbers)
        parts.append(replace(ties, start=onto(ties.start)))
    return RecoveredPoses(TiePoints.together(parts), all_centres, all_rotations)


def _onto(centres: np.ndarray, rotations: np.ndarray, given: np.ndarray, turned: np.ndarray) -> Similarity:
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
