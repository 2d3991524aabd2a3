"""Adjustment of a survey without prior knowledge of its water.

What the photographs cannot tell of it is held: the worst parameter first, and the others adjusted again. Without the
level nothing is observable, and the block is adjusted under the given water.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from survey.adjust.bundle import NotConvergedError
from survey.adjust.observed import Observed
from survey.adjust.priors import FREE_WATER, HELD, Known
from survey.adjust.rounds import Adjusted, adjust
from survey.adjust.state import WATER, State
from survey.adjust.verdicts import water_limits
from survey.adjust.water_settings import WATER_PARAMETERS, settings_by_local
from survey.folder.survey import Survey
from survey.photos.tie_points import TiePoints

# Fewest tie points under water. The covariance is estimated from the scatter of N points, to one part in sqrt(2 N): an
# eighth. Fewer also turn wet and dry as the level moves, and the adjustment oscillates.
FEWEST_WET = 30
# Held with this standard deviation, slopes and index: the index of natural water is known this well without
# measurement, and so are the slopes of water seen on site.
_HELD_STD = np.array([HELD, 1e-3, 1e-3, 3e-3])


@dataclass(frozen=True)
class Lost:
    """Why a parameter of the water is not observable, and its standard deviation before it was held."""

    std: float
    reason: str


def adjust_free(
    survey: Survey, known: Known, seen: Observed, sizes, marks_std_px: float
) -> tuple[Adjusted, dict[str, Lost]]:
    """Adjust a block with free water (`known`), and say by name what of it is not observable.

    Raises
    ------
    NotConvergedError
        If the adjustment does not converge with the water held either.
    """

    def under_given_water(lost: dict[str, Lost]) -> tuple[Adjusted, dict[str, Lost]]:
        return adjust(_held(known, np.arange(WATER), HELD), seen, sizes, marks_std_px), lost

    few = _too_few(replace(known.state, points=seen.ties.start))
    if few is not None:
        return under_given_water(all_lost(few))
    try:
        done = adjust(known, seen, sizes, marks_std_px)
    except NotConvergedError as error:
        return under_given_water(all_lost(str(error)))
    few = _too_few(done.solution.state)
    if few is not None:
        return under_given_water(all_lost(few))
    limits = water_limits(done.solution.state.points)
    first = std = water_std(survey, done)
    lost: dict[str, Lost] = {}
    for _ in WATER_PARAMETERS:
        ratio = np.array([0.0 if name in lost else std[i] / limits[i] for i, name in enumerate(WATER_PARAMETERS)])
        if not ratio[0] <= 1.0:
            return under_given_water(_without_level(first, limits))
        worst = int(np.argmax(ratio))
        if ratio[worst] <= 1.0:
            break
        lost[WATER_PARAMETERS[worst]] = Lost(float(first[worst]), _too_uncertain(worst, first[worst], limits[worst]))
        known = _held(done.known, np.array([worst]), _HELD_STD[worst])
        known = replace(known, state=replace(done.solution.state, points=np.zeros((0, 3))))
        done = adjust(known, done.used, sizes, marks_std_px)
        std = water_std(survey, done)
    return done, lost


def all_lost(reason: str) -> dict[str, Lost]:
    """Nothing is observable, for a reason that is said once, with the level."""
    reasons = (reason, *["the level is not"] * (WATER - 1))
    return {name: Lost(float(std), text) for name, std, text in zip(WATER_PARAMETERS, FREE_WATER, reasons, strict=True)}


def within_bounds(survey: Survey, ties: TiePoints) -> TiePoints:
    """The tie points inside the bounds of a survey, without a margin.

    Their places are known to centimetres, and beyond the bounds there may be other water: a pond, a weir.
    """
    inside = _inside(survey, ties)
    return ties if inside is None else ties.only(inside[ties.point])


def dry_or_within_bounds(survey: Survey, ties: TiePoints) -> TiePoints:
    """Without the points under water beyond the bounds; the dry ones there hold the poses and tell nothing of water."""
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


def _held(known: Known, numbers: np.ndarray, std: float) -> Known:
    """With parameters of the water held about their given values."""
    held = known.std.copy()
    held[numbers] = std
    return replace(known, std=held)


def _too_few(state: State) -> str | None:
    assert state.water is not None
    num_wet = int((state.water.depth(state.points) > 0.0).sum())
    if num_wet >= FEWEST_WET:
        return None
    return f"{num_wet} of {len(state.points)} tie points lie under water, expected at least {FEWEST_WET}"


def water_std(survey: Survey, done: Adjusted) -> np.ndarray:
    """Standard deviations (4,) of level, slopes and index as survey.toml counts them."""
    water = done.known.mean.water
    assert water is not None
    by_local = settings_by_local(survey, np.array(water.point[:2]))
    return np.sqrt(np.diag(by_local @ done.solution.covariance[:WATER, :WATER] @ by_local.T))


def _without_level(std: np.ndarray, limits: np.ndarray) -> dict[str, Lost]:
    lost = {}
    for i, name in enumerate(WATER_PARAMETERS):
        reason = _too_uncertain(i, std[i], limits[i])
        if std[i] <= limits[i]:
            # What it seems to be depends on where the level is kept.
            reason = f"the level is not, and {name} cannot be separated from it"
        lost[name] = Lost(float(std[i]), reason)
    return lost


def _too_uncertain(number: int, std: float, limit: float) -> str:
    unit = " m" if number == 0 else ""
    return f"1 sigma is {std:.2g}{unit}, at most {limit:.2g}{unit} would be of use"
