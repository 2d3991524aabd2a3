"""Drawn blocks as surveys, as they come out of structure from motion."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from geo import LocalFrame, parse_crs
from survey.adjust.result.adjustment import Adjustment
from survey.control.points import Control, ControlPoint, Mark
from survey.folder.local_frame import water_plane
from survey.folder.observations import BY_XMP, Observations, Velocity
from survey.folder.pose_priors import PosePrior
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.photos.poses import TiePoints
from survey.settings.config import CamerasConfig, SurveyConfig, WaterConfig
from tests.changed_survey import changed
from tests.drawn_block import DrawnBlock

# On a central meridian, where the axes of the grid are those of local.
CRS, ORIGIN = "EPSG:25832+5778", (500000.0, 5200000.0, 100.0)


def survey_of(block: DrawnBlock, *, shutter: tuple[float, float | None] | None = None) -> Survey:
    """The block with its GPS positions, stated lens, stated water and control points.

    Parameters
    ----------
    block : DrawnBlock
    shutter : (readout, standard deviation) [s], optional
        As survey.toml states it.
    """
    readout, readout_std = (None, None) if shutter is None else shutter
    frame = LocalFrame(parse_crs(CRS), ORIGIN)
    level, slope_east, slope_north, index = block.stated_water.tolist()
    water = WaterConfig(
        level_m=ORIGIN[2] + level,
        level_at=ORIGIN[:2],
        slope_east=slope_east,
        slope_north=slope_north,
        refractive_index=index,
        level_std_m=float(block.water_std[0]),
        slope_std=float(block.water_std[1]) or None,
        index_std=float(block.water_std[3]),
    )
    views = tuple(
        View(f"{number:03d}.jpg", Path(f"{number:03d}.jpg"), camera, block.stated_lens)
        for number, camera in enumerate(block.start_cameras)
    )
    priors = {
        view.name: PosePrior(position, block.position_std, None, "survey.toml")
        for view, position in zip(views, block.positions, strict=True)
    }
    ties, control = _parted(block, views)
    return Survey(
        name="block",
        folder=Path("block"),
        frame=frame,
        views=views,
        water=water_plane(frame, water),
        config=SurveyConfig(
            crs=CRS,
            water=water,
            cameras=CamerasConfig(rolling_shutter_s=readout, rolling_shutter_std_s=readout_std),
        ),
        observations=Observations(
            points=ties.start,
            ties=ties,
            priors=priors,
            control=control,
            velocities={view.name: Velocity(v, BY_XMP) for view, v in zip(views, block.velocities, strict=True)},
        ),
    )


def _parted(block: DrawnBlock, views: tuple[View, ...]) -> tuple[TiePoints, Control | None]:
    """Tie points, and the control points with their marks."""
    is_control = np.isin(block.point, block.control)
    every = TiePoints(block.start, block.point, block.view, block.pixel)
    if not len(block.control):
        return every, None
    points = tuple(
        ControlPoint(f"gcp{number}", (0.0, 0.0, 0.0), place, block.control_std)
        for number, place in enumerate(block.control_points)
    )
    marks = tuple(
        Mark(f"gcp{number}", views[block.view[i]].name, tuple(block.pixel[i].tolist()))
        for number, point in enumerate(block.control)
        for i in np.flatnonzero(block.point == point)
    )
    return every.only(~is_control), Control(points, marks, max(block.pixel_std, 0.05))


def with_water(survey: Survey, **settings) -> Survey:
    """The survey with other settings of its water."""
    water = replace(survey.config.water, **settings)
    return replace(survey, config=replace(survey.config, water=water), water=water_plane(survey.frame, water))


def with_shift(survey: Survey, shift, common_up_std: float) -> Survey:
    """The block as structure from motion puts it to positions of unknown accuracy that are off by a shift (3,) [m].

    Of which the heights count as having an error of that standard deviation in common.
    """
    shift = np.asarray(shift)
    views = tuple(
        replace(view, camera=replace(view.camera, centre=view.camera.centre + shift)) for view in survey.views
    )
    priors = {
        name: replace(
            prior, position=prior.position + shift, position_std=None, source="GPS EXIF", common_up_std=common_up_std
        )
        for name, prior in survey.observations.priors.items()
    }
    ties = replace(survey.observations.ties, start=survey.observations.ties.start + shift)
    return changed(survey, views=views, priors=priors, ties=ties, points=ties.start)


def height_error(block: DrawnBlock, found: Adjustment) -> float:
    """Median error of the heights of points [m], each against the true one, however far the block lies off in plan."""
    true = np.array([camera.centre for camera in block.cameras])
    aside = np.median(found.poses.centres - true, axis=0)[:2]
    distance, nearest = cKDTree(block.points[:, :2] + aside).query(found.points[:, :2])
    return float(np.median((found.points[:, 2] - block.points[nearest, 2])[distance < 0.5]))


def pose_errors(block: DrawnBlock, centres: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors of centres (V, 3) [m], local, and of rotations (V, 3) [rad] about the axes of cam."""
    true = np.array([camera.centre for camera in block.cameras])
    turned = rotations @ np.array([camera.cam_from_local for camera in block.cameras]).transpose(0, 2, 1)
    vector = np.stack(
        [turned[:, 2, 1] - turned[:, 1, 2], turned[:, 0, 2] - turned[:, 2, 0], turned[:, 1, 0] - turned[:, 0, 1]], -1
    )
    return centres - true, 0.5 * vector


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return math.sqrt(float(np.mean(np.square(values))))
