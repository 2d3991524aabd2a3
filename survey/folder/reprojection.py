"""Reprojection error of another program's tie points under its poses, as read here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from survey.photos.cameras import View
from survey.photos.poses import FileTies


@dataclass(frozen=True)
class Reprojection:
    """Distances [px] in the image between where tie points were seen and where straight rays put them."""

    # rms_px, median_px: Root mean square and median distance
    rms_px: float
    median_px: float
    # num_points, num_images, num_seen: Points, photographs, and places of points in photographs
    num_points: int
    num_images: int
    num_seen: int
    num_lost: int  # Places that do not count: behind their camera, or beyond the reach of its lens

    def __str__(self) -> str:
        lost = f", {self.num_lost} more behind the cameras or beyond their lenses" if self.num_lost else ""
        return (
            f"{self.rms_px:.2f} px rms, {self.median_px:.2f} px median: reprojection on straight rays, "
            f"{self.num_seen} image points of {self.num_points} points in {self.num_images} images{lost}"
        )


def reprojection(ties: FileTies, points: np.ndarray, views: Mapping[str, View]) -> Reprojection | None:
    """See `Reprojection`; None where the file has no places of its points in these photographs.

    Parameters
    ----------
    ties : FileTies
    points : (N, 3) [m], local
        Those of the ties.
    views : by the name that the file has
    """
    squares, seen_points, num_images, lost = [], [], 0, 0
    order = np.argsort(ties.image, kind="stable")
    starts = np.searchsorted(ties.image[order], np.arange(len(ties.names) + 1))
    for number, name in enumerate(ties.names):
        mine = order[starts[number] : starts[number + 1]]
        if name not in views or not len(mine):
            continue
        missed = views[name].camera.project(points[ties.point[mine]], None) - ties.pixel[mine]
        square = (missed**2).sum(axis=1)
        known = np.isfinite(square)
        squares.append(square[known])
        seen_points.append(ties.point[mine][known])
        lost += int((~known).sum())
        num_images += 1
    if not squares or not sum(map(len, squares)):
        return None
    every = np.concatenate(squares)
    num_points = len(np.unique(np.concatenate(seen_points)))
    rms, median = (float(np.sqrt(value)) for value in (every.mean(), np.median(every)))
    return Reprojection(rms, median, num_points, num_images, len(every), lost)
