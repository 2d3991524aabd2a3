"""Sample places of the bed, and the views that have them in their frame: from poses alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fields.sweep.views import coverage
from survey.folder.survey import Survey
from survey.photos.poses import least_track
from survey.plan.area import local_area, within
from survey.plan.ground import dry_ground

# Views of a block that are looked at: its middle is then as stiff as that of a larger one, and it takes seconds.
_MOST_VIEWS = 100


@dataclass(frozen=True)
class Places:
    """Places of a level bed in the area in the frames of three views or more, of two in both."""

    seen: np.ndarray  # (V, M) bool
    cells: np.ndarray  # (M, 3) float64 [m], local

    def some(self, number: int) -> Places:
        """An evenly spaced subset."""
        every = np.linspace(0, len(self.cells) - 1, min(number, len(self.cells))).round().astype(np.int64)
        every = np.unique(every)
        return Places(self.seen[:, every], self.cells[every].copy())


def in_the_middle(survey: Survey) -> Survey:
    """The survey reduced to its central views, where it has many."""
    centres = np.array([view.camera.centre[:2] for view in survey.views])
    away = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    nearest = np.sort(np.argsort(away, kind="stable")[:_MOST_VIEWS])
    return replace(survey, views=tuple(survey.views[number] for number in nearest))


def places_of(survey: Survey, depth_m: float) -> Places | None:
    """Places of a bed at a depth [m] under the water, or of dry ground; None where too few views overlap."""
    cameras = [view.camera for view in survey.views]
    if survey.water is None:
        height = dry_ground(survey).height
    else:
        x, y = np.mean([camera.centre for camera in cameras], axis=0)[:2]
        height = float(survey.water.height(x, y)) - depth_m
    try:
        seen, cells = coverage(cameras, survey.water, height)
    except ValueError:
        return None
    use = seen.sum(axis=0) >= least_track(len(cameras))
    area = local_area(survey)
    if area is not None:
        use &= within(cells, area)
    return Places(seen[:, use], cells[use]) if use.any() else None
