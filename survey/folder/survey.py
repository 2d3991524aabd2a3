"""A survey read from its folder into the local frame: cameras with their images, water, and the area of interest."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.transformation import lon_lat
from refract import FlatWater
from survey.errors import FILE_NAME, Findings, SurveyError
from survey.folder.checked_control import checked_parts
from survey.folder.control import checkpoint_findings, mark_warnings, place_control, read_ground
from survey.folder.found import Found, find_survey
from survey.folder.headers import far_from_others
from survey.folder.heights import exif_height_warnings, low_flight_warnings, place_of, start_height_warnings
from survey.folder.local_frame import over_points, water_in_local, with_level_of_points
from survey.folder.observations import (
    Observations,
    PlacedViews,
    Provenance,
    shutter_warnings,
    velocities_of,
    with_motion,
)
from survey.folder.pairing import read_file_poses, require_image, with_masks
from survey.folder.plausible import (
    most_of_cameras,
    place_warnings,
    require_apart,
    require_focal_lengths,
    require_plausible,
)
from survey.folder.pose_priors import common_plan_std, common_up_std, priors_of_gps
from survey.folder.sfm_views import solve_views
from survey.photos.cameras import View, metres_per_px
from survey.photos.images import require_all_complete
from survey.settings.config import SurveyConfig, WaterConfig
from survey.water.level import with_level_of_clicks, with_plane_of_surface
from survey.water.level_observation import LevelObservation, water_place_warnings
from survey.water.surface import Departure, height_above, still_water
from survey.water.tides import with_tides


@dataclass(frozen=True)
class Survey:
    """A survey in its local frame."""

    name: str
    folder: Path
    frame: LocalFrame  # Its crs is that of everything that leaves the program
    views: tuple[View, ...]  # At least two, sorted by name
    water: FlatWater | None  # Local; None for a dry survey
    config: SurveyConfig  # The settings that took effect, defaults filled in
    observations: Observations = field(default_factory=Observations, compare=False, repr=False)
    provenance: Provenance = field(default_factory=Provenance)
    findings: Findings = field(default_factory=Findings)  # Assumptions and warnings of all readers

    @property
    def bounds(self) -> tuple[float, float, float, float] | None:
        """(e0, n0, e1, n1) in crs where the bed is wanted; None for all that the photographs see."""
        return self.config.area.bounds

    @property
    def plan_std_m(self) -> float:
        """Standard deviation [m] that all places in plan have in common, by a transformation of datums."""
        found = self.observations.control
        control = () if found is None else tuple(point for point in found.points if not point.is_check)
        return min(point.common_plan_std for point in control) if control else common_plan_std(self.observations.priors)

    def require_water(self) -> tuple[FlatWater, WaterConfig]:
        """The water plane and its settings, with level, place and index."""
        if self.water is None or self.config.water is None:
            raise SurveyError(f"{self.name} is a dry survey, expected one with water; give [water] in {FILE_NAME}")
        return self.water, self.config.water


def load_survey(
    folder: str | Path,
    *,
    workspace: Path | None = None,
    report: Callable[[str], None] | None = None,
    found: Found | None = None,
) -> Survey:
    """Read a survey into its local frame and check its consistency.

    Raises SurveyError or GeoError where something is missing, damaged or contradictory.

    Parameters
    ----------
    folder : Path
    workspace : Path, optional
        Where structure from motion keeps its files, if it has to run; default ``folder/bathynerf/sfm``.
    report : callable, optional
        Called with messages on the progress of structure from motion.
    found : Found, optional
        What `find_survey` found in the folder, where it has looked already.
    """
    found = find_survey(Path(folder)) if found is None else found
    placed, added = _placed_views(found, workspace, report)
    findings = found.findings + added
    found, cameras = placed.found, placed.found.config.cameras
    places = {view.name: view.camera.centre for view in placed.views}
    velocities = velocities_of(places, found.headers, cameras.speed_m_s)
    views, added = with_motion(placed.views, velocities, cameras)
    placed, findings = replace(placed, views=views), findings + added
    water, added = _local_water(placed)
    findings += added
    if water.is_level_known:
        placed, added = shifted_above_water(placed, water.plane, water.departure)
        findings += added
    views, tide = with_tides(placed.views, found.tide, water.plane)
    placed = replace(placed, views=views)
    ground, added = read_ground(
        found.folder, water.config, placed.frame, _seen(placed), water.above, is_level_known=water.is_level_known
    )
    findings += added + _doubts(placed, water)
    config = water.config
    if found.poses_path is not None and found.poses_path.is_relative_to(found.folder):
        poses_name = found.poses_path.relative_to(found.folder).as_posix()
        config = replace(config, cameras=replace(config.cameras, poses=poses_name))
    is_index_known = found.config.water is None or found.config.water.states_index
    return Survey(
        name=found.name,
        folder=found.folder,
        frame=placed.frame,
        views=tuple(placed.views),
        water=water.plane,
        config=config,
        observations=replace(
            placed.observations,
            levels=water.levels,
            velocities=velocities,
            tide=tide,
            ground=ground,
            departure=water.departure,
        ),
        provenance=replace(placed.provenance, is_level_known=water.is_level_known, is_index_known=is_index_known),
        findings=findings,
    )


def _placed_views(
    found: Found, workspace: Path | None, report: Callable[[str], None] | None
) -> tuple[PlacedViews, Findings]:
    """Views by name with masks and control, by the poses file or structure from motion; images fit their lenses."""
    solved = None
    if found.poses_path is not None:
        placed, masks, findings = read_file_poses(found, found.poses_path)
    else:
        solved, rejected, findings = solve_views(found, workspace, report)
        placed, masks = PlacedViews(found, solved.frame, list(solved.views)), None
    views, added = with_masks(placed.found, sorted(placed.views, key=lambda view: view.name), masks)
    headers, seen = {view.name: found.headers[view.name] for view in views}, placed.observations
    for view in views:
        require_image(view, headers[view.name])
    require_all_complete([path for view in views for path in (view.path, view.mask_path) if path is not None])
    if solved is not None:
        priors = priors_of_gps(found, placed.frame, views, rejected)
        focals = {name: head.focal_px for name, head in headers.items() if head.focal_px and not head.focal_warning}
        seen = Observations(solved.ties.start, solved.ties, priors, focals)
    control, checkpoints, of_control = place_control(placed.found.control, placed.frame, list(headers))
    if control is not None:
        seen = replace(seen, priors={name: prior.held_by_control() for name, prior in seen.priors.items()})
    seen = replace(seen, control=control, checkpoints=checkpoints)
    placed, of_parts = checked_parts(replace(placed, views=views, observations=seen))
    return placed, findings + added + of_control + of_parts


@dataclass(frozen=True)
class _LocalWater:
    config: SurveyConfig  # The settings with its level, place and index filled in
    plane: FlatWater | None  # None for a dry survey
    departure: Departure | None  # From the plane; None where none is given
    levels: tuple[LevelObservation, ...]  # Measurements of its level
    is_level_known: bool  # Else the level is a guess by the points

    @property
    def above(self) -> Callable[[np.ndarray], np.ndarray] | None:
        """Heights (N,) [m] of places (N, 3) [m], local, above the water; None for a dry survey."""
        return None if self.plane is None else partial(height_above, self.plane, self.departure)


def _local_water(placed: PlacedViews) -> tuple[_LocalWater, Findings]:
    """The water, from settings, measurements, clicks or points."""
    found, frame, views = placed.found, placed.frame, placed.views
    config, is_level_known, levels, findings = found.config, True, found.levels, Findings()
    if found.poses_path is None:
        # A poses file has placed the clicks already.
        config, clicked, findings = with_level_of_clicks(found.folder, config, views, frame)
        levels += clicked
    else:
        # Held against the GPS positions already where structure from motion finds the poses.
        cameras = lon_lat(found.crs, frame.crs_from_local(_centres(views)))
        findings = Findings(warnings=tuple(water_place_warnings(found.crs, cameras, config.water, levels)))
    if config.water is not None and config.water.level_m is None:
        config, of_points = with_level_of_points(config, frame, views, placed.observations.points)
        is_level_known, findings = False, findings + of_points
    config, of_surface = with_plane_of_surface(config, levels, views, frame)
    config, plane, of_plane = water_in_local(config, frame, views)
    departure = Departure.of(levels, frame, plane)
    if departure is None and plane is not None:
        departure = still_water(frame, plane, _seen(placed))
    return _LocalWater(config, plane, departure, levels, is_level_known), findings + of_surface + of_plane


def shifted_above_water(
    placed: PlacedViews, water: FlatWater | None, departure: Departure | None
) -> tuple[PlacedViews, Findings]:
    """Views shifted in height where all cameras lie under the water, of known level, or far above it.

    Only if positions share an unknown height error, which the adjustment estimates from the water. A warning says by
    how much.
    """
    seen = placed.observations
    if water is None or seen.ties is None or seen.control is not None or common_up_std(seen.priors) == 0.0:
        return placed, Findings()
    views = placed.views
    centres = np.array([view.camera.centre for view in views])
    over = height_above(water, departure, centres)
    most_m = most_of_cameras([view.camera for view in views])
    if over.min() > 0.0 and over.max() < most_m:
        return placed, Findings()
    x, y, _ = np.median(centres, axis=0).tolist()
    level = float(water.height(x, y)) + (0.0 if departure is None else float(departure.at(np.array([[x, y]]))[0][0]))
    up = level - over_points(seen.ties.start, centres)
    message = "under the water" if over.min() <= 0.0 else f"more than {most_m:.0f} m over the water"
    warning = (
        f"the heights of their positions put the cameras {message} ({over.min():.1f} to {over.max():.1f} m over it): "
        "the height of the block is taken from the water level; check level_m and its vertical datum"
    )
    shift = np.array([0.0, 0.0, up])
    ties = replace(seen.ties, start=seen.ties.start + shift)
    seen = replace(seen, points=ties.start, ties=ties)
    views = [replace(view, camera=replace(view.camera, centre=view.camera.centre + shift)) for view in views]
    return replace(placed, views=views, observations=seen), Findings(warnings=(warning,))


def _centres(views: list[View]) -> np.ndarray:
    """Cameras (V, 3) [m], local."""
    return np.array([view.camera.centre for view in views])


def _seen(placed: PlacedViews) -> np.ndarray:
    """Cameras and matched points (N, 3) [m], local: as far as a survey reaches."""
    centres, points = _centres(placed.views), placed.observations.points
    return centres if points is None else np.concatenate([centres, points])


def _doubts(placed: PlacedViews, water: _LocalWater) -> Findings:
    """What is said about probable mistakes; raises where the survey cannot be as it is given.

    A focal length comes first, as others follow from it. What does not need poses was held against the GPS positions
    before structure from motion already.
    """
    found, frame, views, seen = placed.found, placed.frame, placed.views, placed.observations
    centres, is_posed, crs = _centres(views), found.poses_path is not None, frame.crs
    above = None if water.above is None else water.above(centres)
    headers = {view.name: found.headers[view.name] for view in views}
    see_points = placed.provenance.reprojection is not None
    require_plausible(frame, views, above, water.config, found.headers, see_points=see_points)
    warnings = require_focal_lengths({view.name: view.lens for view in views}, found.headers) if is_posed else []
    warnings += require_apart(views, above) + place_warnings(frame, views, above, found.headers)
    if len(views) == 2:
        warnings.append(
            "two photographs: no third view checks a height; outliers against their surroundings are left out, heights "
            "under water are means of wide windows, much coarser than a pixel, and errors by what moved between the "
            "exposures may remain"
        )
    if not is_posed:
        return Findings(warnings=tuple(warnings))
    in_crs = frame.crs_from_local(centres)
    heights = in_crs[:, 2] * height_unit_m(crs)
    warnings += far_from_others(np.array(list(headers)), centres[:, :2], heights, "pose")
    warnings += shutter_warnings(water.config.cameras, headers, metres_per_px(views, water.plane))
    if seen.control is not None:
        warnings += mark_warnings(seen.control, views, water.plane)
    if above is not None and water.config.water is not None:
        level_m, at = water.config.water.known_level_m, place_of(crs, np.median(in_crs, axis=0))
        warnings += low_flight_warnings(above, level_m, at, crs)
        over_water = dict(zip(headers, above.tolist(), strict=True))
        warnings += start_height_warnings(over_water, headers, level_m, at, crs)
        warnings += exif_height_warnings(dict(zip(headers, heights.tolist(), strict=True)), headers)
    findings = checkpoint_findings(seen.checkpoints, views, water.plane, water.departure)
    return Findings(warnings=tuple(warnings)) + findings
