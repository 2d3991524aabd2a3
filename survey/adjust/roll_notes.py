"""Notes on the roll of a block about the line of its positions, and refusal of one that is too uncertain."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from survey.adjust.block.bundle import NotConvergedError
from survey.adjust.block.roll import Roll, spans_area
from survey.adjust.rounds import Adjusted
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.plan.recipe import max_height_std
from survey.sfm.gps_fit import HOLD_THE_ROLL


def roll_notes(survey: Survey, done: Adjusted, gsd_m: float) -> list[str]:
    """Sentences on the rolls that positions leave open, and their std.

    Raises
    ------
    SurveyError
        Where a roll leaves heights of the bed more uncertain than the quality gate allows.
    """
    known, state = done.known, done.solution.state
    notes = []
    most = max_height_std(gsd_m)
    for roll in known.rolls:
        # Control over an area holds all of a block: where heights are uncertain, by lens and position as by the roll.
        if spans_area(survey, roll):
            continue
        std = roll.std_by(known.layout, done.solution.covariance)
        beside, below = np.median(np.abs(roll.across.flat(state.points)), axis=0).tolist()
        said = (
            f"positions or control of {len(roll.views)} photographs lie on one line; the roll about it is known to "
            f"{math.degrees(std):.2g} degrees by {_held_by(survey, done, roll)}, which leaves heights "
            f"{std * beside:.2g} m uncertain (at {beside:.2g} m beside the line, the median) and the bed "
            f"{std * below:.2g} m sideways"
        )
        if std * beside > most:
            raise SurveyError(f"{said}; heights may be {most:.2g} m uncertain: {HOLD_THE_ROLL}")
        notes.append(said)
    return notes


@contextmanager
def open_roll_named(rolls: Sequence[Roll]) -> Iterator[None]:
    """Name the line where an adjustment of photographs whose roll positions leave open does not converge.

    Raises
    ------
    NotConvergedError
    """
    try:
        yield
    except NotConvergedError as error:
        if not rolls:
            raise
        num = sum(len(roll.views) for roll in rolls)
        raise NotConvergedError(
            f"positions or control of {num} photographs lie on one line, about which their roll is not known well "
            f"enough ({error}): {HOLD_THE_ROLL}"
        ) from error


def _held_by(survey: Survey, done: Adjusted, roll: Roll) -> str:
    """Sources that determine a roll, in words."""
    used = done.used
    is_known = np.isfinite(used.point_std).all(axis=1)[len(used.ties) - len(used.control) :]
    control = [name for name, known in zip(used.control, is_known, strict=True) if known]
    by = [f"control ({', '.join(control)})"] if control else []
    by += [f"the attitudes of {roll.num_attitudes} photographs"] if roll.num_attitudes else []
    by += ["the level of the water"] if survey.water is not None else []
    return " and ".join(by) if by else "the scatter of the positions alone"
