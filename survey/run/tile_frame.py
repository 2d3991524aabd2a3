"""Local frames of tiles: of a survey larger than a kilometre each tile has one that touches the Earth in its middle.

float32 holds a place to a millimetre 10 km from the origin of a frame, and level ground there lies 7.8 m below its
z = 0 and tilts by 1.6 mm a metre. In a frame of its own a tile is as near to the origin as a small survey is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from geo.frames import LocalFrame
from refract import FlatWater
from survey.plan.area import within

if TYPE_CHECKING:
    from geo.similarity import Similarity
    from survey.folder.survey import Survey
    from survey.plan.tiling import Area, Tiling
    from survey.water.surface import Departure

# A survey that reaches further from its origin along x or y is larger than a kilometre [m].
_FAR_M = 500.0
# Heights of the bed that a rectangle in another frame has to hold [m]: over so much the axes part by 0.2 m at 10 km.
_HEIGHTS_M = (-60.0, 60.0)


def has_frames(tiling: Tiling) -> bool:
    """Whether the tiles of a survey have local frames of their own."""
    return max(map(abs, (*tiling.x, *tiling.y))) > _FAR_M


def frame_of_tile(frame: LocalFrame, tiling: Tiling, number: int) -> LocalFrame:
    """Local frame in the middle of a tile, at the height in crs of the origin of the frame of the survey."""
    x0, y0, x1, y1 = tiling.ground(number, 0.0)
    east, north, _ = frame.crs_from_local(np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0])).tolist()
    return LocalFrame(frame.crs, (east, north, frame.origin[2]))


def survey_in_frame(survey: Survey, frame: LocalFrame, ground: Area) -> Survey:
    """Survey in another local frame, with the views and matched points over some ground (of the old one) alone.

    Cameras, water and points are moved; what else was measured (ties, control) stays, and no tile uses it.
    """
    moved = frame.from_frame(survey.frame)
    here = [view for view in survey.views if within(view.camera.centre[None], ground)[0]] or survey.views
    views = tuple(replace(view, camera=view.camera.in_frame(moved.rotation, moved.shift)) for view in here)
    observations, water = survey.observations, survey.water
    if observations.points is not None:
        points = observations.points[within(observations.points, ground)]
        observations = replace(observations, points=moved(points))
    if water is not None:
        plane = plane_in_frame(water, moved)
        departure = observations.departure
        if departure is not None:
            departure = _departure_in_frame(departure, water, plane, moved)
        observations, water = replace(observations, departure=departure), plane
    return replace(survey, frame=frame, views=views, water=water, observations=observations)


def plane_in_frame(water: FlatWater, moved: Similarity) -> FlatWater:
    """The same plane in another frame."""
    x, y, z = moved(np.array(water.point)).tolist()
    up = moved.rotation @ np.array(water.up)
    return replace(water, point=(x, y, z), slope_x=float(-up[0] / up[2]), slope_y=float(-up[1] / up[2]))


def _departure_in_frame(departure: Departure, water: FlatWater, plane: FlatWater, moved: Similarity) -> Departure:
    x, y, over = departure.points.T
    points = moved(np.column_stack([x, y, water.height(x, y) + over]))
    points[:, 2] -= plane.height(points[:, 0], points[:, 1])
    return type(departure)(points, departure.stds)


def area_in_frame(area: Area, moved: Similarity) -> Area:
    """The rectangle in another frame that holds a rectangle (x0, y0, x1, y1) [m], whatever the height of the bed.

    Sides without end stay without end.
    """
    finite = np.array(area)
    known = np.isfinite(finite)
    # A side without end takes no part in where the others come to lie.
    for low, high in ((0, 2), (1, 3)):
        if not known[low]:
            finite[low] = finite[high] if known[high] else 0.0
        if not known[high]:
            finite[high] = finite[low]
    x0, y0, x1, y1 = finite.tolist()
    base = -moved.rotation.T @ moved.shift
    corners = np.array([[x, y, base[2] + z] for x in (x0, x1) for y in (y0, y1) for z in _HEIGHTS_M])
    plan = moved(corners)[:, :2]
    found = np.concatenate([plan.min(axis=0), plan.max(axis=0)])
    return tuple(np.where(known, found, np.array(area)).tolist())
