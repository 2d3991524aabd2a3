"""Effect of the errors of water, lens and poses on the mean height of a cloud.

Matching errors differ from point to point and average out; an error of the water level does not. The rays of the views
that show a place meet where

    sum over views of |observed pixel - predicted pixel(place, parameters)|^2   is least,

so that the place moves by ``-(A' A)^-1 A' B`` times a small change of the parameters, A and B the derivatives of the
predictions by the place and by the parameters. With the covariance of the parameters this gives that of the heights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from refract import FlatWater
from survey.adjust.adjustment import Adjustment
from survey.adjust.observed import rows_taken
from survey.adjust.prediction import linearise
from survey.adjust.priors import parameters_of
from survey.adjust.state import RELIEF, WATER, Layout, State
from survey.photos.tie_points import TiePoints

# The standard deviation of a mean over this many places, spread over the area, is that over all to a few per cent.
_PLACES = 50
# The cloud has each place from several views, of which these are enough for an average geometry.
_VIEWS = 6
# Squares along the longer side of the area, from each of which one place at most is taken.
_SQUARES = 12


@dataclass(frozen=True)
class CommonError:
    """Standard deviation of the height by water, lens and poses [m].

    Attributes
    ----------
    mean : float
        Of the mean height over the area: by so much the whole cloud may be too high or too low.
    typical : float
        Median over the places of the standard deviation of the height there.
    num_places : int
    """

    mean: float
    typical: float
    num_places: int


def common_error(found: Adjustment, water: FlatWater | None) -> CommonError | None:
    """How well the heights over an adjusted block are known, but for errors of single points; None without points.

    Parameters
    ----------
    found : Adjustment
    water : FlatWater or None
        Local, as it was found.
    """
    moves = moves_over_area(found, water)
    if not len(moves):
        return None
    by_place = np.einsum("ki,ij,kj->k", moves, found.covariance, moves)
    whole = moves.mean(axis=0)
    return CommonError(
        mean=math.sqrt(max(float(whole @ found.covariance @ whole), 0.0)),
        typical=float(np.median(np.sqrt(np.maximum(by_place, 0.0)))),
        num_places=len(moves),
    )


def moves_over_area(found: Adjustment, water: FlatWater | None) -> np.ndarray:
    """Derivative (K, P) of the heights of points spread over the area, by the parameters of the covariance."""
    ties = _places(found)
    return height_moves(found, water, ties) if len(ties) else np.zeros((0, len(found.covariance)))


def height_moves(found: Adjustment, water: FlatWater | None, ties: TiePoints) -> np.ndarray:
    """Derivative (K, P) of the heights of places by the parameters of `Adjustment.covariance`."""
    return place_moves(found, water, ties)[:, 2]


def place_moves(found: Adjustment, water: FlatWater | None, ties: TiePoints) -> np.ndarray:
    """Derivative (K, 3, P) of places, local, by the parameters of `Adjustment.covariance`."""
    layout = found.layout
    if water is not None:
        x, y = found.water_point
        water = replace(water, point=(x, y, float(water.height(x, y))))
    lenses = np.array([parameters_of(lens) for lens in found.lenses])
    readouts = np.array(found.readouts_s or ())
    state = State(water, np.zeros(RELIEF), lenses, found.centres, found.rotations, ties.start, readouts)
    return moves_of(layout, state, ties, rows_taken(ties, found.lenses, found.lens_of))


def moves_of(layout: Layout, state: State, ties: TiePoints, rows: np.ndarray) -> np.ndarray:
    """Derivative (K, 3, P) of places, those of the state, by water, lenses and poses.

    ``rows`` (N,) as `survey.adjust.observed.rows_taken` gives them.
    """
    linear = linearise(layout, state, ties, np.zeros((len(ties.view), RELIEF)), rows)
    kept = np.r_[:WATER, layout.first_lens : len(layout)]
    by_parameters = linear.by_parameters.toarray()[:, kept].reshape(len(ties.view), 2, len(kept))
    moves = np.empty((len(ties), 3, len(kept)))
    for number in range(len(ties)):
        mine = ties.point == number
        by_point = linear.by_point[mine].reshape(-1, 3)
        moves[number] = -(np.linalg.pinv(by_point) @ by_parameters[mine].reshape(len(by_point), -1))
    return moves


def _places(found: Adjustment) -> TiePoints:
    """Points of the adjustment spread over the area, each with some of the views that show it."""
    first = np.searchsorted(found.residual_point, np.arange(len(found.points) + 1))
    seen = np.diff(first)
    enough = np.flatnonzero(seen >= 3)
    if not len(enough):
        return TiePoints(np.empty((0, 3)), *(np.empty(0, dtype=np.int64),) * 2, np.empty((0, 2)))
    plan = found.points[enough, :2]
    side = max(float(np.ptp(plan, axis=0).max()), 1e-9) / _SQUARES
    # Of each square the point that most views show.
    order = np.argsort(-seen[enough], kind="stable")
    _, one = np.unique(np.floor((plan[order] - plan.min(axis=0)) / side), axis=0, return_index=True)
    chosen = np.sort(enough[order[one]])
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, _PLACES).round().astype(np.int64))]
    rows = [first[k] + np.linspace(0, seen[k] - 1, min(seen[k], _VIEWS)).round().astype(np.int64) for k in chosen]
    at = np.concatenate(rows)
    point = np.repeat(np.arange(len(chosen)), [len(row) for row in rows])
    return TiePoints(found.points[chosen], point, found.residual_view[at], found.residual_at_px[at])
