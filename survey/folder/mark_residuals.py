"""Marks of control points against the places where poses and lenses of a survey show these points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from refract import FlatWater
from survey.control.points import Control
from survey.display.words import named
from survey.photos.cameras import View

# A lens of the data sheet or a pose by the receiver alone moves a point by less, as a share of the longer side.
_DOUBTFUL_SHARE = 0.02
# A single mark this many times further off than the median is of another point.
_TIMES = 10.0


def mark_residuals(control: Control, views: Sequence[View], water: FlatWater | None) -> np.ndarray:
    """Distances (marks,) [px] of the marks from their points, as seen through the water where these are wet.

    NaN where a point lies behind its camera.
    """
    by_name = {view.name: view for view in views}
    local = {point.name: point.local for point in control.points}
    found = []
    for mark in control.marks:
        view = by_name[mark.view]
        shown = view.camera.project(local[mark.point], water)
        found.append(np.linalg.norm(np.array(mark.pixel) - shown))
    return np.array(found)


def mark_doubts(control: Control, views: Sequence[View], water: FlatWater | None) -> list[str]:
    """Warnings about marks that lie far from where the poses show their points."""
    away = mark_residuals(control, views, water)
    longer = {view.name: max(view.lens.width, view.lens.height) for view in views}
    near = away <= _DOUBTFUL_SHARE * np.array([longer[mark.view] for mark in control.marks])
    middle = np.nanmedian(away) if np.isfinite(away).any() else np.inf
    if near.mean() < 0.5:
        return [
            f"the marks of control points lie {middle:.0f} px (median) from where the poses show these points; check "
            "the coordinates and heights of the points, the order x, y of the marks, that they are in pixels of these "
            "images, and the poses"
        ]
    wrong = [
        f"{mark.point} in {mark.view}"
        for mark, is_near, distance in zip(control.marks, near, away, strict=True)
        if not is_near and not distance <= _TIMES * middle
    ]
    return named(wrong, "mark", "far from where the pose shows its point, to be checked")
