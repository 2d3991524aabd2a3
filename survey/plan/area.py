"""Search volume of a survey: the area in plan, and the range of heights over a plane."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np

from survey.plan.ground import dry_ground
from survey.plan.heights import height_range

if TYPE_CHECKING:
    from geo.frames import LocalFrame
    from survey.folder.survey import Survey

# The cloud ends this far beyond the area, so that heights at its border have points on all sides.
AREA_MARGIN_M = 0.5


def plane_name(survey: Survey) -> str:
    """The reference of heights, in words."""
    return "water" if survey.water is not None else "local origin"


def limits(survey: Survey) -> tuple[float, float]:
    """Heights [m] over the water plane (dry: over local z = 0) between which the bed is searched."""
    if survey.water is None:
        flying = float(np.median([view.camera.centre[2] for view in survey.views])) - dry_ground(survey).height
    else:
        flying = float(np.median([-survey.water.depth(v.camera.centre) for v in survey.views]))
    found = height_range(survey, flying)
    return found.low, found.high


class Placed(Protocol):
    """What has a place on the map: a survey, or the flight of a run."""

    @property
    def frame(self) -> LocalFrame: ...

    @property
    def bounds(self) -> tuple[float, float, float, float] | None: ...


def local_area(survey: Placed) -> tuple[float, float, float, float] | None:
    """The bounds of the survey as (x0, y0, x1, y1) [m], local, that hold them; None where it has none."""
    if survey.bounds is None:
        return None
    e0, n0, e1, n1 = survey.bounds
    level = survey.frame.origin[2]
    corners = survey.frame.local_from_crs([[e0, n0, level], [e1, n0, level], [e1, n1, level], [e0, n1, level]])
    return (*corners[:, :2].min(axis=0), *corners[:, :2].max(axis=0))


def beyond_bounds(survey: Placed) -> float:
    """How far the cloud may reach beyond the bounds [m]: the margin, and what the map is turned against local."""
    area = local_area(survey)
    if survey.bounds is None or area is None:
        return 0.0
    e0, n0, e1, n1 = survey.bounds
    level = survey.frame.origin[2]
    ring = survey.frame.local_from_crs([[e0, n0, level], [e1, n0, level], [e1, n1, level], [e0, n1, level]])[:, :2]
    along = np.roll(ring, -1, axis=0) - ring
    outwards = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    x0, y0, x1, y1 = grown(area, AREA_MARGIN_M)
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return float(((corners[:, None] - ring) * outwards).sum(axis=2).max())


def grown(area: tuple[float, float, float, float], margin: float) -> tuple[float, float, float, float]:
    """An area (x0, y0, x1, y1) [m] with a margin [m] on every side."""
    return (area[0] - margin, area[1] - margin, area[2] + margin, area[3] + margin)


def within(xyz: np.ndarray, area: tuple[float, float, float, float]) -> np.ndarray:
    """Which points (N, 3) stand over an area (x0, y0, x1, y1), (N,) bool."""
    return (xyz[:, 0] >= area[0]) & (xyz[:, 1] >= area[1]) & (xyz[:, 0] <= area[2]) & (xyz[:, 1] <= area[3])
