"""The figures of an adjustment in a report: parameters, observations, positions, poses, control, correlations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from survey.adjust.block.state import NUM_RELIEF
from survey.adjust.result.adjustment import Adjustment, ControlResidual, Parameter
from survey.adjust.result.ground_fit import GroundFit
from survey.adjust.result.std_common import CommonError, common_error
from survey.adjust.result.std_of_block import Part, parts_of_adjustment
from survey.display.quantities import length
from survey.folder.survey import Survey
from survey.report.checkpoints import CE95, LE95

# Parameters with a smaller standard deviation were held fixed.
HELD_STD = 1e-7
# Some programs write a camera per photograph, for which pictures would become too wide.
MOST_LENSES = 4
Axes = tuple[float, float, float]


@dataclass(frozen=True)
class KindFigures:
    """Observations of one kind."""

    name: str  # "matches", "windows" or "marks"
    num: int
    std_px: float  # Of a pixel coordinate
    factor: float  # Variance inflation for correlated errors of neighbours


@dataclass(frozen=True)
class PositionFigures:
    """Positions of the cameras that were given, against the adjusted ones."""

    num: int
    used_std_m: (
        tuple[float, ...] | None
    )  # (east, north, up) [m] or None: median standard deviation with which they were used
    rms_m: Axes  # (east, north, up) [m]: of adjusted minus given positions, without the common height error
    # largest_m, largest_name [m], str: the largest distance, and its photograph
    largest_m: float
    largest_name: str
    # (error, standard deviation) [m] or None: see `survey.adjust.result.adjustment.Adjustment`
    common_up_m: tuple[float, float] | None = None


@dataclass(frozen=True)
class PoseFigures:
    """Standard deviations of the adjusted poses."""

    position_m: Axes  # (east, north, up) [m]: medians
    rotation_deg: Axes  # (x, y, z) [deg]: Medians, about the axes of the camera
    # largest_position_m, largest_position_name: [m], str
    largest_position_m: float
    largest_position_name: str
    # largest_rotation_deg, largest_rotation_name: [deg], str
    largest_rotation_deg: float
    largest_rotation_name: str


@dataclass(frozen=True)
class ControlGroup:
    """All control points, or all check points."""

    name: str  # "control" or "check"
    num: int
    rms_m: Axes  # (east, north, up) [m]
    rms_px: float  # Of all marks
    # ce95_m, le95_m [m]: within which 95 % of normal errors are in plan and in height: 2.448 and 1.96 times the root
    # mean squares
    ce95_m: float
    le95_m: float


@dataclass(frozen=True)
class AdjustmentFigures:
    """Figures of an adjustment."""

    parameters: tuple[Parameter, ...]
    kinds: tuple[KindFigures, ...]
    num_points: int
    num_left_out: int
    positions: PositionFigures | None  # None where none were given
    poses: PoseFigures
    control: tuple[ControlResidual, ...]
    control_groups: tuple[ControlGroup, ...]
    common: CommonError | None
    parts: tuple[Part, ...]  # Those that share no points; none where the block is whole
    correlation_names: tuple[str, ...]  # (K,) of water and lenses, those that were estimated
    correlation: tuple[tuple[float, ...], ...]  # K rows of K
    ground: GroundFit | None = None  # How the block was placed on the dry ground of an earlier survey

    @property
    def note(self) -> str | None:
        """Std of all heights together, as a sentence."""
        if self.common is None:
            return None
        return (
            f"standard deviation by water, lens and poses: {length(self.common.mean)} of the mean height, "
            f"{length(self.common.typical)} of a typical height; matching errors add to it"
        )


def adjustment_of(survey: Survey, found: Adjustment | None) -> AdjustmentFigures | None:
    """The figures of an adjustment; None where there was none."""
    if found is None:
        return None
    names, correlation = correlations(found)
    kinds = [
        KindFigures(name, num, found.statistics.std_px[name], found.statistics.variance_factor[name])
        for name, num in found.statistics.num_observations.items()
    ]
    return AdjustmentFigures(
        parameters=found.parameters,
        kinds=tuple(kinds),
        num_points=found.statistics.num_points,
        num_left_out=found.statistics.num_left_out,
        positions=_positions(survey, found),
        poses=_poses(found),
        control=found.control,
        control_groups=_control_groups(found.control),
        common=common_error(found, survey.water),
        parts=parts_of_adjustment(found, survey.water),
        correlation_names=names,
        correlation=tuple(tuple(row) for row in correlation.tolist()),
        ground=found.ground,
    )


def shown_lenses(found: Adjustment) -> list[int]:
    """Lenses of pictures and tables: those with the most residuals, `MOST_LENSES` at most."""
    count = np.bincount(found.poses.lens_of[found.residuals.view], minlength=len(found.lenses))
    return sorted(np.argsort(-count, kind="stable")[:MOST_LENSES].tolist())


def correlations(found: Adjustment) -> tuple[tuple[str, ...], np.ndarray]:
    """Names (K,) and correlations (K, K) of the parameters of water and lenses that were estimated.

    Of many lenses those of `shown_lenses`; without focal lengths of single photographs.
    """
    layout = found.layout
    count = layout.first_focal - NUM_RELIEF
    std = np.sqrt(np.diag(found.covariance.matrix)[:count])
    for number in set(range(len(layout.aspect))) - set(shown_lenses(found)):
        own = layout.lens(number)
        std[own.start - NUM_RELIEF : own.stop - NUM_RELIEF] = 0.0
        if layout.finds_readouts:
            std[layout.first_readout + number - NUM_RELIEF] = 0.0
    free = np.flatnonzero(std > HELD_STD)
    matrix = found.covariance.matrix[np.ix_(free, free)] / np.outer(std[free], std[free])
    return tuple(found.covariance.names[i] for i in free), matrix


def _positions(survey: Survey, found: Adjustment) -> PositionFigures | None:
    given = {name: prior.position for name, prior in survey.observations.priors.items() if prior.position is not None}
    rows = [i for i, name in enumerate(found.poses.names) if name in given]
    if not rows:
        return None
    residual = found.poses.centres[rows] - np.array([given[found.poses.names[i]] for i in rows])
    residual[:, 2] += 0.0 if found.common_up_m is None else found.common_up_m[0]
    distance = np.linalg.norm(residual, axis=1)
    worst = int(np.argmax(distance))
    name = found.poses.names[rows[worst]]
    return PositionFigures(
        len(rows), found.statistics.gps_std_m, _rms(residual), float(distance[worst]), name, found.common_up_m
    )


def _poses(found: Adjustment) -> PoseFigures:
    position = np.linalg.norm(found.poses.position_std, axis=1)
    rotation = np.linalg.norm(found.poses.rotation_std_deg, axis=1)
    worst, worst_rotation = int(np.argmax(position)), int(np.argmax(rotation))
    return PoseFigures(
        _axes(np.median(found.poses.position_std, axis=0)),
        _axes(np.median(found.poses.rotation_std_deg, axis=0)),
        float(position[worst]),
        found.poses.names[worst],
        float(rotation[worst_rotation]),
        found.poses.names[worst_rotation],
    )


def _control_groups(control: tuple[ControlResidual, ...]) -> tuple[ControlGroup, ...]:
    groups = []
    for name, is_check in (("control", False), ("check", True)):
        rows = [row for row in control if row.is_check == is_check]
        if rows:
            marks = np.array([row.num_marks for row in rows])
            squares = np.array([row.rms_px for row in rows]) ** 2
            px = float(np.sqrt((marks * squares).sum() / max(marks.sum(), 1)))
            rms = _rms(np.array([row.residual_m for row in rows]))
            in_plan = float(np.hypot(rms[0], rms[1])) / np.sqrt(2.0)
            groups.append(ControlGroup(name, len(rows), rms, px, float(CE95 * in_plan), LE95 * rms[2]))
    return tuple(groups)


def _rms(values: np.ndarray) -> Axes:
    return _axes(np.sqrt(np.mean(values**2, axis=0)))


def _axes(values: np.ndarray) -> Axes:
    east, north, up = values.tolist()
    return (east, north, up)
