"""Focal lengths: those that differ between the photographs of one camera (autofocus, heat), and square pixels.

Image-variant interior orientation (H.-G. Maas, ISPRS Archives 32(5), 1998): each photograph has a focal length of its
own, that of its lens times 1 + c, c of a common standard deviation s. Whether they differ, and by how much, is what the
block says (`focal_std`); where it does, `with_focals` adjusts it with them.

A focal length acts as the height of its camera does, but for relief and refraction. So it is observable only with
positions known to some thousandths of the flying height; the alternative is that these are worse than stated. Both
hypotheses are compared by their marginal likelihoods, in the linear model at the adjusted block:

    -2 ln p = v' W v - b' N^-1 b + ln |N| - ln |W|

v are the deviations from the priors, W their weights; N, b the normal equations with these.

Square pixels in place of a ratio of focal lengths that a program found with straight rays through water.

The adjustment holds the ratio of both focal lengths. A program that adjusts its lens with straight rays takes some of
the bend at the water into that ratio: on the block of examples/exports.py, 20 m over 2 m of water, 0.1 %, which moved
the focal length that was found by 0.5 % and the bed by 15 cm.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from refract.lens import MODELS, Lens
from survey.adjust.block.bundle import NotConvergedError
from survey.adjust.block.normal_equations import system_with
from survey.adjust.block.priors import PriorKnowledge
from survey.adjust.block.state import LEAST_FOCALS, is_held
from survey.adjust.rounds import RobustSolution
from survey.folder.survey import Survey

# Standard deviations of focal lengths that are tried, as shares.
_STDS = np.geomspace(1e-4, 2e-2, 24)
# -2 ln p must fall by so much: strong evidence (R. E. Kass and A. E. Raftery, JASA 90, 1995).
_SIGNIFICANT = 6.0
# The standard deviation follows from the focal lengths that were found, until it changes by less than this share.
_STEADY, _MOST_ROUNDS = 0.1, 4
# Photographs that were scaled differently along their sides are further from square than any bend makes them.
_MOST_BEND = 0.01


@dataclass(frozen=True)
class FocalDrift:
    """Scatter of the focal lengths of a block."""

    std: float  # Of a focal length, as a share
    gain: float  # By how much -2 ln p falls with them

    def __str__(self) -> str:
        return (
            f"focal lengths differ between photographs by {100.0 * self.std:.2g} % (one sigma), as those of a camera "
            "with autofocus do: each photograph has its own; fix the focus for the next flight"
        )


def with_focals(
    prior: PriorKnowledge, done: RobustSolution, adjusted: Callable[[PriorKnowledge], RobustSolution]
) -> tuple[RobustSolution, FocalDrift | None]:
    """The block with a focal length for each photograph, where these differ; else, or where it has them, as it was.

    ``prior`` is what the survey says, with standard deviations of positions as stated; ``adjusted`` adjusts from it.
    """
    if prior.layout.finds_focals or len(prior.layout.lens_of) < LEAST_FOCALS or any(map(is_held, prior.lenses)):
        return done, None
    drift = focal_drift(prior, done)
    if drift is None:
        return done, None
    alone = done
    for _ in range(_MOST_ROUNDS):
        prior = with_focal_std(prior, done, drift.std)
        try:
            done = adjusted(prior)
        except NotConvergedError:
            # The adjustment does not confirm the gain that the linear model predicts.
            return alone, None
        layout, solution = done.prior.layout, done.solution
        variance = np.diag(solution.covariance)[layout.first_focal : layout.first_pose]
        before, drift = drift, replace(drift, std=float(np.sqrt(np.mean(solution.state.focals**2 + variance))))
        if abs(drift.std / before.std - 1.0) < _STEADY:
            break
    return done, drift


def focal_drift(prior: PriorKnowledge, done: RobustSolution) -> FocalDrift | None:
    """Scatter of the focal lengths that a block with one for each lens shows; None where it shows none."""
    stated = with_focal_std(prior, done, np.inf)
    layout, solution = stated.layout, done.solution
    state = replace(solution.state, focals=np.zeros(len(layout.lens_of)))
    own = np.arange(layout.first_focal, layout.first_pose)
    others = np.r_[: layout.first_focal, layout.first_pose : len(layout)]

    def reduced(by_prior: PriorKnowledge) -> tuple[np.ndarray, np.ndarray, float]:
        """Normal equations of the focal lengths with the others eliminated, and ``-2 ln p`` without these focals."""
        problem = done.used.problem(by_prior, state)
        system = system_with(problem, state, solution.weights)
        weights = by_prior.std[np.isfinite(by_prior.std)] ** -2.0
        base = problem.priors.squares(layout, state) - float(np.log(weights).sum())
        normal, right = system.normal, system.right_side
        factor, mixed = normal.only(others).factor(), normal.between(others, own)
        step = factor.solve(np.column_stack([mixed, right[others]]))
        evidence = factor.log_determinant() - float(right[others] @ step[:, -1])
        kept = normal.between(own, own) - mixed.T @ step[:, :-1], right[own] - mixed.T @ step[:, -1]
        return *kept, base + evidence

    # One focal length for each lens, positions as good as the block has them.
    as_found = np.insert(done.prior.std, layout.first_focal, np.full(len(layout.lens_of), np.inf))
    normal, right, base = reduced(stated)
    null_cost = base if np.array_equal(as_found, stated.std) else reduced(replace(stated, std=as_found))[2]
    # In the eigenbasis of the focal lengths the log-likelihood of each standard deviation is a sum.
    eigenvalues, eigenvectors = np.linalg.eigh(normal)
    eigenvalues, squares = np.maximum(eigenvalues, 0.0), np.square(eigenvectors.T @ right)
    logs = [
        np.sum(2.0 * np.log(std) + np.log(eigenvalues + std**-2.0) - squares / (eigenvalues + std**-2.0))
        for std in _STDS
    ]
    best = int(np.argmin(logs))
    gain = null_cost - (base + float(logs[best]))
    return FocalDrift(float(_STDS[best]), gain) if gain > _SIGNIFICANT else None


def with_focal_std(prior: PriorKnowledge, done: RobustSolution, std: float) -> PriorKnowledge:
    """Priors with a focal length for each photograph, starting from an adjusted block.

    Positions that were stated are as good as that, but for those that the block contradicts.
    """
    count, layout = len(prior.layout.lens_of), replace(prior.layout, finds_focals=True)
    poses = prior.pose_std.copy()
    found = done.prior.pose_std
    poses[prior.unknown_positions, :3] = found[prior.unknown_positions, :3]
    poses[prior.unknown_rotations, 3:] = found[prior.unknown_rotations, 3:]
    poses = np.where(np.isfinite(found), poses, np.inf)
    first = prior.layout.first_focal
    values = np.concatenate([prior.std[:first], np.full(count, std), poses.ravel()])
    state = done.solution.state.without_points()
    focals = state.focals if len(state.focals) else np.zeros(count)
    return replace(
        prior,
        layout=layout,
        state=replace(state, focals=focals),
        mean=replace(prior.mean, focals=np.zeros(count)),
        std=values,
    )


def with_square_pixels(survey: Survey) -> tuple[Survey, str | None]:
    """The survey with one focal length for both axes, with a note, where straight rays gave two; else unchanged."""
    tool = survey.provenance.tool
    if tool is None or survey.water is None:
        return survey, None
    square = {view.lens: _square(view.lens) for view in survey.views}
    changed = [lens for lens, other in square.items() if other != lens]
    if not changed:
        return survey, None
    views = []
    for view in survey.views:
        fx, fy = square[view.lens].focal
        views.append(replace(view, lens=square[view.lens], camera=replace(view.camera, fx=fx, fy=fy)))
    fx, fy = changed[0].focal
    note = (
        f"pixels are taken as square: {tool} found focal lengths of {fx:.2f} and {fy:.2f} px with straight "
        "rays, which water bends"
    )
    return replace(survey, views=tuple(views)), note


def _square(lens: Lens) -> Lens:
    fx, fy = lens.focal
    if fx == fy or abs(fy / fx - 1.0) > _MOST_BEND:
        return lens
    named = zip(MODELS[lens.model][1], lens.params, strict=True)
    return replace(lens, params=tuple(0.5 * (fx + fy) if name in ("fx", "fy") else value for name, value in named))
