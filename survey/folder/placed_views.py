"""The views of a survey in its local frame with all that is known of their places, whatever placed them.

A block whose positions lie below its water, as by a barometer, gets initial heights over it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geo.frames import LocalFrame
from refract import FlatWater
from survey.control.points import Checkpoint, Control
from survey.findings import Findings
from survey.folder.checked_control import checked_parts
from survey.folder.control import place_control
from survey.folder.file_poses import read_file_poses
from survey.folder.found import Found
from survey.folder.masks import with_masks
from survey.folder.pairing import require_image
from survey.folder.place import over_points
from survey.folder.plausible import most_over_water
from survey.folder.pose_priors import PosePrior, common_up_std, priors_of_gps
from survey.folder.reprojection import Reprojection
from survey.folder.unposed import solve_views
from survey.photos.cameras import View
from survey.photos.images import require_all_complete
from survey.photos.tie_points import TiePoints


@dataclass(frozen=True)
class PlacedViews:
    """Views that a poses file or structure from motion placed."""

    found: Found  # The contents of the survey folder, with the level that clicks give where a poses file places these
    frame: LocalFrame
    views: list[View]  # Sorted by name, with their masks
    # points, ties, tool, reprojection, priors, control, checkpoints: See `survey.folder.survey.Survey`
    points: np.ndarray | None
    ties: TiePoints | None
    tool: str | None
    reprojection: Reprojection | None
    priors: Mapping[str, PosePrior]
    control: Control | None
    checkpoints: tuple[Checkpoint, ...]


def views_of_file(found: Found, path: Path) -> tuple[PlacedViews, Findings]:
    """The views that a poses file places.

    Raises
    ------
    SurveyError, GeoError
        Where something is missing, damaged or contradictory.
    """
    file, said = read_file_poses(found, path)
    found, frame = file.found, file.frame
    views, of_images = _with_images(found, file.views, file.masks)
    control, checkpoints, of_control = place_control(found.control, frame, [view.name for view in views])
    priors = file.priors if control is None else _held_by_control(file.priors)
    placed = PlacedViews(
        found, frame, views, file.points, None, file.tool, file.reprojection, priors, control, checkpoints
    )
    return placed, said + of_images + of_control


def views_of_photographs(
    found: Found, workspace: Path | None, report: Callable[[str], None] | None
) -> tuple[PlacedViews, Findings]:
    """The views that structure from motion places.

    Raises
    ------
    SurveyError, GeoError
        Where something is missing, damaged or contradictory, or the photographs do not make a block.
    """
    solved = solve_views(found, workspace, report)
    frame, points = solved.frame, solved.ties.start
    views = sorted(solved.views, key=lambda view: view.name)
    ties = solved.ties.renumbered(np.array([views.index(view) for view in solved.views]))
    views, of_images = _with_images(found, views, None)
    priors: Mapping[str, PosePrior] = priors_of_gps(found, frame, views, solved.rejected)
    control, checkpoints, of_control = place_control(found.control, frame, [view.name for view in views])
    said = Findings(tuple(solved.assumptions), tuple(solved.warnings)) + of_images + of_control
    placed = PlacedViews(found, frame, views, points, ties, None, None, priors, control, checkpoints)
    if control is None:
        return placed, said
    priors = _held_by_control(priors)
    views, ties, control, priors, of_parts = checked_parts(found, frame, views, ties, control, priors)
    placed = replace(placed, views=views, points=ties.start, ties=ties, control=control, priors=priors)
    return placed, said + of_parts


def _held_by_control(priors: Mapping[str, PosePrior]) -> dict[str, PosePrior]:
    return {name: prior.held_by_control() for name, prior in priors.items()}


def _with_images(found: Found, views: list[View], masks: Path | None) -> tuple[list[View], Findings]:
    """Views by name with their masks; images must have the size of their lens."""
    views, said = with_masks(found, sorted(views, key=lambda view: view.name), masks)
    for view in views:
        require_image(view, found.heads[view.name])
    require_all_complete([path for view in views for path in (view.path, view.mask_path) if path is not None])
    return views, said


def lifted_over_water(
    placed: PlacedViews, views: list[View], water: FlatWater | None
) -> tuple[PlacedViews, list[View], Findings]:
    """Views shifted in height where all cameras lie under the water or far above it.

    Only of positions whose heights have an error in common that the adjustment finds from the water; a warning says by
    how much.

    Parameters
    ----------
    placed : PlacedViews
    views : list of View
        Those of `placed`, with all else that is known of them.
    water : FlatWater or None
        Whose level is known.
    """
    if water is None or placed.ties is None or placed.control is not None or common_up_std(placed.priors) == 0.0:
        return placed, views, Findings()
    centres = np.array([view.camera.centre for view in views])
    over = -water.depth(centres)
    most_m = most_over_water([view.camera for view in views])
    if over.min() > 0.0 and over.max() < most_m:
        return placed, views, Findings()
    x, y, _ = np.median(centres, axis=0).tolist()
    up = float(water.height(x, y)) - over_points(placed.ties.start, centres)
    said = "under the water" if over.min() <= 0.0 else f"more than {most_m:.0f} m over the water"
    warning = (
        f"the heights of their positions put the cameras {said} ({over.min():.1f} to {over.max():.1f} m over it): the "
        "height of the block is taken from the water level; check level_m and its vertical datum"
    )
    shift = np.array([0.0, 0.0, up])
    ties = replace(placed.ties, start=placed.ties.start + shift)
    views = [replace(view, camera=replace(view.camera, centre=view.camera.centre + shift)) for view in views]
    return replace(placed, ties=ties, points=ties.start), views, Findings(warnings=(warning,))
