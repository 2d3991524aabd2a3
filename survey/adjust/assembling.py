"""The result of an adjustment: parameters with verdicts, poses, covariance, residuals and control points."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from refract.lens import Lens, is_affine
from survey.adjust.block.control_check import control_warnings
from survey.adjust.block.normal_matrix import propagated_variance
from survey.adjust.block.observed import KINDS, MARK, Observed
from survey.adjust.block.priors import PriorKnowledge
from survey.adjust.block.state import (
    FOCAL_NAME,
    LENS_NAMES,
    NUM_WATER,
    RATE_NAME,
    READOUT_NAME,
    WATER_NAMES,
    Layout,
    State,
    is_held,
    settings_by_local,
    settings_of,
    with_settings,
)
from survey.adjust.observability import Unobservable, not_observable
from survey.adjust.result.adjustment import (
    MOST_STD_LEVEL_M,
    AdjustedPoses,
    Adjustment,
    ControlResidual,
    Covariance,
    Estimate,
    FitStatistics,
    Parameter,
    Residuals,
    lens_verdicts,
    readout_limits,
    unobservable_verdict,
    water_limits,
    water_verdicts,
    with_verdict,
)
from survey.adjust.rounds import RobustSolution, mean_by_kind
from survey.folder.survey import Survey
from survey.settings.config import WaterConfig

_POSE_NAMES = ("x", "y", "z", "turn_x", "turn_y", "turn_z")
# Three determine a pose; as many again make it redundant, and so testable.
FEW_MATCHES = 6


def lens_with(lens: Lens, parameters: np.ndarray) -> Lens:
    """A lens with adjusted parameters (8,)."""
    if is_held(lens):
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
) -> Adjustment:
    """Assemble the result of an adjustment.

    Parameters
    ----------
    total : int
        Observations before any was left out.
    unobservable : dict of name to Unobservable, optional
        Of water of which nothing was known: what is not observable, and why.
    contradicted : sequence of int, optional
        Parameters of the water that the block contradicts: their estimates are used, however uncertain.
    hold : callable, optional
        Adjusts again with the parameters (P,) bool held that are not observable.
    """
    layout, first = done.prior.layout, done.solution.covariance
    held = np.zeros(len(layout), dtype=bool)
    while True:
        parameters, water = _parameters_with_verdicts(survey, done, first, held, unobservable, contradicted)
        also = held | not_observable(parameters, layout)
        if hold is None or (also == held).all():
            break
        held, done = also, hold(also)
    prior, solution, used = done.prior, done.solution, done.used
    state, covariance = solution.state, solution.covariance
    poses = np.sqrt(np.diag(covariance)[layout.first_pose :]).reshape(-1, 6)
    # The apparent rises of a rough bed are nuisance parameters, and no result.
    kept = np.r_[: len(WATER_NAMES), layout.first_lens : len(layout)]
    return Adjustment(
        parameters=parameters,
        water=water,
        lenses=tuple(lens_with(lens, state.lenses[i]) for i, lens in enumerate(prior.lenses)),
        poses=AdjustedPoses(
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
        covariance=Covariance(covariance[np.ix_(kept, kept)], _names_of(survey, layout), prior.place_of_water),
        residuals=Residuals(used.ties.view, solution.residuals, used.ties.pixel, used.ties.point),
        statistics=_statistics(done, total),
        control=_control(survey, used, solution, state),
        points=state.points,
        warnings=tuple(_warnings(survey, done)),
        readouts_s=tuple(state.readouts.tolist()) or None,
    )


def _statistics(done: RobustSolution, total: int) -> FitStatistics:
    """Statistics of the fit of observations, of which there were ``total`` before any was left out."""
    solution, used = done.solution, done.used
    counts = {name: int((used.kind == kind).sum()) for kind, name in enumerate(KINDS)}
    factors = mean_by_kind(done.variance_factor, used.kind)
    of_gps = done.prior.std[done.prior.layout.first_pose :].reshape(-1, 6)[:, :3]
    of_gps = of_gps[np.isfinite(of_gps).all(axis=1)]
    return FitStatistics(
        std_px={name: float(solution.std_px[kind]) for kind, name in enumerate(KINDS) if counts[name]},
        variance_factor={name: float(factors[kind]) for kind, name in enumerate(KINDS) if counts[name]},
        num_observations={name: count for name, count in counts.items() if count},
        num_points=len(used.ties),
        num_left_out=total - len(used.kind),
        gps_std_m=None if not len(of_gps) else tuple(np.median(of_gps, axis=0).tolist()),
    )


def _names_of(survey: Survey, layout: Layout) -> tuple[str, ...]:
    """Names of the rows of the covariance."""
    num_lenses, num_readouts = len(layout.aspect), layout.first_rate - layout.first_readout
    return (
        *WATER_NAMES,
        *(f"camera{i}.{name}" for i in range(num_lenses) for name in LENS_NAMES),
        *(f"camera{i}.{READOUT_NAME}" for i in range(num_readouts)),
        *(RATE_NAME for _ in range(layout.first_focal - layout.first_rate)),
        *(f"{view.name}.{FOCAL_NAME}" for view in survey.views if layout.finds_focals),
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
) -> tuple[tuple[Parameter, ...], WaterConfig | None]:
    """Parameters of water and lenses with their verdicts, and the water; ``first``: covariance before any was held."""
    prior, state, covariance = done.prior, done.solution.state, done.solution.covariance
    parameters: list[Parameter] = []
    water: WaterConfig | None = None
    if survey.water is not None:
        verdicts, water = _water(survey, done, first, held[:NUM_WATER], unobservable, contradicted)
        parameters += verdicts
    variance = np.where(held, np.diag(first), np.diag(covariance))
    for number, lens in enumerate(prior.lenses):
        if not is_held(lens):
            at = prior.layout.lens(number)
            std = np.sqrt(variance[at])
            parameters += lens_verdicts(number, state.lenses[number], std, prior.mean.lenses[number], prior.std[at])
    if prior.layout.hours is not None:
        parameters.append(_rate(survey, prior, state, float(np.sqrt(variance[prior.layout.first_rate]))))
    if prior.layout.finds_readouts:
        parameters += _readouts(prior, state, np.sqrt(variance))
    return tuple(parameters), water


def _rate(survey: Survey, prior: PriorKnowledge, state: State, std: float) -> Parameter:
    """Rate of the level, of no use if it leaves the level of a photograph as uncertain as one that is of none."""
    hours, given = prior.layout.hours, survey.require_water()[1].rate.level_rate_m_per_h or 0.0
    assert hours is not None
    before = Estimate(given, float(prior.std[prior.layout.first_rate]))
    limit = MOST_STD_LEVEL_M / max(float(np.abs(hours).max()), 1e-9)
    return with_verdict(RATE_NAME, Estimate(given + state.rate, std), before, limit, " m/h")


def _readouts(prior: PriorKnowledge, state: State, std: np.ndarray) -> list[Parameter]:
    """Readouts of the shutters with verdicts; ``std`` is that of all parameters (P,)."""
    first, limits = prior.layout.first_readout, readout_limits(state, prior.layout, [w.height for w in prior.lenses])
    return [
        with_verdict(
            f"camera{number}.{READOUT_NAME}",
            Estimate(float(state.readouts[number]), float(std[first + number])),
            Estimate(float(prior.mean.readouts[number]), float(prior.std[first + number])),
            float(limits[number]),
            " s",
        )
        for number in range(len(prior.lenses))
    ]


def _water(
    survey: Survey,
    done: RobustSolution,
    first: np.ndarray,
    held: np.ndarray,
    unobservable: dict[str, Unobservable] | None,
    contradicted: Sequence[int],
) -> tuple[list[Parameter], WaterConfig]:
    """Level, slopes and index in the terms of survey.toml, with verdicts; ``first`` see `_parameters_with_verdicts`."""
    _, given = survey.require_water()
    prior, state = done.prior, done.solution.state
    by_local = settings_by_local(survey, np.array(prior.place_of_water))
    values = settings_of(given) + by_local @ (state.water_parameters() - prior.mean.water_parameters())
    std, held_std = (
        np.sqrt(propagated_variance(by_local, c[:NUM_WATER, :NUM_WATER])) for c in (done.solution.covariance, first)
    )
    given_std = np.sqrt(propagated_variance(by_local, np.diag(prior.std[:NUM_WATER] ** 2)))
    if unobservable is not None:
        given_std = np.full(NUM_WATER, np.inf)
    limits = water_limits(state.points)
    limits[list(contradicted)] = np.inf
    found = water_verdicts(values, np.where(held, held_std, std), given, given_std, limits)
    for i, row in enumerate(found):
        if unobservable and row.name in unobservable:
            found[i] = unobservable_verdict(
                row.name, unobservable[row.name].std, row.given, unobservable[row.name].reason
            )
    return found, with_settings(given, np.array([row.value for row in found]))


def _control(survey: Survey, used: Observed, solution, state: State) -> tuple[ControlResidual, ...]:
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
        found.append(ControlResidual(name, is_check, wet, (east, north, up), int(is_mark.sum()), rms))
    return tuple(found)
