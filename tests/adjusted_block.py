"""An adjustment of a random block whose truth is known, as the report gets it; nothing is solved."""

from __future__ import annotations

from dataclasses import fields, is_dataclass

import numpy as np

from refract.lens import Lens
from survey.adjust.block.state import LENS_NAMES, WATER_NAMES
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
from survey.settings.config import WaterConfig
from tests.drawn_block import DrawnBlock, draw_block

POSE_NAMES = ("x", "y", "z", "turn_x", "turn_y", "turn_z")


def names_of(num_views: int) -> tuple[str, ...]:
    """Names of the parameters of a block with one lens."""
    lens = [f"camera0.{name}" for name in LENS_NAMES]
    return (*WATER_NAMES, *lens, *(f"{view}.{name}" for view in range(num_views) for name in POSE_NAMES))


def drawn_adjustment(seed: int = 3, **changes) -> tuple[DrawnBlock, Adjustment]:
    """The truth of `drawn_block.draw_block` as an adjustment, with its noise as residuals and a plain covariance."""
    block = draw_block(seed, **changes)
    num = len(block.cameras)
    names = names_of(num)
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
