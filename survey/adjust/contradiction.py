"""Tests of the water in survey.toml against the photographs."""

from __future__ import annotations

from dataclasses import replace

from survey.adjust.priors import HELD, Known
from survey.adjust.rounds import Adjusted
from survey.adjust.water_settings import WATER_PARAMETERS
from survey.folder.contradiction import Contradiction
from survey.folder.survey import Survey

# Beyond this many standard deviations of their difference the two cannot both be true. Where four parameters are asked
# about, one of them is beyond the latter by chance in one survey of a thousand (docs/adjustment.md).
MOST, MOST_OF_FOUR = 3.0, 3.66
# With less of its own than this share of the knowledge beforehand, a block cannot contradict it.
_LEAST_OWN = 0.02


def worst_contradiction(survey: Survey, done: Adjusted) -> Contradiction | None:
    """Of level, slopes and index the one that the block contradicts by the most standard deviations, if any.

    One that is wrong draws the others with it, so that only the worst is surely wrong: it is released, and the block
    asked again.

    Notes
    -----
    Of a value of standard deviation s from a prior of standard deviation p, the block alone has told
    ``1 / s^2 - 1 / p^2``, and its own value follows from the weighted mean.
    """
    if survey.water is None:
        return None
    worst, most = None, MOST_OF_FOUR
    if survey.water is None:
        return None
    _, water = survey.require_water()
    moved = done.solution.state.water_parameters() - done.known.mean.water_parameters()
    for number, name in enumerate(WATER_PARAMETERS):
        prior = float(done.known.std[number])
        both = float(done.solution.covariance[number, number])
        own = 1.0 / both - 1.0 / prior**2
        if prior <= 10.0 * HELD or own < _LEAST_OWN / prior**2:
            continue
        difference = float(moved[number]) / (both * own)
        each = Contradiction(name, float(getattr(water, name)), prior, difference, own**-0.5)
        if each.sigmas > most:
            worst, most = each, each.sigmas
    return worst


def released(known: Known, found: Contradiction) -> Known:
    """What is known, with the contradicted value as uncertain as it proved to be."""
    std = known.std.copy()
    std[WATER_PARAMETERS.index(found.name)] = max(abs(found.difference), found.given_std)
    return replace(known, std=std)
