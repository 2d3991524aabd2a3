"""Drawn blocks as surveys out of structure from motion; their truth as a solved adjustment and as its state."""

import math
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from geo import LocalFrame, parse_crs
from refract.lens import Lens
from survey.adjust.block.prediction import Prediction, apparent_rise_design, design_matrix, linearise, predict
from survey.adjust.block.state import LENS_NAMES, NUM_LENS, NUM_RELIEF, WATER_NAMES, Layout, State
from survey.adjust.result.adjustment import (
    AdjustedPoses,
    Adjustment,
    ControlResidual,
    Covariance,
    FitStatistics,
    Parameter,
    Residuals,
    Status,
)
from survey.control.points import Control, ControlPoint, Mark
from survey.folder.local_frame import water_plane
from survey.folder.observations import BY_XMP, Observations, Velocity
from survey.folder.pose_priors import PosePrior
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.photos.poses import TiePoints
from survey.settings.config import CamerasConfig, SurveyConfig, WaterConfig
from tests.changed_survey import changed
from tests.drawn_block import DrawnBlock, draw_block

# On a central meridian, where the axes of the grid are those of local.
CRS, ORIGIN = "EPSG:25832+5778", (500000.0, 5200000.0, 100.0)


def survey_of(block: DrawnBlock, *, shutter: tuple[float, float | None] | None = None) -> Survey:
    """The block with its GPS positions, stated lens, water and control points; and shutter: readout and its std [s]."""
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
            crs=CRS, water=water, cameras=CamerasConfig(rolling_shutter_s=readout, rolling_shutter_std_s=readout_std)
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


POSE_NAMES = ("x", "y", "z", "turn_x", "turn_y", "turn_z")


def drawn_adjustment(seed: int = 3, **changes) -> tuple[DrawnBlock, Adjustment]:
    """The truth of `drawn_block.draw_block` as an adjustment, with its noise as residuals and a plain covariance."""
    block = draw_block(seed, **changes)
    num = len(block.cameras)
    of_poses = (f"{view}.{name}" for view in range(num) for name in POSE_NAMES)
    names = (*WATER_NAMES, *(f"camera0.{name}" for name in LENS_NAMES), *of_poses)
    poses = np.tile([0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4], num)
    std = np.concatenate([[0.01, 1e-4, 1e-4, 5e-4], [0.5, 0.5, 0.5, *np.full(5, 1e-4)], poses])
    fx, fy, cx, cy, k1, k2, p1, p2 = block.lens.params
    lens = Lens("FULL_OPENCV", (fx, fy, cx, cy, k1, k2, p1, p2, *np.zeros(4)), block.lens.width, block.lens.height)
    noise = block.pixel_std * np.random.default_rng(seed).standard_normal(block.pixel.shape)
    level, slope_x, slope_y, index = block.water.tolist()
    parameters = (
        Parameter(
            "level_m", level, 0.012, level + 0.03, 0.04, Status.FREE, "found: 0.123 +- 0.012 m (given 0.153 +- 0.04 m)"
        ),
        Parameter(
            "refractive_index", index, 0.001, index, 0.001, Status.HELD, "held: 1.3330 +- 0.001 (given 1.3330 +- 0.001)"
        ),
        Parameter("camera0.f", fx, 0.5, fx - 4.0, 14.0, Status.FREE, "found: 702.1 +- 0.5 px (given 698 +- 14 px)"),
    )
    control = (
        ControlResidual("gcp1", False, False, (0.004, -0.003, 0.002), 7, 0.31),
        ControlResidual("gcp2", True, True, (-0.012, 0.006, 0.021), 5, 0.52),
    )
    return block, Adjustment(
        parameters=parameters,
        water=WaterConfig(
            level_m=level, level_at=(0.0, 0.0), slope_east=slope_x, slope_north=slope_y, refractive_index=index
        ),
        lenses=(lens,),
        poses=AdjustedPoses(
            names=tuple(f"{view:04d}.jpg" for view in range(num)),
            lens_of=np.zeros(num, dtype=np.int64),
            centres=np.array([camera.centre for camera in block.cameras]),
            rotations=np.array([camera.cam_from_local for camera in block.cameras]),
            position_std=np.full((num, 3), 0.01),
            rotation_std_deg=np.full((num, 3), 0.006),
        ),
        covariance=Covariance(np.diag(std**2), names, (1.0, -2.0)),
        residuals=Residuals(block.view, noise, block.pixel, block.point),
        statistics=FitStatistics(
            std_px={"windows": 0.3, "marks": 0.5},
            variance_factor={"windows": 2.4, "marks": 1.0},
            num_observations={"windows": len(block.view), "marks": 12},
            num_points=len(block.points),
            num_left_out=17,
            gps_std_m=(0.02, 0.02, 0.03),
        ),
        control=control,
        points=block.points,
    )


def assert_same(found: Adjustment, expected: Adjustment) -> None:
    """Raise AssertionError unless two adjustments, and the records in them, have the same values of the same types."""
    for field in fields(expected):
        one, other = getattr(found, field.name), getattr(expected, field.name)
        if is_dataclass(other):
            assert_same(one, other)
        elif isinstance(other, np.ndarray):
            np.testing.assert_array_equal(one, other, err_msg=field.name)
        else:
            assert one == other, field.name


STEP = 1e-5


def state_of(
    block: DrawnBlock, *, rolls: bool = False, finds_readouts: bool = False
) -> tuple[Layout, State, TiePoints]:
    """The truth of a block as taken through two lenses that are alike, with its rolling shutter if ``rolls``."""
    lens = block.lens
    parameters = np.array([lens.focal[0], lens["cx"], lens["cy"], lens["k1"], lens["k2"], 0.0, lens["p1"], lens["p2"]])
    velocity_per_row = block.velocities / (lens.height - 1) if rolls else None
    layout = Layout(np.arange(len(block.cameras)) % 2, np.ones(2), velocity_per_row, finds_readouts=finds_readouts)
    state = State(
        block.plane,
        np.zeros(NUM_RELIEF),
        np.tile(parameters, (2, 1)),
        np.array([camera.centre for camera in block.cameras]),
        np.array([camera.cam_from_local for camera in block.cameras]),
        block.points,
        *([np.full(2, block.readout)] if rolls else []),
    )
    return layout, state, TiePoints(block.points, block.point, block.view, block.pixel)


def require_derivatives(layout: Layout, state: State, ties: TiePoints) -> Prediction:
    """Assert that predictions are those of `predict`, and their derivatives by all parameters differences of it."""
    rise_design = apparent_rise_design(state, ties)
    linear = linearise(layout, state, ties, rise_design)
    np.testing.assert_array_equal(linear.pixels, predict(layout, state, ties, rise_design))
    still, dense = np.zeros((len(ties), 3)), design_matrix(layout, ties.view, linear.by_parameters).toarray()
    assert dense.shape[1] == len(layout)
    # Steps that move pixels by some hundredths.
    steps = np.full(len(layout), STEP)
    steps[layout.first_lens : layout.first_readout] = np.tile([0.01, 0.01, 0.01, *np.full(NUM_LENS - 3, STEP)], 2)
    for number in range(len(layout)):
        step = np.zeros(len(layout))
        step[number] = steps[number]
        ahead, behind = (
            predict(layout, state.moved(layout, sign * step, still), ties, rise_design) for sign in (1.0, -1.0)
        )
        difference = (ahead - behind).ravel() / (2.0 * steps[number])
        scale = max(np.abs(difference).max(), 1.0)
        np.testing.assert_allclose(dense[:, number] / scale, difference / scale, atol=1e-6, err_msg=str(number))
    return linear
