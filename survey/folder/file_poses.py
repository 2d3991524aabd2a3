"""The poses file of a survey: frame, views, and other contents."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geo.frames import LocalFrame
from survey.control.placing import require_near
from survey.findings import Findings
from survey.folder import place
from survey.folder.camera_faults import angle_doubts
from survey.folder.found import Found
from survey.folder.pairing import pair, with_lenses
from survey.folder.pose_priors import PosePrior, priors_of_poses
from survey.folder.posed import given_in_local, points_in_local, way_into_crs
from survey.folder.reprojection import Reprojection, reprojection
from survey.photos.cameras import View
from survey.photos.names import ImageNames
from survey.photos.poses import Pose, PoseFile, SecondPose
from survey.photos.tie_points import least_track
from survey.pose_files import read_poses, read_ties
from survey.settings.std import per_axis
from survey.sfm.datum import EXACT, DatumStd, plan_std, require_as_good
from survey.water.level import with_level_of_clicks


@dataclass(frozen=True)
class FilePoses:
    """Contents of the poses file of a survey, in its local frame."""

    found: Found  # The contents of the survey folder, with the level that clicks in the photographs give
    frame: LocalFrame
    views: list[View]
    # (N, 3) float64 [m], local, or None: tie points that three photographs see; None where none came
    points: np.ndarray | None
    # tool, masks: See `PoseFile`
    tool: str | None
    masks: Path | None
    reprojection: Reprojection | None  # None where the file does not say where the photographs show its points
    priors: dict[str, PosePrior]  # dict of name to PosePrior


def read_file_poses(found: Found, path: Path) -> tuple[FilePoses, Findings]:
    """Read the poses file of a survey.

    Raises
    ------
    SurveyError, GeoError
        Where the file, or its fit to the survey, is wrong.
    """
    try:
        file = read_poses(path)
    except SecondPose as error:
        # Two photographs of this name are the reason that a user can mend.
        ImageNames(found.images).find(error.called, str(path))
        raise
    paired, of_pairs = pair(found, file.poses)
    poses, of_lenses = with_lenses(found, list(paired.values()))
    said = Findings(tuple(file.notes), tuple(file.warnings)) + of_pairs + of_lenses
    datum, of_datum = _datum(found, file)
    found, of_clicks = _with_clicks(found, file, poses)
    said += Findings(warnings=tuple(angle_doubts(poses, file.frame))) + of_datum + of_clicks
    warnings = []
    frame, views = place.views_in_local(found, file, poses)
    if file.tool is not None and found.config.water is not None:
        warnings.append(
            f"{file.tool} ignores refraction: tie points under water have biased its poses; the plan says whether they "
            "are refined, and with [cameras] position_std_m they are in any case"
        )
    if found.control is not None:
        centres = np.array([view.camera.centre for view in views])
        warnings += require_near(found.control.points, frame.crs_from_local(centres), frame.crs)
    by_name = {view.name: view for view in views}
    points, misses = _ties(found, path, file, frame, {called: by_name[pose.name] for called, pose in paired.items()})
    priors = priors_of_poses(found.config.cameras, views, _given(found, file, poses, frame), datum)
    of_file = FilePoses(found, frame, views, points, file.tool, file.masks, misses, priors)
    return of_file, said + Findings(warnings=tuple(warnings))


def _datum(found: Found, file: PoseFile) -> tuple[DatumStd, Findings]:
    """Std that the transformation of the poses into crs adds, with a warning where it does.

    Raises
    ------
    MissingGrid
        If a grid would make it as good as the poses, and nothing else places the block.
    """
    way = way_into_crs(file, found.crs)
    if way is None:
        return EXACT, Findings()
    std = found.config.cameras.position_std_m
    stated = 0.0 if std is None else max(per_axis(std)[:2])
    require_as_good(way, stated, "the poses", 0 if found.control is None else found.control.num_given)
    doubt = way.doubt("the poses")
    return DatumStd(plan_std(way)), Findings(warnings=() if doubt is None else (doubt,))


def _with_clicks(found: Found, file: PoseFile, poses: list[Pose]) -> tuple[Found, Findings]:
    """The contents with the level that clicks in the photographs give, where [water] names them.

    The local frame of a survey lies at its level, which is not known before the poses are: another frame serves here.
    """
    water = found.config.water
    if water is None or water.sources.clicks is None:
        return found, Findings()
    dry = replace(found, config=replace(found.config, water=None))
    frame, views = place.views_in_local(dry, file, poses)
    config, clicked, said = with_level_of_clicks(found.folder, found.config, views, frame)
    return replace(found, config=config, levels=found.levels + clicked), said


def _ties(
    found: Found, path: Path, file: PoseFile, frame: LocalFrame, views: Mapping[str, View]
) -> tuple[np.ndarray | None, Reprojection | None]:
    """Tie points in local that three photographs see, of two both, and how well all fall back on their places."""
    ties = read_ties(path)
    if ties is None:
        return None, None
    points = points_in_local(file, ties.points, frame, found.config.cameras.gps_height)
    good = np.isfinite(points).all(axis=1) & (ties.num_views >= least_track(len(views)))
    return points[good], reprojection(ties, points, views)


def _given(
    found: Found, file: PoseFile, poses: list[Pose], frame: LocalFrame
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Positions in local, and their standard deviations, that a file gives for before its adjustment."""
    known = [(pose.name, pose.given) for pose in poses if pose.given is not None]
    if not known:
        return {}
    places = np.array([given.place for _, given in known])
    local = given_in_local(file, places, frame, found.config.cameras.gps_height)
    return {
        name: (position, given.std)
        for (name, given), position in zip(known, local, strict=True)
        if np.isfinite(position).all()
    }
