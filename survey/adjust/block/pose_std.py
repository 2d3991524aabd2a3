"""Accuracy of given poses as estimated from the block, and outliers among them.

The adjusted pose keeps a part of the error of the given one; the rest is its residual. With p the standard deviation
that a coordinate was given with and s that after the adjustment, this part of a residual is ``r = 1 - s^2 / p^2``, its
redundancy. Of poses whose standard deviation nobody states, that of a kind is such that the residuals over
``p sqrt(r)`` have unit variance. Where it changes, so do the residuals, which follow from the normal equations: this
goes on until nothing changes (variance components, R. Koch, Parameter Estimation and Hypothesis Testing, 1999).

A variance from few residuals is uncertain itself. An error over the root of a variance estimated from n residuals
follows Student's distribution of n degrees of freedom, whose variance is about ``(n + 2) / n``: this factor is applied.
"""

from dataclasses import replace

import numpy as np

from evaluation.summary import std_by_median
from survey.adjust.block.bundle import Solution
from survey.adjust.block.normal_matrix import NormalMatrix
from survey.adjust.block.priors import ROTATION_STD, PriorKnowledge, without_shifts
from survey.adjust.block.problem import Priors
from survey.adjust.block.state import NUM_POSE

# A pose is a blunder beyond this many standard deviations, and a position that was left out counts again within these:
# between the two it is neither.
_BLUNDER, _AGREES = 6.0, 3.0
# Positions that fit worse than stated by more than this factor are taken for as good as they fit.
_OVERSTATED = 1.5
# With fewer poses nothing tells how good they are.
_FEWEST = 4
# Groups of pose coordinates with a variance component each: position in plan, height, tilt, heading of the camera.
_KINDS = ((0, 1), (2,), (3, 4), (5,))
# Residuals of more standard deviations count as that many; of normal deviates the mean square is then this.
_MOST, _MEAN_SQUARE = 2.5, 0.9776
# Standard deviations are found anew until they change by less than this share.
_STEADY, _MOST_STEPS = 0.03, 12
_LEAST_REDUNDANCY = 1e-3
# In metres and radians; less is nothing beside what photographs tell.
_LEAST = 1e-6
# What is changed by less needs no other adjustment.
_CHANGED = 0.1


def reestimate_pose_std(
    prior: PriorKnowledge, solution: Solution, blunders: np.ndarray
) -> tuple[PriorKnowledge, np.ndarray]:
    """Estimate standard deviations of poses, where the block determines them, and find blunders.

    The prior is the same object where nothing changed; else the block is to be adjusted again. Blunders (V, 2) bool are
    the positions and rotations that the block contradicts, with those found before; positions count for nothing then.
    """
    std = prior.pose_std
    used = np.isfinite(std[:, :3]).all(axis=1)
    if used.sum() < _FEWEST:
        return prior, blunders
    positions = prior.unknown_positions & used
    positions &= positions.sum() >= _FEWEST
    # (V, 6): the coordinates whose standard deviation is estimated.
    estimated = np.column_stack([*[positions] * 3, *[prior.unknown_rotations & ~blunders[:, 1]] * 3])
    found, scaled = _components(prior, solution, estimated)
    scale = _scale(scaled[used])
    bad = np.column_stack(
        [
            used & (scaled[:, :3].max(axis=1) > _BLUNDER * np.maximum(1.0, scale[:3].max())),
            estimated[:, 3:].any(axis=1) & (scaled[:, 3:].max(axis=1) > _BLUNDER),
        ]
    )
    changed = np.where(estimated, found, std)
    changed[bad[:, 0], :3] = np.inf
    changed[bad[:, 1], 3:] = ROTATION_STD
    stated = used & ~bad[:, 0] & ~prior.unknown_positions
    # A blunder bends the block away from other positions too: these are judged once it is left out.
    if stated.any() and not bad.any():
        factor = _scale(scaled[stated, :3])
        if (factor > _OVERSTATED).any():
            changed[stated, :3] = std[stated, :3] * np.maximum(factor, 1.0)
    with np.errstate(invalid="ignore"):
        if not bad.any() and not (np.abs(changed / std - 1.0) > _CHANGED).any():
            return prior, blunders
    all_std = prior.std.copy()
    all_std[prior.layout.first_pose :] = changed.ravel()
    return replace(prior, std=all_std), blunders | bad


def positions_left_out(prior: PriorKnowledge) -> np.ndarray:
    """Positions (V,) bool that are given and count for nothing."""
    std = prior.pose_std[:, :3]
    return np.isfinite(prior.given_std).all(axis=1) & ~np.isfinite(std).all(axis=1)


def agreeing_positions(prior: PriorKnowledge, solution: Solution) -> np.ndarray:
    """Positions (V,) bool that are left out and agree with the adjusted block all the same.

    What left them out was another block: that of structure from motion, on straight rays and with another lens, or one
    with other errors in it.
    """
    std = prior.pose_std[:, :3]
    used, left_out = np.isfinite(std).all(axis=1), positions_left_out(prior)
    if used.sum() < _FEWEST or not left_out.any():
        return np.zeros(len(used), dtype=bool)
    off = solution.state.centres - prior.mean.centres
    off -= np.median(off[used], axis=0)
    for shift in prior.shifts:
        off[shift.views] -= np.median(off[shift.views], axis=0)
    variance = _of_poses(prior, np.diag(solution.covariance))[:, :3]
    return left_out & (np.abs(off) < _AGREES * np.sqrt(_own_std(prior) ** 2 + variance)).all(axis=1)


