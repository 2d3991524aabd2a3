"""Observability of water, lens, shutter and roll by a block, and adjustment with parameters held that it leaves open.

`adjust_free`
    Of a survey without prior knowledge of its water. The worst parameter is held first, and the others are adjusted
    again. Without the level nothing is observable, and the block is adjusted under the given water.
`adjusted_with`
    With parameters held at their stated values. Where neither photographs nor survey know one well enough, the value
    that was found follows the noise of the block. With C the covariance with all parameters free, U those that are
    held, and S the covariance of what was given of them, the others follow them by ``G = C[:, U] C[U, U]^-1``, and the
    covariance of the block is ``C + G (S - C[U, U]) G^T``.

Notes on the roll of a block about the line of its positions, and refusal of one that is too uncertain.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from survey.adjust.block.bundle import NotConvergedError, Solution, levenberg_marquardt
from survey.adjust.block.normal_equations import system_with
from survey.adjust.block.normal_matrix import propagated, propagated_variance
from survey.adjust.block.observed import Observed
from survey.adjust.block.priors import FREE_WATER, PriorKnowledge
from survey.adjust.block.problem import huber_weights
from survey.adjust.block.roll import Roll, spans_area
from survey.adjust.block.state import HELD_SHARE, NUM_WATER, WATER_PARAMETERS, State, settings_by_local
from survey.adjust.result.adjustment import water_limits
from survey.adjust.rounds import RobustSolution, adjust
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints
from survey.plan.choices import max_height_std
from survey.sfm.gps_fit import ROLL_REMEDY

# Fewest tie points under water. The covariance is estimated from the scatter of N points, to one part in sqrt(2 N): an
# eighth. Fewer also turn wet and dry as the level moves, and the adjustment oscillates.
FEWEST_WET = 30
# Held with this standard deviation, slopes and index: the index of natural water is known this well without
# measurement, and so are the slopes of water seen on site.
_HELD_STD = np.array([HELD_SHARE, 1e-3, 1e-3, 3e-3])


@dataclass(frozen=True)
class Unobservable:
    """A parameter of the water that is not observable: reason, and standard deviation before it was held."""

    std: float
    reason: str


def adjust_free(
    survey: Survey, prior: PriorKnowledge, seen: Observed
) -> tuple[RobustSolution, dict[str, Unobservable]]:
    """Adjust a block with free water (`prior`); also returns its unobservable parameters by name."""

    def under_given_water(unobservable: dict[str, Unobservable]) -> tuple[RobustSolution, dict[str, Unobservable]]:
        held = prior.std.copy()
        held[:NUM_WATER] = HELD_SHARE
        return adjust(replace(prior, std=held), seen), unobservable

    few = _too_few(replace(prior.state, points=seen.ties.start))
    if few is None:
        try:
            done = adjust(prior, seen)
            few = _too_few(done.solution.state)
        except NotConvergedError as error:
            few = str(error)
    if few is not None:
        return under_given_water(none_observable(few))
    limits = water_limits(done.solution.state.points)
    first = std = water_std(survey, done)
    unobservable: dict[str, Unobservable] = {}
    for _ in WATER_PARAMETERS:
        ratio = np.array(
            [0.0 if name in unobservable else std[i] / limits[i] for i, name in enumerate(WATER_PARAMETERS)]
        )
        if not ratio[0] <= 1.0:
            return under_given_water(_without_level(first, limits))
        worst = int(np.argmax(ratio))
        if ratio[worst] <= 1.0:
            break
        unobservable[WATER_PARAMETERS[worst]] = Unobservable(
            float(first[worst]), _too_uncertain(worst, first[worst], limits[worst])
        )
        held = done.prior.std.copy()
        held[worst] = _HELD_STD[worst]
        start = done.solution.state.without_points()
        done = adjust(replace(done.prior, std=held, state=start), done.used)
        std = water_std(survey, done)
    return done, unobservable


def none_observable(reason: str) -> dict[str, Unobservable]:
    """All parameters of the water as unobservable, with the reason at the level."""
    reasons = (reason, *["the level is not"] * (NUM_WATER - 1))
    return {
        name: Unobservable(float(std), text)
        for name, std, text in zip(WATER_PARAMETERS, FREE_WATER, reasons, strict=True)
    }


def within_bounds(survey: Survey, ties: TiePoints) -> TiePoints:
    """The tie points inside the bounds of a survey, without a margin.

    Their places are known to centimetres, and beyond the bounds there may be other water: a pond, a weir.
    """
    inside = _inside(survey, ties)
    return ties if inside is None else ties.only(inside[ties.point])


def dry_or_within_bounds(survey: Survey, ties: TiePoints) -> TiePoints:
    """Tie points without those under water beyond the bounds; dry ones there constrain the poses."""
    inside = _inside(survey, ties)
    if inside is None or survey.water is None:
        return ties
    return ties.only((inside | (survey.water.depth(ties.start) < 0.0))[ties.point])


def _inside(survey: Survey, ties: TiePoints) -> np.ndarray | None:
    if survey.bounds is None:
        return None
    e0, n0, e1, n1 = survey.bounds
    east, north, _ = survey.frame.crs_from_local(ties.start).T
    return (east >= e0) & (east <= e1) & (north >= n0) & (north <= n1)


def _too_few(state: State) -> str | None:
    assert state.water is not None
    num_wet = int((state.water.depth(state.points) > 0.0).sum())
    if num_wet >= FEWEST_WET:
        return None
    return f"{num_wet} of {len(state.points)} tie points lie under water, expected at least {FEWEST_WET}"


def water_std(survey: Survey, done: RobustSolution) -> np.ndarray:
    """Standard deviations (4,) of level, slopes and index as survey.toml counts them."""
    water = done.prior.mean.water
    assert water is not None
    by_local = settings_by_local(survey, np.array(water.point[:2]))
    return np.sqrt(propagated_variance(by_local, done.solution.covariance[:NUM_WATER, :NUM_WATER]))


def _without_level(std: np.ndarray, limits: np.ndarray) -> dict[str, Unobservable]:
    unobservable = {}
    for i, name in enumerate(WATER_PARAMETERS):
        reason = _too_uncertain(i, std[i], limits[i])
        if std[i] <= limits[i]:
            # What it seems to be depends on where the level is kept.
            reason = f"the level is not, and {name} cannot be separated from it"
        unobservable[name] = Unobservable(float(std[i]), reason)
    return unobservable


def _too_uncertain(number: int, std: float, limit: float) -> str:
    unit = " m" if number == 0 else ""
    return f"1 sigma is {std:.2g}{unit}, at most {limit:.2g}{unit} would be of use"


def adjusted_with(done: RobustSolution, held: np.ndarray, stated_std: np.ndarray) -> RobustSolution:
    """The block, adjusted with all parameters free, with some (P,) bool held at values of a stated std (P,)."""
    prior, problem, covariance = done.prior, done.problem, done.solution.covariance
    std_px, factor = problem.given_std_px, done.variance_factor
    std = np.where(held, HELD_SHARE * prior.std, prior.std)
    kept = replace(problem, priors=replace(problem.priors, std=std))
    follow = covariance[:, held] @ np.linalg.inv(covariance[np.ix_(held, held)])
    # Back to the given values, the others re-adjusted.
    step = -follow @ problem.priors.deviation(prior.layout, done.solution.state)[held]
    start = done.solution.state.moved(prior.layout, step, done.solution.system.point_steps(step))
    state, _ = levenberg_marquardt(kept, start, std_px, factor)
    more = np.diag(stated_std[held] ** 2) - covariance[np.ix_(held, held)]
    residuals = problem.residuals(state)
    weights = huber_weights(problem, residuals, std_px) / factor
    system = system_with(kept, state, weights)
    found = Solution(state, covariance + propagated(follow, more), residuals, weights, done.solution.std_px, system)
    return replace(done, solution=found)


def roll_notes(survey: Survey, done: RobustSolution, gsd_m: float) -> list[str]:
    """Sentences on the rolls that positions leave open, and their std."""
    prior, state = done.prior, done.solution.state
    notes = []
    most = max_height_std(gsd_m)
    for roll in prior.rolls:
        # Control over an area holds all of a block: where heights are uncertain, by lens and position as by the roll.
        if spans_area(survey, roll):
            continue
        on_line = f"positions or control of {len(roll.views)} photographs lie on one line"
        if not roll.num_attitudes and not np.isfinite(done.used.point_std).all(axis=1).any():
            raise SurveyError(f"{on_line}, and neither control nor attitudes hold the roll about it: {ROLL_REMEDY}")
        std = roll.std_by(prior.layout, done.solution.covariance)
        across, below = np.median(np.abs(roll.across.flat(state.points)), axis=0).tolist()
        message = (
            f"{on_line}; the roll about it is known to "
            f"{math.degrees(std):.2g} degrees by {_sources_of_roll(survey, done, roll)}, which leaves heights "
            f"{std * across:.2g} m uncertain (at {across:.2g} m beside the line, the median) and the bed "
            f"{std * below:.2g} m sideways"
        )
        if std * across > most:
            raise SurveyError(f"{message}; heights may be {most:.2g} m uncertain: {ROLL_REMEDY}")
        notes.append(message)
    return notes


@contextmanager
def name_open_roll(rolls: Sequence[Roll]) -> Iterator[None]:
    """Name the line of a roll that positions leave open in the error of an adjustment that does not converge."""
    try:
        yield
    except NotConvergedError as error:
        if not rolls:
            raise
        num = sum(len(roll.views) for roll in rolls)
        raise NotConvergedError(
            f"positions or control of {num} photographs lie on one line, about which their roll is not known well "
            f"enough ({error}): {ROLL_REMEDY}"
        ) from error


def _sources_of_roll(survey: Survey, done: RobustSolution, roll: Roll) -> str:
    """Sources that determine a roll, in words."""
    used = done.used
    is_known = np.isfinite(used.point_std).all(axis=1)[len(used.ties) - len(used.control) :]
    control = [name for name, known in zip(used.control, is_known, strict=True) if known]
    by = [f"control ({', '.join(control)})"] if control else []
    by += [f"the attitudes of {roll.num_attitudes} photographs"] if roll.num_attitudes else []
    by += ["the level of the water"] if survey.water is not None else []
    return " and ".join(by)
