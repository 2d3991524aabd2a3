"""Fixes unobservable parameters at their stated values, and adjusts the block to them.

Where neither photographs nor survey know a parameter well enough, the value that was found follows the noise of the
block. With C the covariance of the block with all parameters free, U those that are held, and S the covariance of what
was given of them, the others follow them by ``G = C[:, U] C[U, U]^-1``, and the covariance of the block is
``C + G (S - C[U, U]) G^T``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from survey.adjust.adjustment import UNKNOWN, Parameter
from survey.adjust.priors import HELD
from survey.adjust.rounds import Adjusted, adjust
from survey.adjust.state import LENS_NAMES, RATE_NAME, READOUT_NAME, Layout
from survey.adjust.water_settings import WATER_PARAMETERS


def not_observable(parameters: Sequence[Parameter], layout: Layout) -> np.ndarray:
    """Which parameters of the vector (P,) bool have the verdict that they are not observable."""
    held = np.zeros(len(layout), dtype=bool)
    for row in parameters:
        if row.status == UNKNOWN:
            held[_place(row.name, layout)] = True
    return held


def _place(name: str, layout: Layout) -> int:
    if name in WATER_PARAMETERS:
        return WATER_PARAMETERS.index(name)
    if name == RATE_NAME:
        return layout.first_rate
    camera, parameter = name.split(".")
    number = int(camera.removeprefix("camera"))
    if parameter == READOUT_NAME:
        return layout.first_readout + number
    return layout.lens(number).start + LENS_NAMES.index(parameter)


def adjusted_with(done: Adjusted, held: np.ndarray, stated_std: np.ndarray, sizes, marks_std_px: float) -> Adjusted:
    """The block with parameters (P,) bool held at their given values.

    Parameters
    ----------
    done : Adjusted
        With all parameters free.
    held : (P,) bool
    stated_std : (P,)
        Of the given values.
    sizes, marks_std_px
        As for `survey.adjust.rounds.adjust`.

    Raises
    ------
    NotConvergedError
        If the adjustment does not converge.
    """
    known, covariance = done.known, done.solution.covariance
    kept = replace(
        known,
        state=done.solution.state.moved(known.layout, *_step(done, held)),
        std=np.where(held, HELD * known.std, known.std),
    )
    again = adjust(kept, done.used.at(kept.state.points), sizes, marks_std_px)
    follow = covariance[:, held] @ np.linalg.inv(covariance[np.ix_(held, held)])
    more = np.diag(stated_std[held] ** 2) - covariance[np.ix_(held, held)]
    solution = replace(again.solution, covariance=covariance + follow @ more @ follow.T)
    blunders = done.blunders | again.blunders
    return replace(again, known=replace(again.known, std=known.std), solution=solution, blunders=blunders)


def _step(done: Adjusted, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps of parameters and points to where the held ones have their given values and the others follow."""
    layout, state, covariance = done.known.layout, done.solution.state, done.solution.covariance
    water = done.known.mean.water_parameters() - state.water_parameters()
    lenses = (done.known.mean.lenses - state.lenses).ravel()
    back = np.zeros(len(layout))
    back[: len(water)], back[layout.first_lens : layout.first_readout] = water, lenses
    if layout.finds_readouts:
        back[layout.first_readout : layout.first_rate] = done.known.mean.readouts - state.readouts
    back[layout.first_rate : layout.first_pose] = done.known.mean.rate - state.rate
    step = covariance[:, held] @ np.linalg.solve(covariance[np.ix_(held, held)], back[held])
    return step, done.solution.system.point_steps(step)
