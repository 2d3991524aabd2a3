"""Tiles of a survey whose water is no plane: so many that a plane serves in each.

Rays that are bent at a plane which lies d beside the water meet (n - 1) d off, which is put right where points are
made (`survey.run.curved_water`). But oblique rays shift by more than steep ones: by ``d (tan a - n tan b)`` aside, with
``sin a = n sin b``. Where that exceeds a share of a pixel, photographs no longer match.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from survey.plan.tiling import Area, Tiling, ground_of

if TYPE_CHECKING:
    from survey.folder.survey import Survey
    from survey.plan.plan import Plan

# Distance at which rays of a point may be skew to each other [ground sampling distances].
MOST_ASIDE_PX = 0.25
# Places along each side of a tile.
_PLACES = 16
# Rays nearer to the horizon tell nothing of the bed.
_GRAZING_DEG = 70.0


def places_of(ground: Area) -> np.ndarray:
    """Even places (M, 2) [m], local, in a rectangle."""
    x, y = (np.linspace(ground[axis], ground[axis + 2], _PLACES) for axis in range(2))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def aside_px(
    survey: Survey, plan: Plan, ground: Area, tilings: Iterable[Tiling | None]
) -> Iterator[tuple[Tiling | None, float]]:
    """Each of some tilings of a ground, and how far [px] rays of a point are skew at most in its tiles."""
    departure = survey.observations.departure
    if survey.water is None or departure is None:
        return
    over, per_m = departure.interpolated(ground), _aside_per_m(survey)
    for tiling in tilings:
        most = 0.0
        for number in range(1 if tiling is None else len(tiling)):
            places = places_of(ground if tiling is None else tiling.ground(number, tiling.rim))
            away = over(places)
            if tiling is not None:
                design = np.column_stack([np.ones(len(places)), places - places.mean(axis=0)])
                away = away - design @ np.linalg.lstsq(design, away, rcond=None)[0]
            most = max(most, float(np.abs(away).max()))
        yield tiling, most * per_m / plan.gsd_m


def water_doubts(survey: Survey, plan: Plan, tiling: Tiling | None) -> tuple[str, ...]:
    """A warning where the planes of the tiles do not serve, or none."""
    if survey.water is None or survey.observations.departure is None:
        return ()
    _, px = next(aside_px(survey, plan, ground_of(survey, plan), [tiling]))
    if px <= MOST_ASIDE_PX:
        return ()
    return (
        f"rays bent at {'one plane' if tiling is None else 'the planes of the tiles'} for the water of [water] surface "
        f"are skew by up to {px:.2g} px, expected at most {MOST_ASIDE_PX:g}: heights there may be wrong or "
        "missing; take more tiles (--tiles), or photographs that look down more steeply",
    )


def _aside_per_m(survey: Survey) -> float:
    """``tan a - n tan b`` of the most oblique ray of the photographs [-]."""
    water = survey.water
    if water is None:
        return 0.0
    cosines = []
    for view in survey.views:
        rays = view.camera.directions(view.camera.outline())
        cosines.append(float(np.nanmin(-(rays @ np.array(water.up)))))
    cosine = max(min(cosines), np.cos(np.radians(_GRAZING_DEG)))
    sine = np.sqrt(1.0 - cosine**2)
    in_water = sine / water.n_water
    return float(sine / cosine - water.n_water * in_water / np.sqrt(1.0 - in_water**2))
