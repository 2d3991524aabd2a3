"""How wide windows have to be: by what photographs have in common, against what chance gives.

Windows that have nothing in common score with a standard deviation of one over their side; windows that show the same
place score the share that its texture has of the variance, whatever their size. So noise, and light that moves from
photograph to photograph, ask for wider windows, and quiet images for none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from fields.sweep.backends import images
from fields.sweep.climbing import Found, climbing_view
from fields.sweep.in_turn import Job, alone
from fields.sweep.stack import ViewStack

# The score of the right height is to be so many standard deviations above the best that chance gives among all that are
# tried, in half of the pixels of a view.
_ABOVE_CHANCE = 2.0
# Of photographs with masked or white pixels, windows of which such a share is seen by both are compared.
LEAST_KNOWN = 0.5
# Radii [px]: others would need other kernels, and wider windows flatten more relief than they find.
RADII = (1, 2, 3, 4, 6, 8)
# Of the shorter side of an image: beyond it the rim without whole windows is a large part of the image.
_MOST_OF_SIDE = 0.25
# Images of which less is known keep their windows: between sparkles wider ones hold less of the bed.
_WHOLE = 0.9


def climb_widely_enough(
    stack: ViewStack,
    view: int,
    others: list[int],
    start: np.ndarray,
    step: float,
    rungs: int,
    radius: int,
    columns: Callable[[int], np.ndarray | None] = lambda radius: None,
    least_known: float = 1.0,
) -> tuple[Found, int]:
    """What `fields.sweep.climbing.climb_view` finds with windows of a radius [px] or as wide as needed, and the radius.

    ``columns`` says which are wanted for a radius.
    """
    beside = images(stack.device)
    start = beside.placed(stack.device, start)
    job = climbing_widely_enough(stack, view, others, start, step, rungs, radius, columns, least_known)
    (height, score, curvature), radius = alone(stack.device, job)
    return (beside.fetched(height), beside.fetched(score), beside.fetched(curvature)), radius


def climbing_widely_enough(
    stack: ViewStack,
    view: int,
    others: list[int],
    start: Any,
    step: float,
    rungs: int,
    radius: int,
    columns: Callable[[int], np.ndarray | None] = lambda radius: None,
    least_known: float = 1.0,
) -> Job[tuple[Found, int]]:
    """`climb_widely_enough` as a job."""

    def climbed(radius: int) -> Job[Found]:
        return climbing_view(stack, view, others, start, step, rungs, radius, columns(radius), least_known)

    found = yield from climbed(radius)
    if np.isfinite(stack.images[view]).mean() < _WHOLE:
        return found, radius
    while (wider := _wider(stack, found[1], radius, rungs)) != radius:
        found, radius = (yield from climbed(wider)), wider
    return found, radius


def _wider(stack: ViewStack, score: Any, radius: int, rungs: int) -> int:
    """`radius_for` what a view scored, (height, width)."""
    matched = images(stack.device).median_above(score, -1.0)
    return radius if matched is None else radius_for(matched, score.shape, radius, rungs)


def radius_for(score: float, shape: tuple[int, int], radius: int, rungs: int) -> int:
    """Radius [px] that windows need whose median score is so, of those of a radius; the same if that is enough.

    Among wrong heights the best scores high too, the more the narrower the window: the radius that this gives may not
    be enough yet. ``shape`` (height, width) is that of the image.
    """
    side = (_ABOVE_CHANCE + np.sqrt(2.0 * np.log(rungs))) / max(score, 1e-3)
    fitting = [each for each in RADII if 2 * each + 1 <= _MOST_OF_SIDE * min(shape)] or [radius]
    return max(radius, next((each for each in fitting if each >= round(0.5 * (side - 1.0))), fitting[-1]))