def with_positions(prior: PriorKnowledge, again: np.ndarray) -> PriorKnowledge:
    """The prior in which positions (V,) bool count as the others do."""
    std = prior.std.copy()
    poses = std[prior.layout.first_pose :].reshape(-1, NUM_POSE)
    poses[again, :3] = _own_std(prior)[again]
    return replace(prior, std=std)


def _own_std(prior: PriorKnowledge) -> np.ndarray:
    """Standard deviations (V, 3) [m] of positions: as given, or, where it is not, as others proved to be."""
    std = prior.pose_std[:, :3]
    alike = np.isfinite(std).all(axis=1) & prior.unknown_positions
    found = np.median(std[alike], axis=0) if alike.any() else prior.given_std
    return np.where(prior.unknown_positions[:, None], found, prior.given_std)


def _components(prior: PriorKnowledge, solution: Solution, estimated: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Variance components: standard deviations (V, 6) of poses, and their normalised residuals."""
    deviation = Priors(prior.mean, prior.std, np.empty((0, 3))).deviation(prior.layout, solution.state)
    first, std = prior.std**-2.0, prior.pose_std.copy()
    kinds = [estimated & np.isin(np.arange(NUM_POSE), kind) for kind in _KINDS]
    kinds = [kind for kind in kinds if kind.any()]
    miss, normal = deviation, solution.system.normal
    for step in range(_MOST_STEPS + 1):
        residual, variance = _without_shifts(prior, std, _of_poses(prior, miss), normal)
        redundancy = np.clip(1.0 - variance / std**2, _LEAST_REDUNDANCY, 1.0)
        scaled = np.abs(residual) / (std * np.sqrt(redundancy))
        factors = [_scale_of(scaled[kind], redundancy[kind]) for kind in kinds]
        if step == _MOST_STEPS or all(abs(factor - 1.0) < _STEADY for factor in factors):
            break
        for kind, scale in zip(kinds, factors, strict=True):
            std[kind] = np.maximum(scale * std[kind], _LEAST)
        precision = first.copy()
        precision[prior.layout.first_pose :] = std.ravel() ** -2.0
        normal, change = solution.system.normal.with_precision(precision - first), (precision - first) * deviation
        if prior.shifts:
            before, after = (without_shifts(prior, each) for each in (first, precision))
            normal = normal.with_rows(np.vstack([before, after]), np.repeat([1.0, -1.0], len(before)))
            change += before.T @ (before @ deviation) - after.T @ (after @ deviation)
        miss = deviation - normal.factor().solve(change)
    for kind in kinds:
        freedom = float(redundancy[kind].sum())
        std[kind] *= np.sqrt((freedom + 2.0) / freedom)
    return std, scaled


def _without_shifts(
    prior: PriorKnowledge, std: np.ndarray, residual: np.ndarray, normal: NormalMatrix
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (V, 6) of poses and their variances after the adjustment, without the shifts that positions share.

    A shift is the mean of its residuals d by weights w, ``v'd`` with ``v = w / (sum w + 1 / s^2)``; of ``d - v'd``
    the variances are ``C_ii - 2 (C v)_i + v' C v``.
    """
    residual, variance = residual.copy(), _of_poses(prior, normal.inverse_diagonal()).copy()
    for shift in prior.shifts:
        # Without any that are stated the iteration ends near zero where the shift is all that positions are off by.
        if shift.views.all() and prior.unknown_positions.any():
            continue
        own = np.flatnonzero(shift.views)
        for axis in range(3):
            at = prior.layout.first_pose + axis + NUM_POSE * own
            weight = std[own, axis] ** -2.0
            weight = weight / (weight.sum() + shift.std[axis] ** -2.0)
            of_all = np.zeros(len(prior.std))
            of_all[at] = weight
            of_shift = normal.factor().solve(of_all)[at]
            residual[own, axis] -= weight @ residual[own, axis]
            variance[own, axis] += weight @ of_shift - 2.0 * of_shift
    return residual, variance


def _scale_of(scaled: np.ndarray, redundancy: np.ndarray) -> float:
    """Robust scale of normalised residuals, weighted by redundancy."""
    squares = np.minimum(scaled, _MOST) ** 2
    return float(np.sqrt(np.sum(redundancy * squares) / (_MEAN_SQUARE * np.sum(redundancy))))


def _of_poses(prior: PriorKnowledge, values: np.ndarray) -> np.ndarray:
    """Values (V, 6) of the poses out of those (P,) of all parameters."""
    return values[prior.layout.first_pose :].reshape(-1, NUM_POSE)


def _scale(scaled: np.ndarray) -> np.ndarray:
    """Robust standard deviation per coordinate of residuals, in units of the expected one."""
    return np.maximum(std_by_median(scaled, axis=0), 1e-3)
