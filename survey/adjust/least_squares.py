"""Least squares on tie points through the water surface: the parameters of the water, with the poses held.

Each tie point has three unknowns of its own, which are eliminated point by point (a Schur complement), so that the
reduced system has only the parameters of the water as unknowns.

    M points, N observations (a point in a photograph), P parameters of the water
    r    residual, measured minus predicted pixel (N, 2)
    Jx   derivative of the prediction by the point (N, 2, 3)
    Jp   derivative by the parameters (N, 2, P)
    Jr   Jp less what the points can follow: Jp - Jx A^-1 C, with A = sum Jx'w Jx and C = sum Jx'w Jp per point
    w    weight of an observation (N,) [1/px^2]
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from refract import FlatWater, PinholeCamera
from survey.adjust.projection import by_parameters, by_point, residuals_of
from survey.errors import SurveyError
from survey.photos.tie_points import TiePoints

# Huber's bound [standard deviations]: 95 % of good residuals lie within.
_HUBER = 2.0
# The median of the length of a two-dimensional normal deviate of unit standard deviation per axis, sqrt(2 ln 2).
_MEDIAN_LENGTH = 1.1774
_MOST_STEPS = 50
# A step under this share of the standard deviations changes no digit that is reported.
_DONE = 1e-3
# Keeps the elimination finite for a point that its rays hardly determine.
_DAMPING = 1e-9


class NotConvergedError(SurveyError):
    """An adjustment that does not converge, e.g. as points near the shoreline become wet and dry in turn."""


@dataclass(frozen=True)
class Adjusted:
    """A solution of `adjust`.

    Attributes
    ----------
    parameters : (P,)
    inverse_normal : (P, P)
        Inverse of the normal matrix of the parameters, prior included.
    covariance : (P, P)
        Of the parameters by the scatter of the measurements alone, from the scatter itself.
    points : (M, 3) [m], local
    residuals : (N, 2) [px]
    weights : (N,) [1/px^2]
    reduced : (N, 2, P)
        Jr above: how a measurement would have to move for a parameter to change, points following.
    std_px : [px]
        Standard deviation of a pixel coordinate, from the median of the residuals.
    """

    parameters: np.ndarray
    inverse_normal: np.ndarray
    covariance: np.ndarray
    points: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray
    reduced: np.ndarray
    std_px: float


def adjust(
    cameras: Sequence[PinholeCamera],
    ties: TiePoints,
    water_of: Callable[[np.ndarray], FlatWater],
    start: np.ndarray,
    prior_std: np.ndarray,
    *,
    centre: np.ndarray | None = None,
) -> Adjusted:
    """Fit the parameters of the water, and all points, to the tie points.

    Parameters
    ----------
    cameras : local, indexed by `TiePoints.view`
    ties : TiePoints
    water_of : function of (P,) parameters
        Returns the water; it is differentiated numerically.
    start, prior_std : (P,)
        Start and prior standard deviations of the parameters. The prior keeps the solution finite where the block does
        not determine them; elsewhere its weight is the square of the ratio of the standard deviations.
    centre : (P,), optional
        Mean of the prior, if it differs from the start.

    Raises
    ------
    SurveyError
        If there are no more measurements than unknowns.
    NotConvergedError
        If the adjustment does not converge.

    Notes
    -----
    Gauss-Newton steps with Huber weights; points above the water have straight rays and no derivative by the
    parameters, and their state follows the water from step to step. The covariance is the sandwich estimate with the
    observations of one point as a cluster (P. J. Huber 1967; H. White 1980): it needs no model of how they correlate.
    """
    if 2 * len(ties.view) <= 3 * len(ties) + len(start):
        raise SurveyError(
            f"{len(ties)} tie points with {len(ties.view)} measurements are too few to estimate the water; expected "
            "photographs that overlap and show a textured bed"
        )
    parameters, points = np.array(start, dtype=np.float64), ties.start.copy()
    prior = np.diag(1.0 / np.square(prior_std))
    centre = np.array(start if centre is None else centre, dtype=np.float64)
    for _ in range(_MOST_STEPS):
        system = _linearised(cameras, ties, points, water_of, parameters)
        normal = system.normal + prior
        step = np.linalg.solve(normal, system.gradient - prior @ (parameters - centre))
        # From a distant start a full step could leave the physical range.
        step /= max(1.0, float(np.max(np.abs(step) / prior_std)) * 4.0)
        parameters = parameters + step
        points = points + system.point_steps(step)
        if (np.abs(step) < _DONE * np.sqrt(np.diag(np.linalg.inv(normal)))).all():
            break
    else:
        raise NotConvergedError(
            f"the adjustment did not converge in {_MOST_STEPS} steps: the photographs hardly constrain the "
            "water, or poses and images do not belong together"
        )
    return _solution(_linearised(cameras, ties, points, water_of, parameters), ties, points, parameters, prior)


def intersect(
    cameras: Sequence[PinholeCamera], ties: TiePoints, water: FlatWater | None, steps: int = 10
) -> tuple[np.ndarray, np.ndarray]:
    """Points (M, 3) [m] where the rays of the tie points meet best through a given water, and residuals (N, 2) [px]."""
    points = ties.start.copy()
    for _ in range(steps):
        residuals = residuals_of(cameras, ties, points, water)
        jx = by_point(cameras, ties, points, water)
        weights = robust_weights(residuals)[0]
        wjx = weights[:, None, None] * jx
        normal = _sum(ties, np.einsum("nai,naj->nij", wjx, jx))
        right = _sum(ties, np.einsum("nai,na->ni", wjx, residuals))
        points = points + np.linalg.solve(_damped(normal), right[..., None])[..., 0]
    return points, residuals_of(cameras, ties, points, water)


@dataclass(frozen=True)
class _System:
    """The normal equations at one place, points eliminated."""

    residuals: np.ndarray
    weights: np.ndarray
    std_px: float
    reduced: np.ndarray
    normal: np.ndarray
    gradient: np.ndarray
    points_free: np.ndarray
    points_follow: np.ndarray

    def point_steps(self, step: np.ndarray) -> np.ndarray:
        """Steps (M, 3) [m] of the points that go with a step of the parameters."""
        return self.points_free - self.points_follow @ step


def _linearised(cameras, ties: TiePoints, points: np.ndarray, water_of, parameters: np.ndarray) -> _System:
    water = water_of(parameters)
    residuals = residuals_of(cameras, ties, points, water)
    jx = by_point(cameras, ties, points, water)
    jp = by_parameters(cameras, ties, points, water_of, parameters)
    weights, std_px = robust_weights(residuals)
    wjx = weights[:, None, None] * jx
    own = _damped(_sum(ties, np.einsum("nai,naj->nij", wjx, jx)))
    mixed = _sum(ties, np.einsum("nai,nap->nip", wjx, jp))
    right = _sum(ties, np.einsum("nai,na->ni", wjx, residuals))
    follow = np.linalg.solve(own, mixed)
    free = np.linalg.solve(own, right[..., None])[..., 0]
    reduced = jp - np.einsum("nai,nip->nap", jx, follow[ties.point])
    weighted = weights[:, None, None] * reduced
    normal = np.einsum("nap,naq->pq", weighted, reduced)
    gradient = np.einsum("nap,na->p", weighted, residuals)
    return _System(residuals, weights, std_px, reduced, normal, gradient, free, follow)


def _solution(system: _System, ties: TiePoints, points, parameters, prior) -> Adjusted:
    inverse = np.linalg.inv(system.normal + prior)
    scores = _sum(ties, np.einsum("nap,na,n->np", system.reduced, system.residuals, system.weights))
    # Fitting the points absorbed part of the scatter: residuals, and so the scores, are too small by this factor.
    spare = 2 * len(ties.view) - 3 * len(ties)
    meat = scores.T @ scores * (2 * len(ties.view) / spare) + prior
    return Adjusted(
        parameters=parameters,
        inverse_normal=inverse,
        covariance=inverse @ meat @ inverse,
        points=points,
        residuals=system.residuals,
        weights=system.weights,
        reduced=system.reduced,
        std_px=system.std_px,
    )


def robust_weights(residuals: np.ndarray) -> tuple[np.ndarray, float]:
    """Huber weights (N,) [1/px^2], and the standard deviation of a pixel coordinate [px]."""
    length = np.linalg.norm(residuals, axis=1)
    std = max(float(np.nanmedian(length)) / _MEDIAN_LENGTH, 1e-9)
    weights = np.minimum(1.0, _HUBER * std / np.maximum(length, 1e-300)) / std**2
    return np.where(np.isfinite(length), weights, 0.0), std


def _sum(ties: TiePoints, values: np.ndarray) -> np.ndarray:
    """Sums over the observations of each point, (M, ...)."""
    first = np.searchsorted(ties.point, np.arange(len(ties)))
    return np.add.reduceat(values, first, axis=0)


def _damped(normal: np.ndarray) -> np.ndarray:
    """Matrices (M, 3, 3) that can be inverted."""
    scale = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    return normal + (_DAMPING * scale + 1e-12) * np.eye(3)
