"""Tiles of a survey: rectangles of the ground that are processed one after the other, so that memory is bounded.

Where the water is not a plane, each tile has its own plane. Rays that are bent at a plane a distance d away from the
water intersect (n - 1) d too high or low, which is corrected when points are made (`survey.run.stage_bed`). In addition
they shift sideways by ``d (tan a - n tan b)``, with ``sin a = n sin b``, oblique rays more than steep ones. Where that
exceeds a share of a pixel, photographs no longer match.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from fields.sweep.block import Overlap
from survey.plan.area import AREA_MARGIN_M, Area, Tiling, flattened, grown, local_area
from survey.plan.heights import dry_ground
from survey.plan.sweep_block import camera_of
from survey.water.tides import GRAZING_DEG

if TYPE_CHECKING:
    from survey.folder.survey import Survey
    from survey.plan.plan import Plan

# Overlap of maps beyond a tile [ground sampling distances]: windows of the solver with their halo (8), and the
# neighbourhood of points (4). Windows of the sweep are added, in pixels of each photograph.
RIM_GSD = 8.0
# Largest distance between the rays of a point: how far they are skew [px] (= ground sampling distances).
MOST_SKEW_PX = 0.25
# A range of heights is used for no more than this [m] along a side.
RANGE_M = 1000.0
# Places along each side of a tile.
_PLACES = 16


def ground_of(survey: Survey, plan: Plan) -> Area:
    """Rectangle of the ground that a survey wants: its bounds, or what two views see at the rough height of the bed."""
    area = local_area(survey)
    if area is not None:
        return grown(area, AREA_MARGIN_M)
    survey = flattened(survey)
    height = 0.0 if survey.water is not None else dry_ground(survey).height
    overlap = Overlap([camera_of(view, plan) for view in survey.views], survey.water, height)
    seen = overlap.cells[overlap.seen.sum(axis=0) >= 2, :2]
    seen = seen if len(seen) else overlap.cells[:, :2]
    # The bed may lie lower, so that views show more of it: half of a footprint.
    reach = 0.5 * max(plan.footprint_m)
    return (*(seen.min(axis=0) - reach).tolist(), *(seen.max(axis=0) + reach).tolist())


def places_of(ground: Area) -> np.ndarray:
    """Even places (M, 2) [m], local, in a rectangle."""
    x, y = (np.linspace(ground[axis], ground[axis + 2], _PLACES) for axis in range(2))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def ray_skew_px(
    survey: Survey, plan: Plan, ground: Area, tilings: Iterable[Tiling | None]
) -> Iterator[tuple[Tiling | None, float]]:
    """Each of several tilings of a ground, with the largest distance [px] between rays of a point in its tiles."""
    departure = survey.observations.departure
    if survey.water is None or departure is None:
        return
    over, per_m = departure.interpolated(ground), _skew_per_m(survey)
    for tiling in tilings:
        most = 0.0
        for number in range(1 if tiling is None else len(tiling)):
            places = places_of(ground if tiling is None else tiling.ground(number, tiling.rim))
            departures = over(places)
            if tiling is not None:
                design = np.column_stack([np.ones(len(places)), places - places.mean(axis=0)])
                departures = departures - design @ np.linalg.lstsq(design, departures, rcond=None)[0]
            most = max(most, float(np.abs(departures).max()))
        yield tiling, most * per_m / plan.gsd_m


def tile_warnings(survey: Survey, plan: Plan) -> tuple[str, ...]:
    """A warning where the planes of the tiles do not approximate the water well enough."""
    if survey.water is None or survey.observations.departure is None:
        return ()
    _, px = next(ray_skew_px(survey, plan, ground_of(survey, plan), [plan.tiling]))
    if px <= MOST_SKEW_PX:
        return ()
    planes = "one plane" if plan.tiling is None else "the planes of the tiles"
    return (
        f"rays bent at {planes} for the water of [water] surface "
        f"are skew by up to {px:.2g} px, expected at most {MOST_SKEW_PX:g}: heights there may be wrong or "
        "missing; take more tiles (--tiles), or photographs that look down more steeply",
    )


def _skew_per_m(survey: Survey) -> float:
    """``tan a - n tan b`` of the most oblique ray of the photographs [-]."""
    water = survey.water
    if water is None:
        return 0.0
    cosines = []
    for view in survey.views:
        rays = view.camera.directions(view.camera.outline())
        cosines.append(float(np.nanmin(-(rays @ np.array(water.up)))))
    cosine = max(min(cosines), np.cos(np.radians(GRAZING_DEG)))
    sine = np.sqrt(1.0 - cosine**2)
    in_water = sine / water.n_water
    return float(sine / cosine - water.n_water * in_water / np.sqrt(1.0 - in_water**2))
