"""The result of an adjustment: parameters with verdicts, poses, covariance, residuals and control points."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from refract.lens import Lens, is_affine
from survey.adjust.block import state as block_state
from survey.adjust.block.control_check import control_warnings
from survey.adjust.block.normal_matrix import propagated_variance
from survey.adjust.block.observed import KINDS, MARK, Observed
from survey.adjust.observability import Unobservable
from survey.adjust.result import adjustment
from survey.adjust.rounds import RobustSolution, mean_by_kind
from survey.folder.observations import rows_between
from survey.folder.survey import Survey
from survey.settings.config import WaterConfig

_POSE_NAMES = ("x", "y", "z", "turn_x", "turn_y", "turn_z")
# Three determine a pose; as many again make it redundant, and so testable.
FEW_MATCHES = 6


def lens_with(lens: Lens, parameters: np.ndarray) -> Lens:
    """A lens with adjusted parameters (8,)."""
    if block_state.is_held(lens):
        return lens
    fx, fy = lens.focal
    f, cx, cy, k1, k2, k3, p1, p2 = parameters.tolist()
    if is_affine(lens):
        inner = (f, f * fy / fx, cx, cy, k1, k2, p1, p2, k3)
        return Lens(lens.model, (*inner, lens["k4"], lens["skew"]), lens.width, lens.height)
    return Lens("FULL_OPENCV", (f, f * fy / fx, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0), lens.width, lens.height)


def assemble_result(
    survey: Survey,
    done: RobustSolution,
    total: int,
    *,
    unobservable: dict[str, Unobservable] | None = None,
    contradicted: Sequence[int] = (),
    hold: Callable[[np.ndarray], RobustSolution] | None = None,
) -> adjustment.Adjustment:
    """Assemble the result of an adjustment of so many observations in total, before any was left out.

    ``unobservable``, of water of which nothing was known, has what is not observable, and why, by name. The estimates
    of ``contradicted`` parameters of the water are used, however uncertain. ``hold`` adjusts again with the parameters
    (P,) bool held that are not observable.
    """
    layout, first = done.prior.layout, done.solution.covariance
    held = np.zeros(len(layout), dtype=bool)
    while True:
        parameters, water, lost = _parameters_with_verdicts(survey, done, first, held, unobservable, contradicted)
        also = held | lost
        if hold is None or (also == held).all():
            break
        held, done = also, hold(also)
    prior, solution, used = done.prior, done.solution, done.used
    state, covariance = solution.state, solution.covariance
    poses = np.sqrt(np.diag(covariance)[layout.first_pose :]).reshape(-1, 6)
    # The apparent rises of a rough bed are nuisance parameters, and no result.
    kept = np.r_[: len(block_state.WATER_NAMES), layout.first_lens : len(layout)]
    return adjustment.Adjustment(
        parameters=tuple(parameters),
        water=water,
        lenses=tuple(lens_with(lens, state.lenses[i]) for i, lens in enumerate(prior.lenses)),
        poses=adjustment.AdjustedPoses(
            names=tuple(view.name for view in survey.views),
            lens_of=layout.lens_of,
            centres=state.centres,
            rotations=state.rotations,
            position_std=poses[:, :3],
            rotation_std_deg=np.degrees(poses[:, 3:]),
            velocity_per_row=layout.velocity_per_row,
            tides=state.tides(layout),
            hours=layout.hours,
            focals=state.focals if layout.finds_focals else None,
        ),
        covariance=adjustment.Covariance(
            covariance[np.ix_(kept, kept)], _names_of(survey, layout), prior.place_of_water
        ),
        residuals=adjustment.Residuals(used.ties.view, solution.residuals, used.ties.pixel, used.ties.point),
        statistics=_statistics(done, total),
        control=_control(survey, used, solution, state),
        points=state.points,
        warnings=tuple(_warnings(survey, done)),
        readouts_s=tuple(state.readouts.tolist()) or None,
    )


def _statistics(done: RobustSolution, total: int) -> adjustment.FitStatistics:
    """Statistics of the fit of observations, of which there were ``total`` before any was left out."""
    solution, used = done.solution, done.used
    counts = {name: int((used.kind == kind).sum()) for kind, name in enumerate(KINDS)}
    factors = mean_by_kind(done.variance_factor, used.kind)
    of_gps = done.prior.pose_std[:, :3]
    of_gps = of_gps[np.isfinite(of_gps).all(axis=1)]
    return adjustment.FitStatistics(
        std_px={name: float(solution.std_px[kind]) for kind, name in enumerate(KINDS) if counts[name]},
        variance_factor={name: float(factors[kind]) for kind, name in enumerate(KINDS) if counts[name]},
        num_observations={name: count for name, count in counts.items() if count},
        num_points=len(used.ties),
        num_left_out=total - len(used.kind),
        gps_std_m=None if not len(of_gps) else tuple(np.median(of_gps, axis=0).tolist()),
    )


def _names_of(survey: Survey, layout: block_state.Layout) -> tuple[str, ...]:
    """Names of the rows of the covariance."""
    num_lenses, num_readouts = len(layout.aspect), layout.first_rate - layout.first_readout
    return (
        *block_state.WATER_NAMES,
        *(f"camera{i}.{name}" for i in range(num_lenses) for name in block_state.LENS_NAMES),
        *(f"camera{i}.{block_state.READOUT_NAME}" for i in range(num_readouts)),
        *(block_state.RATE_NAME for _ in range(layout.first_focal - layout.first_rate)),
        *(f"{view.name}.{block_state.FOCAL_NAME}" for view in survey.views if layout.finds_focals),
        *(f"{view.name}.{name}" for view in survey.views for name in _POSE_NAMES),
    )


def _warnings(survey: Survey, done: RobustSolution) -> list[str]:
    """Warnings about control, positions and photographs that the block contradicts or barely constrains."""
    warnings = control_warnings(survey.observations.control, survey.views, done.used, done.solution.state)
    for kind, bad in zip(("positions", "rotations"), done.blunders.T, strict=True):
        if bad.any():
            names = ", ".join(view.name for view, is_bad in zip(survey.views, bad, strict=True) if is_bad)
            warnings.append(f"{kind} that the block contradicts are not used: {names}")
    matches = np.bincount(done.used.ties.view, minlength=len(survey.views))
    loose = [view.name for view, count in zip(survey.views, matches, strict=True) if count < FEW_MATCHES]
    if loose:
        warnings.append(
            f"fewer than {FEW_MATCHES} matches, so that the poses hardly change: {', '.join(loose)}; leave these "
            "photographs out"
        )
    return warnings


def _parameters_with_verdicts(
    survey: Survey,
    done: RobustSolution,
    first: np.ndarray,
    held: np.ndarray,
    unobservable: dict[str, Unobservable] | None,
    contradicted: Sequence[int],
) -> tuple[list[adjustment.Parameter], WaterConfig | None, np.ndarray]:
    """Parameters of water and lenses with their verdicts, the water, and which (P,) bool of them are not observable."""
    prior, state, layout = done.prior, done.solution.state, done.prior.layout
    parameters: list[adjustment.Parameter] = []
    water: WaterConfig | None = None
    if survey.water is not None:
        parameters, water = _water(survey, done, first, held[: block_state.NUM_WATER], unobservable, contradicted)
    std, at_of = np.sqrt(np.where(held, np.diag(first), np.diag(done.solution.covariance))), [*range(len(parameters))]

    def judge(name: str, at: int, value: float, given: float, limit: float, unit: str) -> None:
        found, before = (
            adjustment.Estimate(float(value), float(std[at])),
            adjustment.Estimate(float(given), float(prior.std[at])),
        )
        parameters.append(adjustment.with_verdict(name, found, before, float(limit), unit))
        at_of.append(at)

    for number, lens in enumerate(prior.lenses):
        values = (
            ()
            if block_state.is_held(lens)
            else zip(block_state.LENS_NAMES, state.lenses[number], prior.mean.lenses[number], strict=True)
        )
        for i, (name, value, given) in enumerate(values):
            # Only the focal length scales heights; all else is of use however uncertain.
            limit, unit = adjustment.MOST_STD_FOCAL * given if name == "f" else math.inf, " px" if i < 3 else ""
            judge(f"camera{number}.{name}", layout.lens(number).start + i, value, given, limit, unit)
    if layout.hours is not None:
        given = survey.require_water()[1].level_rate_m_per_h or 0.0
        # Of no use if it leaves the level of a photograph as uncertain as one that is of none.
        limit = adjustment.MOST_STD_LEVEL_M / max(float(np.abs(layout.hours).max()), 1e-9)
        judge(block_state.RATE_NAME, layout.first_rate, given + state.rate, given, limit, " m/h")
    for number in range(len(prior.lenses) if layout.finds_readouts else 0):
        limit = _readout_limit(state, layout, number, prior.lenses[number].height)
        value, given = state.readouts[number], prior.mean.readouts[number]
        judge(f"camera{number}.{block_state.READOUT_NAME}", layout.first_readout + number, value, given, limit, " s")
    lost = np.zeros(len(layout), dtype=bool)
    lost[[at for at, row in zip(at_of, parameters, strict=True) if row.status == adjustment.Status.UNKNOWN]] = True
    return parameters, water, lost


def _readout_limit(state: block_state.State, layout: block_state.Layout, number: int, height: int) -> float:
    """Limit of use [s] of the readout of a lens: its last row moves against the first by half a pixel on the ground."""
    assert layout.velocity_per_row is not None
    range_m = np.maximum(state.centres[:, 2] - np.median(state.points[:, 2]), 1e-6)
    px_per_s = (
        np.linalg.norm(layout.velocity_per_row, axis=1) * rows_between(height) * state.lenses[number, 0] / range_m
    )
    return adjustment.MOST_STD_ROWS_PX / max(float(px_per_s[layout.lens_of == number].max()), 1e-9)


def _water(
    survey: Survey,
    done: RobustSolution,
    first: np.ndarray,
    held: np.ndarray,
    unobservable: dict[str, Unobservable] | None,
    contradicted: Sequence[int],
) -> tuple[list[adjustment.Parameter], WaterConfig]:
    """Level, slopes and index in the terms of survey.toml, with verdicts; ``first`` see `_parameters_with_verdicts`."""
    _, water = survey.require_water()
    prior, state, given = done.prior, done.solution.state, block_state.settings_of(water)
    by_local = block_state.settings_by_local(survey, np.array(prior.place_of_water))
    values = given + by_local @ (state.water_parameters() - prior.mean.water_parameters())
    matrices = done.solution.covariance, first, np.diag(prior.std[: block_state.NUM_WATER] ** 2)
    std, held_std, given_std = (
        np.sqrt(propagated_variance(by_local, matrix[: block_state.NUM_WATER, : block_state.NUM_WATER]))
        for matrix in matrices
    )
    std, limits = np.where(held, held_std, std), adjustment.water_limits(state.points)
    limits[list(contradicted)] = np.inf
    rows: list[adjustment.Parameter] = []
    for i, name in enumerate(block_state.WATER_PARAMETERS):
        before = adjustment.Estimate(float(given[i]), float(given_std[i]) if unobservable is None else math.inf)
        found = adjustment.Estimate(float(values[i]), float(std[i]))
        row = adjustment.with_verdict(name, found, before, float(limits[i]), "" if i else " m")
        if i in (1, 2) and rows[0].status == adjustment.Status.UNKNOWN and row.status == adjustment.Status.FREE:
            # Slopes turn the plane about a point other than that of the level: without a level they are of no use.
            verdict = "not observable: the level is not; the slope is kept"
            row = replace(row, value=row.given, status=adjustment.Status.UNKNOWN, verdict=verdict)
        rows.append(row)
    # Not before slopes are judged: an unobservable level is held, and the slopes found beside it are of use.
    for i, (name, value) in enumerate(zip(block_state.WATER_PARAMETERS, given.tolist(), strict=True)):
        if unobservable and (lost := unobservable.get(name)) is not None:
            rows[i] = adjustment.unobservable_verdict(name, lost.std, value, lost.reason)
    return rows, block_state.with_settings(water, np.array([row.value for row in rows]))


def _control(
    survey: Survey, used: Observed, solution, state: block_state.State
) -> tuple[adjustment.ControlResidual, ...]:
    """Residuals at control points."""
    control = survey.observations.control
    if control is None:
        return ()
    by_name = {point.name: point for point in control.points}
    first = len(used.ties) - len(used.control)
    found = []
    for number, name in enumerate(used.control, start=first):
        is_mark = (used.ties.point == number) & (used.kind == MARK)
        point = state.points[number]
        wet = state.water is not None and float(state.water.depth(point[None])[0]) > 0.0
        east, north, up = (point - by_name[name].local).tolist()
        rms = float(np.sqrt(np.mean(np.square(solution.residuals[is_mark]))))
        is_check = not np.isfinite(used.point_std[number]).all()
        found.append(adjustment.ControlResidual(name, is_check, wet, (east, north, up), int(is_mark.sum()), rms))
    return tuple(found)
